"""Where in a bin the next part is let go, and how high what lies there may reach."""

from __future__ import annotations

from collections import Counter

from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.cycle.stock import ASKEW_MM, LAYER_MM, Stock
from tests.unit.cycle.bench import part


def test_jaws_stay_above_a_part_that_stands_on_end() -> None:
    config = load_cell(shipped("sim.toml"))
    stock = Stock(config, Counter())
    bin_ = config.bin_values()[0]
    assert stock.pile(bin_) == 0.0
    stock.placed(bin_, part(0.0, 0.0, size=60.0))
    stock.placed(bin_, part(0.0, 0.0, size=40.0))
    assert stock.pile(bin_) == 60.0 + LAYER_MM


def test_jaws_stay_out_of_a_bin_that_is_not_empty() -> None:
    config = load_cell(shipped("sim.toml"))
    stock = Stock(config, Counter())
    bin_, other = config.bin_values()[:2]
    stock.placed(bin_, part(0.0, 0.0, size=40.0))
    assert stock.pile(bin_) == bin_.height
    assert stock.pile(other) == 0.0


def test_after_a_restart_a_bin_is_as_full_as_it_was() -> None:
    config = load_cell(shipped("sim.toml"))
    bin_ = config.bin_values()[0]
    assert Stock(config, Counter({bin_.name: 1})).pile(bin_) >= max(bin_.height, ASKEW_MM)

"""What `config check` says of rules that never match, overlap, or ask for what the jaws cannot take."""

from __future__ import annotations

from typing import Any

import pytest

from controller.config.arm import load_arm
from controller.config.cell import CellConfig, RuleSection, load_cell
from controller.config.files import shipped
from controller.cycle.preflight import check
from controller.domain import ArmDescription, Bin, Point


class Willing:
    """A planner that reaches everything."""

    def bin_error(self, bin_: Bin, drop: Point | None = None, pile: float | None = None) -> str | None:
        """None below the height it reaches."""
        return "too high" if pile is not None and pile > 85.0 else None


def warnings(*rules: dict[str, Any]) -> list[str]:
    config: CellConfig = load_cell(shipped("sim.toml"))
    made = tuple(RuleSection.model_validate(rule, strict=False) for rule in rules)
    sorting = config.sorting.model_copy(update={"rules": made})
    arm: ArmDescription = load_arm("reactorx_150")
    found = check(config.model_copy(update={"sorting": sorting}), arm, Willing())  # type: ignore[arg-type]  # a stand-in
    return [line for line in found if not line.startswith("bin ")]


def test_the_shipped_cells_have_nothing_odd() -> None:
    config = load_cell(shipped("sim.toml"))
    assert check(config, load_arm("reactorx_150"), Willing()) == []  # type: ignore[arg-type]  # a stand-in


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"wall_mm": 35.0}, "may lie 52 mm high and slide over its walls of 35 mm, which hold 5"),
        ({"wall_mm": 35.0, "capacity": 5}, ""),
        ({"wall_mm": 80.0, "capacity": 7}, ""),
        ({"wall_mm": 80.0, "capacity": 8}, "over 7 parts the arm can let go no further one, the capacity is 8"),
    ],
)
def test_a_bin_that_cannot_take_its_capacity_is_named(changed: dict[str, Any], said: str) -> None:
    config = load_cell(shipped("sim.toml"))
    circles = next(i for i, bin_ in enumerate(config.bins) if bin_.name == "circles")
    bins = list(config.bins)
    bins[circles] = bins[circles].model_copy(update=changed)
    planner: Any = Willing()
    found = check(config.model_copy(update={"bins": tuple(bins)}), load_arm("reactorx_150"), planner)
    assert [line for line in found if said not in line or not line.startswith("bin circles: ")] == []
    assert len(found) == bool(said)


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        ([{"bin": "squares"}, {"bin": "circles", "shape": "circle"}], "[1] never matches: sorting.rules[0] decides"),
        ([{"bin": "squares", "shape": "circle", "label": "square"}], "rules[0] never matches: nothing is"),
        (
            [
                {"bin": "squares", "size_mm": (0, 40)},
                {"bin": "circles", "size_mm": (40, 80)},
                {"bin": "hexagons", "shape": "hexagon", "size_mm": (30, 60)},
            ],
            "rules[2] never matches: sorting.rules[0] and sorting.rules[1] decide",
        ),
        (
            [{"bin": "squares", "size_mm": (30, 45)}, {"bin": "circles", "size_mm": (40, 60)}],
            "rules[1] overlaps sorting.rules[0] from 40 to 45 mm: those parts go to squares",
        ),
        ([{"bin": "squares", "shape": "square", "size_mm": (100, 120)}], "of 100 mm between the jaws and more"),
        ([{"bin": "squares", "shape": "square", "size_mm": (5, 15)}], "at most 15 mm between the jaws"),
        ([{"bin": "squares", "shape": "square", "size_mm": (40, 90)}], "are left"),
    ],
)
def test_odd_rules_are_named(rules: list[dict[str, Any]], said: str) -> None:
    assert any(said in line for line in warnings(*rules)), warnings(*rules)


@pytest.mark.parametrize(
    "rules",
    [
        [{"bin": "squares", "colour": "red"}, {"bin": "circles", "colour": "blue"}, {"bin": "hexagons"}],
        [{"bin": "squares", "size_mm": (40, 45)}, {"bin": "circles", "size_mm": (45, 50)}],
        [{"bin": "squares", "shape": "square", "size_mm": (40, 50)}, {"bin": "circles", "size_mm": (40, 45)}],
        [{"bin": "squares", "shape": "square", "size_mm": (40, 50)}, {"bin": "squares", "size_mm": (30, 60)}],
    ],
)
def test_sound_rules_are_not(rules: list[dict[str, Any]]) -> None:
    said = [line for line in warnings(*rules) if "never" in line]
    assert said == []

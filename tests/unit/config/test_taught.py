from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.config.taught import load_taught, moved, save_taught, with_taught
from controller.cycle.preflight import check
from controller.domain import Shape
from controller.errors import ConfigError
from controller.motion.planner import Planner
from controller.service.manual import by_ruler
from tests.unit.motion.scene import part

CELL = load_cell(shipped("sim.toml"))
SQUARES, RECTANGLES = (next(bin_ for bin_ in CELL.bins if bin_.name == name) for name in ("squares", "rectangles"))


def test_a_bin_may_share_a_wall_with_another_but_not_stand_in_it() -> None:
    (x, y), wide = RECTANGLES.center_mm, RECTANGLES.size_mm[0]
    beside = moved(CELL, "squares", (x + wide, y))
    assert beside.bins[0].center_mm == (x + wide, y)
    with pytest.raises(ConfigError, match="'squares' and 'rectangles' stand in one another"):
        moved(CELL, "squares", (x + wide - 1.0, y + 40.0))


def test_a_taught_file_that_puts_bins_into_one_another_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bins.toml"
    save_taught(path, "squares", RECTANGLES.center_mm)
    with pytest.raises(ConfigError, match="stand in one another"):
        with_taught(CELL, path)
    # Two that have changed places stand where nobody else does any more.
    save_taught(path, "rectangles", SQUARES.center_mm)
    assert load_taught(path) == {"rectangles": SQUARES.center_mm, "squares": RECTANGLES.center_mm}
    assert with_taught(CELL, path).bins[0].center_mm == RECTANGLES.center_mm


@pytest.mark.parametrize("path", sorted(shipped("cells").glob("*.toml")), ids=lambda path: path.stem)
def test_the_cell_of_every_arm_is_within_its_reach(path: Path) -> None:
    cell = load_cell(path)
    assert cell.arm.description == path.stem
    arm = load_arm(path.stem)
    planner = Planner(arm, by_ruler(cell), cell.bin_values())
    assert check(cell, arm, planner) == []
    area = cell.table.work_area
    bin_ = cell.bin_values()[0]
    for radius in (area.inner_radius_mm, area.outer_radius_mm):
        disc = part(Shape.CIRCLE, 40.0, (radius - cell.table.origin_in_base_mm[0], 0.0))
        planner.plan_pick(disc, (), bin_, bin_.center, np.array(arm.ready))

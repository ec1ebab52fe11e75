"""The cell's configuration: shipped files load, and what contradicts itself is refused."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.config.cell import CellConfig, load_cell
from controller.config.files import named_or_path, shipped
from controller.domain import Shape
from controller.errors import ConfigError
from controller.geometry import pose

SHIPPED = shipped("sim.toml").read_text()


def load(tmp_path: Path, text: str) -> CellConfig:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    return load_cell(path)


@pytest.mark.parametrize("name", ["sim.toml", "cell.toml"])
def test_the_shipped_cells_load(name: str) -> None:
    cell = load_cell(shipped(name))
    assert {rule.bin for rule in cell.sorting.rules} <= {bin_.name for bin_ in cell.bins}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('bin = "squares"', 'bin = "sqares"', "did you mean squares?"),
        ('otherwise = "rejects"', 'otherwise = "reject"', "did you mean rejects?"),
        ('name = "circles"', 'name = "squares"', "two bins"),
        ("inner_radius_mm = 150.0", "inner_radius_mm = 300.0", "inner_radius_mm"),
        ("azimuth_deg = [-50.0, 50.0]", "azimuth_deg = [50.0, -50.0]", "azimuth_deg"),
        ('shape = "triangle"\nheight_mm = 28.0', 'shape = "square"\nheight_mm = 28.0', "two parts"),
        ('shape = "square"\nbin', 'size_mm = [9.0, 3.0]\nbin', "size_mm"),
    ],
)
@pytest.mark.safety("SR-04")
def test_contradictions_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in SHIPPED
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, SHIPPED.replace(old, new, 1))
    assert message in str(caught.value)


def test_the_first_rule_that_matches_decides(tmp_path: Path) -> None:
    text = SHIPPED.replace('shape = "square"\nbin = "squares"', 'shape = "square"\nsize_mm = [30, 40]\nbin = "squares"')
    cell = load(tmp_path, text)
    assert cell.bin_for(Shape.SQUARE, "square", 39.9) == "squares"
    assert cell.bin_for(Shape.SQUARE, "square", 40.0) == "rejects"
    assert cell.bin_for(Shape.OTHER, "other", 40.0) == "rejects"


def test_the_default_may_be_to_leave_it(tmp_path: Path) -> None:
    cell = load(tmp_path, SHIPPED.replace('otherwise = "rejects"', 'otherwise = "leave"'))
    assert cell.bin_for(Shape.OTHER, "other", 40.0) is None


def test_the_digest_follows_the_content(tmp_path: Path) -> None:
    assert load(tmp_path, SHIPPED).digest == load(tmp_path, "# a comment\n" + SHIPPED).digest
    assert load(tmp_path, SHIPPED).digest != load(tmp_path, SHIPPED.replace("20.0", "21.0", 1)).digest


def test_the_outline_of_the_work_area_agrees_with_its_test() -> None:
    cell = load_cell(shipped("sim.toml"))
    T_base_table = pose(230.0, 10.0, yaw=0.3)
    outline = cell.work_area_outline(T_base_table).astype(np.float32)
    rng = np.random.default_rng(5)
    for point in rng.uniform(-350, 350, (400, 2)):
        # The chords of the polygon leave out up to 0.3 mm of a circle of 260 mm.
        inside = cv2.pointPolygonTest(outline, (float(point[0]), float(point[1])), True)
        if abs(inside) > 1.0:
            assert cell.in_work_area((point[0], point[1]), T_base_table) == (inside > 0)


def test_heights_come_from_the_kind_of_part() -> None:
    cell = load_cell(shipped("sim.toml"))
    assert cell.part(Shape.TRIANGLE).height_mm == 28.0
    assert cell.part(Shape.OTHER) is cell.default_part


def test_names_of_shipped_files_win_over_paths(tmp_path: Path) -> None:
    assert named_or_path("reactorx_150", "arms") == shipped("arms/reactorx_150.toml")
    own = tmp_path / "own.toml"
    own.touch()
    assert named_or_path(str(own), "arms") == own
    with pytest.raises(ConfigError, match="reactorx_150"):
        named_or_path("no_such_arm", "arms")


def test_the_ruler_pose_turns_by_degrees() -> None:
    cell = load_cell(shipped("sim.toml"))
    turned = cell.table.model_copy(update={"yaw_deg": 90.0}).T_base_table()
    assert np.allclose(turned[:2, :2], [[0, -1], [1, 0]], atol=1e-12)
    assert math.isclose(turned[0, 3], 230.0)


def test_a_rule_may_ask_for_a_colour_or_a_taught_class(tmp_path: Path) -> None:
    text = SHIPPED.replace('shape = "square"\nbin = "squares"', 'shape = "square"\ncolour = "red"\nbin = "squares"')
    cell = load(tmp_path, text.replace('shape = "circle"\nbin', 'label = "M8 nut"\nbin'))
    assert cell.bin_for(Shape.SQUARE, "square", 40.0, "red") == "squares"
    assert cell.bin_for(Shape.SQUARE, "square", 40.0, "blue") == "rejects"
    assert cell.bin_for(Shape.SQUARE, "square", 40.0) == "rejects"
    assert cell.bin_for(Shape.OTHER, "M8 nut", 40.0) == "circles"
    assert cell.taught_labels == {"M8 nut"}
    with pytest.raises(ConfigError, match="turquoise"):
        load(tmp_path, text.replace('"red"', '"turquoise"'))

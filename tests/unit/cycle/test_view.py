"""What hides the table from the camera, and that nothing is looked for there."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest

from controller.backends import nominal_camera
from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.cycle.view import Backdrop, reaching_under
from controller.domain import Array, CellCalibration, Frame, Shape
from controller.motion.kinematics import inverse
from controller.motion.planner import Planner
from controller.vision.detect import detect
from controller.vision.recipe import load_recipe
from tests.unit.cycle.bench import part

SIZE = (1280, 720)
CONFIG = load_cell(shipped("sim.toml"))
CAMERA, T_TABLE_CAMERA = nominal_camera(CONFIG)
CALIBRATION = CellCalibration("nominal", CAMERA, T_TABLE_CAMERA, CONFIG.table.T_base_table())
ARM = load_arm("reactorx_150")
PLANNER = Planner(ARM, CALIBRATION, CONFIG.bin_values())
NOWHERE = np.empty((0, 3))


def share_hidden(mask: np.typing.NDArray[np.uint8], points: Array, height: float = 0.0) -> float:
    """Of points (N, 2) in `table`, mm, those that are in the picture and masked."""
    pixels = np.rint(CALIBRATION.plane(height).to_pixels(points)).astype(int)
    seen = pixels[((pixels >= 0) & (pixels < SIZE)).all(axis=1)]
    assert len(seen)
    return float((mask[seen[:, 1], seen[:, 0]] > 0).mean())


def test_bins_hide_the_table_and_the_work_area_is_free() -> None:
    mask = Backdrop(CONFIG, CALIBRATION, SIZE).mask(NOWHERE)
    for bin_ in CONFIG.bin_values()[:1]:
        half = np.array(bin_.size) / 2.0
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half + bin_.center
        for height in (0.0, bin_.height):
            assert share_hidden(mask, corners, height) == 1.0
    # A part on the rim of the area reaches some 35 mm beyond it.
    area = CONFIG.work_area_outline(CALIBRATION.T_base_table, 35.0)
    assert share_hidden(mask, area) == 0.0


@pytest.mark.parametrize("azimuth", [-0.8, 0.0, 0.6])
def test_the_arm_hides_what_lies_below_it_and_little_else(azimuth: float) -> None:
    place = (220.0 * math.cos(azimuth), 220.0 * math.sin(azimuth), 90.0)
    backdrop = Backdrop(CONFIG, CALIBRATION, SIZE)
    mask = backdrop.mask(PLANNER.hidden(np.array(inverse(ARM, place)[0])))
    tool = np.array([[place[0] - 230.0, place[1]]])
    assert share_hidden(mask, tool, 90.0) == 1.0
    more = np.count_nonzero(mask) - np.count_nonzero(backdrop.mask(NOWHERE))
    # The arm is 140 mm wide at most and 220 mm long, magnified by its height; a pixel is about 0.6 mm wide.
    assert 0 < more < 2.0 * 140.0 * 300.0 / 0.36


def test_nothing_is_found_where_something_known_hides_the_table_nor_what_is_cut_by_it() -> None:
    random = np.random.default_rng(5)
    image = np.asarray(np.clip(random.normal(200.0, 3.0, (480, 640, 3)), 0, 255), np.uint8)
    for x in (120, 320, 520):
        cv2.rectangle(image, (x - 40, 200), (x + 40, 280), (40, 60, 190), -1)
    frame, recipe = Frame(1, 0.0, image), load_recipe("precise")
    hidden = np.zeros((480, 640), np.uint8)
    hidden[:, :200] = 255  # all of the left one
    hidden[:, 500:] = 255  # half of the right one
    seen = detect(frame, recipe, hidden=hidden).detections
    assert {round(item.center_px[0]) for item in detect(frame, recipe).detections} == {120, 320, 520}
    assert [round(item.center_px[0]) for item in seen] == [320]
    assert detect(frame, recipe, hidden=np.full((480, 640), 255, np.uint8)).detections == ()


def test_a_piece_that_ends_at_the_arm_reaches_on_under_it() -> None:
    """Half of a disc of 50 mm is seen, the rest lies under the hand of the arm in its ready pose."""
    hidden = PLANNER.hidden(np.array(ARM.ready))
    rim = float((hidden[:, 0] + hidden[:, 2]).max())
    angles = np.linspace(-math.pi / 2.0, math.pi / 2.0, 25)
    half = np.column_stack([rim + 10.0 + 25.0 * np.cos(angles), 25.0 * np.sin(angles)])
    piece = dataclasses.replace(part(rim + 20.0, 0.0, Shape.OTHER), footprint=half, size=(50.0, 25.0))
    apart = dataclasses.replace(piece, center=(rim + 120.0, 0.0), footprint=half + (100.0, 0.0))
    (found,) = reaching_under((piece, apart), hidden, 74.0)
    outline = found.footprint.astype(np.float32)
    rest = np.column_stack([rim + 10.0 - 24.0 * np.cos(angles), 24.0 * np.sin(angles)])
    assert all(cv2.pointPolygonTest(outline, (float(x), float(y)), False) > 0 for x, y in rest)
    assert not reaching_under((piece,), PLANNER.hidden(np.array([2.5, *ARM.ready[1:]])), 74.0)

"""What reaches over the table when the cell starts is no part of it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from controller.backends import nominal_camera
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.cycle.guard import ClearView, Guard, strip_mask
from controller.domain import Array, CellCalibration, Frame
from controller.errors import Intruder
from controller.vision.rim import coarse

Image = NDArray[np.uint8]
CONFIG = load_cell(shipped("sim.toml"))
LENS, T_TABLE_CAMERA = nominal_camera(CONFIG)
CALIBRATION = CellCalibration("guarded", LENS, T_TABLE_CAMERA, CONFIG.table.T_base_table())
WIDTH, HEIGHT = LENS.image_size


def table(light: float = 1.0) -> Image:
    """A table without anything on it."""
    grain = np.random.default_rng(0).normal(0.0, 5.0, (HEIGHT, WIDTH, 3))
    return np.asarray(np.clip(light * (170.0 + grain), 0, 255), np.uint8)


def forearm(image: Image) -> Image:
    """Reaches into the work area from the edge of the picture, where the strip is."""
    strip = strip_mask(CONFIG, CALIBRATION, (WIDTH, HEIGHT))
    column = int(np.median(np.flatnonzero(strip[0])))
    reaching = image.copy()
    reaching[: HEIGHT // 2, column - 60 : column + 60] = (90, 120, 190)
    return reaching


def start(view: ClearView) -> Guard:
    return Guard(CONFIG, CALIBRATION, view, 66.0)


def nothing(at: float) -> Array:
    """The arm hides nothing."""
    return np.empty((0, 3))


def frame(image: Image) -> Frame:
    return Frame(1, 0.0, image)


@pytest.mark.safety("SR-36")
def test_a_hand_in_the_first_picture_of_a_start_is_seen_until_it_is_gone() -> None:
    view = ClearView()
    start(view).check_frame(frame(table()), nothing)
    guard = start(view)
    for _ in range(2):
        with pytest.raises(Intruder, match="reaches over"):
            guard.check_frame(frame(forearm(table())), nothing)
    with pytest.raises(Intruder):
        guard.check_glance(frame(np.asarray(coarse(forearm(table())), np.uint8)), nothing)
    guard.check_frame(frame(table()), nothing)
    with pytest.raises(Intruder):
        guard.check_frame(frame(forearm(table())), nothing)


def test_the_light_may_be_another_one_at_every_start() -> None:
    kept: list[NDArray[np.float32]] = []
    view = ClearView(keep=kept.append)
    for light in (1.0, 0.8, 0.5, 0.3):
        start(view).check_frame(frame(table(light)), nothing)
    assert [round(float(image.mean()) / float(kept[0].mean()), 1) for image in kept] == [1.0, 0.8, 0.5, 0.3]


def test_where_nobody_knows_better_the_first_picture_tells() -> None:
    guard = start(ClearView())
    guard.check_frame(frame(forearm(table())), nothing)
    with pytest.raises(Intruder):
        guard.check_frame(frame(table()), nothing)


def test_what_is_to_stay_there_is_no_intruder_once_somebody_has_said_so() -> None:
    view = ClearView()
    start(view).check_frame(frame(table()), nothing)
    view.forget()
    start(view).check_frame(frame(forearm(table())), nothing)


def test_a_picture_of_another_size_tells_nothing() -> None:
    view = ClearView(coarse(table())[::2, ::2])
    start(view).check_frame(frame(table()), nothing)


def test_the_arm_itself_is_no_intruder_and_a_hand_beside_it_is_one() -> None:
    guard = start(ClearView())
    guard.check_frame(frame(table()), nothing)
    picture = forearm(table())
    rows, columns = np.nonzero((picture != table()).any(axis=2))
    pixels = np.column_stack([columns, rows])[::400].astype(np.float64)
    at = CALIBRATION.plane(0.0).to_plane(pixels)
    discs = np.column_stack([at, np.full(len(at), 15.0)])
    guard.check_frame(frame(picture), lambda at: discs)
    with pytest.raises(Intruder):
        guard.check_frame(frame(picture), lambda at: discs + (400.0, 0.0, 0.0))


def test_a_first_look_with_the_arm_over_the_strip_is_not_learnt_as_clear() -> None:
    view = ClearView()
    start(view).check_frame(frame(table()), nothing)
    guard, picture = start(view), forearm(table())
    everywhere = np.array([[*CONFIG.bin_values()[0].center, np.inf]])
    guard.check_frame(frame(picture), lambda at: everywhere)
    guard.check_frame(frame(table()), nothing)
    with pytest.raises(Intruder):
        guard.check_frame(frame(picture), nothing)

"""The guided procedure: which views of a board to take, in which order, and what to make of them.

The same code serves a person with a printed board and the simulated cell, whose hands are a Presenter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.calibration.boards import Board
from controller.calibration.camera import CameraCalibration, calibrate_camera
from controller.calibration.table import TableCalibration, calibrate_table
from controller.geometry import pose_from_rvec
from controller.ports import Camera, Clock, Presenter

Array = NDArray[np.float64]

#: Frames of the resting sheet that are averaged: below 0.1 mm at the 95th percentile from ten on.
TABLE_FRAMES = 10
#: Assumed until the lens is known, rad: common webcams have 55 to 78 degrees.
NOMINAL_FIELD = math.radians(65.0)
#: Time a held board is given to come to rest, s.
SETTLE = 0.2


@dataclass(frozen=True, slots=True)
class Wanted:
    """One view asked for.

    Attributes:
        at: Where the board's middle shall appear, as a share of the picture from its middle, -0.5 to 0.5.
        share: Width of the board in the picture, as a share of the picture's width, if it were frontal.
        tilt: rad away from frontal.
        towards: Direction of the tilt axis in the picture, rad.
        turn: Rotation about the line of sight, rad.
    """

    at: tuple[float, float]
    share: float
    tilt: float
    towards: float
    turn: float = 0.0


def wanted_views() -> tuple[Wanted, ...]:
    """22 views: 15 to 45 degrees of tilt in every direction, near and far, into every corner.

    Tilts pin the focal length, corners pin the lens terms; frontal or central views alone pin neither.
    """
    views = []
    places = [(x, y) for y in (-0.24, 0.0, 0.24) for x in (-0.27, 0.0, 0.27)]
    for index, place in enumerate(places):
        views.append(Wanted(place, 0.42, math.radians(20 + 8 * (index % 3)), 2.4 * index))
    for index, (x, y) in enumerate(((-0.31, -0.29), (0.31, -0.29), (-0.31, 0.29), (0.31, 0.29)) * 2):
        share, tilt = (0.34, 22) if index < 4 else (0.36, 34)
        # The tilt axis runs across the diagonal, so that the far side of the board reaches the corner.
        across = math.atan2(y, x) + math.pi / 2 + (math.pi if index >= 4 else 0.0)
        views.append(Wanted((x, y), share, math.radians(tilt), across))
    for index in range(5):
        views.append(Wanted((0.0, 0.0), 0.75, math.radians(40 if index else 15), 1.3 * index, 0.6 * (index - 2)))
    return tuple(views)


def board_pose_for(
    wanted: Wanted, board: Board, image_size: tuple[int, int], field: float = NOMINAL_FIELD
) -> Array:
    """T_camera_board (4, 4) of a wanted view for a camera of the given horizontal field of view (rad)."""
    width, height = image_size
    focal = width / 2 / math.tan(field / 2)
    distance = focal * board.print_size[0] / (wanted.share * width)
    direction = np.array([wanted.at[0] * width / focal, wanted.at[1] * height / focal, 1.0])
    axis = np.array([math.cos(wanted.towards), math.sin(wanted.towards), 0.0])
    tilted = pose_from_rvec(axis * wanted.tilt, direction * distance)
    return np.asarray(tilted @ pose_from_rvec([0.0, 0.0, wanted.turn], [0.0, 0.0, 0.0]))


def calibrate_by_showing(
    camera: Camera,
    presenter: Presenter,
    board: Board,
    clock: Clock,
    *,
    sheet: Board | None = None,
    pixel_mm: float | None = None,
    views: Sequence[Wanted] | None = None,
    field: float = NOMINAL_FIELD,
    progress: Callable[[str], None] = lambda text: None,
) -> tuple[CameraCalibration, TableCalibration]:
    """Lens and table from a board held before the camera and then laid on the table.

    Blocks; moves no arm, but the arm must be out of the picture.

    Args:
        camera: Open.
        presenter: Whoever holds and lays the prints.
        board: Held before the camera.
        clock: The cell's.
        sheet: Laid on the table; the same board when not given.
        pixel_mm: Pixel size of the prints; a 40th of the board's pitch when not given.
        views: What to show; `wanted_views()` when not given.
        field: Horizontal field of view by the camera's data sheet, rad: how far away a board fills the picture.
        progress: Called with one line before each view.

    Raises:
        CalibrationPoorFit: The views do not determine the lens, or the sheet is not seen.
        CameraError: No frame came.
    """
    wanted = wanted_views() if views is None else views
    fine = board.pitch / 40 if pixel_mm is None else pixel_mm
    print_ = board.draw(fine)
    size = camera.capture(clock.now()).size
    images = []
    try:
        for index, view in enumerate(wanted, 1):
            progress(f"view {index} of {len(wanted)}")
            presenter.hold(print_, fine, board_pose_for(view, board, size, field))
            clock.sleep(SETTLE)
            images.append((f"view {index}", camera.capture(clock.now()).image))
        presenter.remove()
        lens = calibrate_camera(images, board)
        progress(f"lens: {lens.rms_px:.3f} px, {lens.uncertainty_mm:.2f} mm at {lens.distance_mm:.0f} mm")
        laid = board if sheet is None else sheet
        fine = fine if sheet is None else laid.pitch / 40
        presenter.lay(laid.draw(fine), fine)
        clock.sleep(SETTLE)
        frames = [(f"table {i + 1}", camera.capture(clock.now()).image) for i in range(TABLE_FRAMES)]
    finally:
        presenter.remove()
    table = calibrate_table(frames, lens, laid)
    progress(f"table: {table.rms_px:.3f} px, {table.rms_mm:.3f} mm")
    return lens, table

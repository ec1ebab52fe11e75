"""Published figures of real cameras, from the shared photographs, with the lens model of their source."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from controller.calibration.board_search import find_board
from controller.calibration.board_spec import parse_board
from controller.calibration.camera import calibrate_camera
from controller.calibration.table import board_pose
from controller.errors import CalibrationPoorFit
from controller.geometry import CameraModel
from tests.benchmarks.published import NOT_PINNED, SETS, Published, lens, load, robot, ruler, squares


@pytest.mark.parametrize("published", SETS, ids=lambda item: f"{item.pattern.split('/')[0]}-{item.model}")
def test_published_figures_are_reproduced(shared: Path, published: Published) -> None:
    found = lens(shared, published)
    if published.rms is not None:
        assert found.rms_px <= published.rms + 0.02
    for axis in (0, 1):
        assert found.camera.matrix[axis, axis] == pytest.approx(published.focal[axis], rel=0.01)
    assert found.views_used >= published.views


@pytest.mark.parametrize(("kind", "mm", "deg"), [("charuco", 3.0, 0.5), ("grid", 5.0, 1.0)])
def test_a_robot_and_its_camera_agree(shared: Path, kind: str, mm: float, deg: float) -> None:
    """Asked: 1.5 px, 10 mm and 2 degrees. The grid of dots is printed 2 % smaller than stated, as the robot tells."""
    found = robot(shared, kind)
    assert found.rms_px / 2**0.5 < 1.1
    assert found.apart_mm.mean() < mm
    assert found.apart_deg.mean() < deg


def test_squares_of_30_mm_measure_30_mm(shared: Path) -> None:
    errors = np.abs(squares(shared))
    assert len(errors) == 7 * 12 * 4
    assert np.median(errors) <= 0.35
    assert np.percentile(errors, 95) <= 1.0


def test_a_ruler_beside_the_board_agrees_with_it(shared: Path) -> None:
    # The ruler lies on the paper: its marks are some tenths of a mm nearer to the lens, 300 mm away.
    assert ruler(shared) == pytest.approx(1.0, abs=0.003)


def test_other_sizes_and_cut_boards_are_left_out_with_a_reason(shared: Path) -> None:
    found = lens(shared, next(item for item in SETS if "udacity" in item.pattern))
    reasons = dict(found.views_rejected)
    assert "1281x721" in reasons["calibration7.jpg"]
    assert "1281x721" in reasons["calibration15.jpg"]
    assert found.views_used + len(reasons) == 20


def test_boards_that_overfill_the_view_are_indexed_from_what_is_seen(shared: Path) -> None:
    found = lens(shared, next(item for item in SETS if "any" in item.board))
    # The source's own calibration has k1 of about -0.35.
    assert found.camera.distortion[0] == pytest.approx(-0.35, abs=0.03)


def test_four_views_that_do_not_pin_the_focal_length_are_refused(shared: Path) -> None:
    with pytest.raises(CalibrationPoorFit, match="focal length is not pinned"):
        calibrate_camera(load(shared, NOT_PINNED[0]), parse_board(NOT_PINNED[1]))


def test_the_wrong_board_is_said(shared: Path) -> None:
    with pytest.raises(CalibrationPoorFit, match="chessboard:7x5:25"):
        calibrate_camera(load(shared, "boofcv_bumblebee_chess/*.jpg")[:4], parse_board("chessboard:7x5:25"))
    # A board of 9x6 corners has every smaller one in it.
    with pytest.raises(CalibrationPoorFit, match="no 8x6 inner corners seen, but 9x6"):
        calibrate_camera(load(shared, "opencv_stereo_chess/left*.jpg")[:4], parse_board("chessboard:8x6:25"))


def test_a_robot_that_carries_the_board_is_seen_where_it_says(shared: Path) -> None:
    """Intrinsics of the source, board pose of each dot grid: its own test asks for less than 0.5 px."""
    camera = CameraModel(np.array([[542.3, 0, 322.2], [0, 543.5, 231.3], [0, 0, 1.0]]), np.zeros(5), (640, 480))
    board = parse_board("circles:10x10:25.4")
    for _, picture in load(shared, "rosi_charuco_robot/grid_0[0-4].png"):
        view = find_board(board, picture)
        T = board_pose(view.object_points, view.image_points, camera)
        points = view.object_points @ T[:3, :3].T + T[:3, 3]
        assert np.sqrt(((camera.project(points) - view.image_points) ** 2).sum(axis=1).mean()) < 1.0

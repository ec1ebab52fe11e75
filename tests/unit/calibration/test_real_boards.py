"""Published figures of real cameras, from the shared photographs, with the lens model of their source."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.calibration.boards import parse_board
from controller.calibration.camera import LensModel, calibrate_camera
from controller.calibration.table import board_pose
from controller.errors import CalibrationPoorFit
from controller.geometry import CameraModel

Image = NDArray[np.uint8]


def load(shared: Path, pattern: str) -> list[tuple[str, Image]]:
    paths = sorted((shared / "data").glob(pattern))
    return [(path.name, np.asarray(cv2.imread(str(path)), np.uint8)) for path in paths]


PUBLISHED = [
    # folder/pattern, board, model, RMS px, fx, views
    ("opencv_stereo_chess/*.jpg", "chessboard:9x6:25", LensModel.RADIAL_3, 0.19633, 532.81, 13),
    ("boofcv_bumblebee_chess/*.jpg", "chessboard:6x4:30", LensModel.RADIAL_2, 0.089, 524.61, 11),
    ("boofcv_sony_targets/chess*.jpg", "chessboard:6x4:30", LensModel.RADIAL_2, 0.16, 701.01, 13),
    ("boofcv_trinocular/*.jpg", "chessboard:13x9:30", LensModel.RADIAL_2, 0.099, 1839.0, 14),
    ("pycalib_charuco/*.jpg", "charuco:18x9:20:15:DICT_4X4_250", LensModel.RATIONAL, 0.3011, 586.83, 9),
    ("pycalib_charuco/*.jpg", "charuco:18x9:20:15:DICT_4X4_250", LensModel.RADIAL_3, 0.322, 586.83, 9),
    ("rosi_charuco_robot/grid*.png", "circles:10x10:25.4", LensModel.RADIAL_3, 0.5, 542.3, 8),
]


@pytest.mark.parametrize(("pattern", "spec", "model", "rms", "fx", "views"), PUBLISHED)
def test_published_figures_are_reproduced(
    shared: Path, pattern: str, spec: str, model: LensModel, rms: float, fx: float, views: int
) -> None:
    found = calibrate_camera(load(shared, pattern), parse_board(spec), model=model)
    assert found.rms_px <= rms + 0.02
    assert found.camera.matrix[0, 0] == pytest.approx(fx, rel=0.01)
    assert found.views_used >= views


def test_other_sizes_and_cut_boards_are_left_out_with_a_reason(shared: Path) -> None:
    pictures = [item for item in load(shared, "udacity_wide/*.jpg")]
    found = calibrate_camera(pictures, parse_board("chessboard:9x6:25"))
    assert found.rms_px <= 0.92
    assert found.camera.matrix[0, 0] == pytest.approx(1159.0, rel=0.01)
    reasons = dict(found.views_rejected)
    assert "1281x721" in reasons["calibration7.jpg"]
    assert "1281x721" in reasons["calibration15.jpg"]
    assert found.views_used + len(reasons) == len(pictures)


def test_boards_that_overfill_the_view_are_indexed_from_what_is_seen(shared: Path) -> None:
    found = calibrate_camera(load(shared, "sick_metric/camera_*.png"), parse_board("chessboard:any:15.09"))
    assert found.views_used == 10
    # About 0.68 px, fx 2328, fy 2330, k1 -0.35 by the source's own calibration.
    assert found.rms_px <= 0.70
    assert found.camera.matrix[0, 0] == pytest.approx(2328.0, rel=0.003)
    assert found.camera.matrix[1, 1] == pytest.approx(2330.0, rel=0.003)
    assert found.camera.distortion[0] == pytest.approx(-0.35, abs=0.03)


def test_four_views_that_do_not_pin_the_focal_length_are_refused(shared: Path) -> None:
    board = parse_board("charuco:5x7:40:20:DICT_6X6_250:legacy")
    with pytest.raises(CalibrationPoorFit, match="focal length is not pinned"):
        calibrate_camera(load(shared, "opencv_aruco_tutorial/img_*.jpg"), board)


def test_the_wrong_board_is_said(shared: Path) -> None:
    with pytest.raises(CalibrationPoorFit, match="chessboard:7x5:25"):
        calibrate_camera(load(shared, "boofcv_bumblebee_chess/*.jpg")[:4], parse_board("chessboard:7x5:25"))


def test_a_robot_that_carries_the_board_is_seen_where_it_says(shared: Path) -> None:
    """Intrinsics of the source, board pose of each dot grid: its own test asks for less than 0.5 px."""
    camera = CameraModel(np.array([[542.3, 0, 322.2], [0, 543.5, 231.3], [0, 0, 1.0]]), np.zeros(5), (640, 480))
    board = parse_board("circles:10x10:25.4")
    for _, picture in load(shared, "rosi_charuco_robot/grid_0[0-4].png"):
        view = board.find(picture)
        T = board_pose(view.object_points, view.image_points, camera)
        points = view.object_points @ T[:3, :3].T + T[:3, 3]
        assert np.sqrt(((camera.project(points) - view.image_points) ** 2).sum(axis=1).mean()) < 1.0

"""Where a camera stands against a robot: both poses, and a board that is not as large as its name says."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from controller.calibration.board_search import BoardView
from controller.calibration.board_spec import parse_board
from controller.calibration.hand_eye import Carried, fit_hand_eye
from controller.geometry import invert, pose_from_rvec
from tests.unit.calibration.scene import LENS

Array = NDArray[np.float64]
BOARD = parse_board("chessboard:8x5:30")


@pytest.mark.parametrize("scale", [1.0, 0.975])
@pytest.mark.parametrize("carried", list(Carried))
def test_poses_and_a_misprinted_board_are_found(carried: Carried, scale: float) -> None:
    random = np.random.default_rng(3)
    views, robot = [], []
    T_mount_camera = pose_from_rvec([0.3, -0.2, 0.1], [40.0, -25.0, 60.0])
    T_mount_board = pose_from_rvec([0.2, 0.4, -0.3], [300.0, 80.0, -40.0])
    for _ in range(12):
        T_camera_board = pose_from_rvec(random.uniform(-0.5, 0.5, 3), [*random.uniform(-60.0, 60.0, 2), 600.0])
        T = T_mount_camera @ T_camera_board @ invert(T_mount_board)
        # A robot good to half a millimetre and a tenth of a degree.
        jitter = pose_from_rvec(random.normal(0.0, 0.001, 3), random.normal(0.0, 0.3, 3))
        robot.append((T if carried is Carried.BOARD else invert(T)) @ jitter)
        points = scale * BOARD.corners @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
        pixels = LENS.project(points) + random.normal(0.0, 0.1, (len(points), 2))
        views.append(BoardView(BOARD.corners, pixels, np.arange(len(points)), LENS.image_size))
    found = fit_hand_eye(views, robot, LENS, BOARD, carried)
    assert found.scale_sigma < 0.004
    # What the robot's moves cannot tell from 1 stays 1: a tenth of a per cent is no misprint.
    assert found.board_scale == 1.0 if scale == 1.0 else abs(found.board_scale - scale) < 4.0 * found.scale_sigma
    # 0.3 mm and 0.06 degrees over 600 mm: 0.8 mm a view.
    assert found.apart_mm.mean() < 2.0
    assert np.linalg.norm((found.T_mount_camera - T_mount_camera)[:3, 3]) < 3.0

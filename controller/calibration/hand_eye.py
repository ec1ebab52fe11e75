"""A camera and a robot that knows its own pose: where the one stands against the other, from views of a board.

Either the robot carries the board before a camera that stands still, or it carries the camera over a board that lies
still. Both are one chain: camera <- (fixed) <- robot's move <- (fixed) <- board, with two unknown rigid poses.

Source: R. Tsai, R. Lenz, "A new technique for fully autonomous and efficient 3D robotics hand/eye calibration", 1989,
for the start by rotations first; then the reprojection error itself is made least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from controller.calibration import files
from controller.calibration.board_search import BoardView
from controller.calibration.boards import Board, BoardKind
from controller.calibration.table import board_pose
from controller.errors import CalibrationPoorFit, InputError
from controller.geometry import CameraModel, invert, pose_from_rvec, rvec_tvec

Array = NDArray[np.float64]

#: Three views determine the two poses; more judge them.
MIN_VIEWS = 4
#: Moves that turn by less say nothing about directions, rad.
_LEAST_TURN = np.deg2rad(5.0)
#: All axes of turning this nearly in one direction leave the place along it open.
_LEAST_SPREAD = 0.05
_ROUNDS = 5
#: A board's size is doubted when the robot's moves speak against it by so many standard deviations.
_SCALE_SIGMAS = 4.0


def read_robot_pose(path: Path) -> Array:
    """T_base_tool (4, 4), mm, of a text of lines `x: 0.1` (also y, z; m) and `qx: 0.1` (also qy, qz, qw).

    Raises:
        InputError: It cannot be read, or a number is missing.
    """
    remedy = "give x, y, z in metres and the quaternion qx, qy, qz, qw, a line each"
    try:
        lines = [line.split(":") for line in path.read_text(encoding="utf-8").splitlines() if ":" in line]
        value = {key.strip(): float(text) for key, text in lines}
        turn = np.array([value[key] for key in ("qx", "qy", "qz", "qw")])
        place = np.array([value[key] for key in ("x", "y", "z")])
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})", remedy) from error
    except (ValueError, KeyError) as error:
        raise InputError(f"{path}: no pose ({error})", remedy) from error
    if not (np.isfinite(place).all() and abs(float(np.linalg.norm(turn)) - 1.0) < 0.01):
        raise InputError(f"{path}: its quaternion is not of length 1", remedy)
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat(turn).as_matrix()
    out[:3, 3] = 1000.0 * place
    return out


class Carried(StrEnum):
    """What the robot moves."""

    BOARD = "board"
    CAMERA = "camera"


@dataclass(frozen=True, slots=True, eq=False)
class HandEye:
    """Where camera and board are on robot and ground.

    Attributes:
        carried: What the robot moves.
        T_mount_camera: ndarray of shape (4, 4): `camera` in the robot's base, or in its tool when it is carried.
        T_mount_board: ndarray of shape (4, 4): `board` in the robot's tool, or in its base when the camera is carried.
        rms_px: Root mean squared distance between seen corners and those expected by the robot's poses.
        apart_mm, apart_deg: ndarrays of shape (V,): between the board's pose by each view alone and by the robot.
        board_scale: The board's true pitch over the stated one, where the robot's moves tell that it was printed in
            another size; 1.0 where they do not.
        scale_sigma: Standard deviation of that ratio.
    """

    carried: Carried
    T_mount_camera: Array
    T_mount_board: Array
    rms_px: float
    apart_mm: Array
    apart_deg: Array
    board_scale: float
    scale_sigma: float

    def to_json(self) -> dict[str, Any]:
        """The JSON object of `calibrate robot`."""
        on_robot, on_ground = ("camera", "board") if self.carried is Carried.CAMERA else ("board", "camera")
        poses = {"camera": self.T_mount_camera, "board": self.T_mount_board}
        content = {
            "carried": self.carried.value,
            f"T_tool_{on_robot}": poses[on_robot],
            f"T_base_{on_ground}": poses[on_ground],
            "rms_px": self.rms_px,
            "apart_mm": {"mean": self.apart_mm.mean(), "max": self.apart_mm.max()},
            "apart_deg": {"mean": self.apart_deg.mean(), "max": self.apart_deg.max()},
            "views": len(self.apart_mm),
            "board_scale": {"value": self.board_scale, "sigma": self.scale_sigma},
        }
        plain = files.plain(content)
        assert isinstance(plain, dict)
        return plain


def fit_hand_eye(
    views: Sequence[BoardView], robot: Sequence[Array], camera: CameraModel, board: Board, carried: Carried
) -> HandEye:
    """The two fixed poses that make the views and the robot's own poses agree best.

    Args:
        views: The board in each picture.
        robot: Per view ndarray of shape (4, 4), T_base_tool as the robot says, mm.
        camera: The lens.
        board: What is shown; one that looks the same turned about may have been read in any of its turns.
        carried: What the robot moves.

    Raises:
        CalibrationPoorFit: Too few views, or robot poses that do not turn enough.
    """
    if len(views) < MIN_VIEWS:
        raise CalibrationPoorFit(f"only {len(views)} views with the board, {MIN_VIEWS} are needed", "take more")
    moves = np.array([T if carried is Carried.BOARD else invert(T) for T in robot])
    seen = np.array([board_pose(view.object_points, view.image_points, camera) for view in views])
    turns = _turns(board)
    read = np.zeros(len(views), int)
    if len(turns) > 1:
        read = _first_reading(moves, seen, turns)
    for _ in range(_ROUNDS):
        left, right = _start(moves, seen @ turns[read])
        again = _best_reading(moves, seen, turns, left, right)
        if (again == read).all():
            break
        read = again
    points = [view.object_points @ turns[k][:3, :3] for view, k in zip(views, read, strict=True)]
    pixels = [view.image_points for view in views]

    def residuals(at: Array) -> Array:
        here, there = (pose_from_rvec(part[:3], part[3:]) for part in (at[:6], at[6:12]))
        chain = invert(here) @ moves @ there
        scale = at[12] if len(at) > 12 else 1.0
        off = [
            camera.project(scale * p @ T[:3, :3].T + T[:3, 3]) - q
            for p, q, T in zip(points, pixels, chain, strict=True)
        ]
        return np.asarray(np.vstack(off).ravel())

    start = np.concatenate([*rvec_tvec(left), *rvec_tvec(right)])
    steps = np.tile([0.01] * 3 + [1.0] * 3, 2)
    found = least_squares(residuals, start, x_scale=steps)
    # The robot's metres and the board's need not be the same: a print may have been fitted to its page.
    freed = least_squares(residuals, np.append(found.x, 1.0), x_scale=np.append(steps, 0.01))
    scale, sigma = float(freed.x[12]), _scale_sigma(np.asarray(freed.jac), freed.fun, len(views))
    if abs(scale - 1.0) > _SCALE_SIGMAS * sigma:
        found = freed
    else:
        scale = 1.0
    left, right = (pose_from_rvec(part[:3], part[3:]) for part in (found.x[:6], found.x[6:12]))
    off = np.reshape(found.fun, (-1, 2))
    seen = seen.copy()
    seen[:, :3, 3] *= scale  # a smaller board that looks the same is as much nearer
    apart = np.linalg.inv(invert(left) @ moves @ right) @ (seen @ turns[read])
    turned = Rotation.from_matrix(apart[:, :3, :3]).magnitude()
    shifted = np.linalg.norm(apart[:, :3, 3], axis=1)
    rms = float(np.sqrt((off**2).sum(axis=1).mean()))
    return HandEye(carried, left, right, rms, shifted, np.rad2deg(turned), scale, sigma)


def _scale_sigma(jacobian: Array, residuals: Array, views: int) -> float:
    """Standard deviation of the last unknown, each view counting as one error of the robot and not as many corners."""
    variance = float(residuals @ residuals) / max(len(residuals) - jacobian.shape[1], 1)
    corners = len(residuals) / (2.0 * views)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * variance * corners
    return float(np.sqrt(covariance[-1, -1]))


def _turns(board: Board) -> Array:
    """The turns (K, 4, 4) about its normal after which a board looks the same; the unit first."""
    quarters = 1
    if board.kind is BoardKind.CIRCLES:
        quarters = 4 if board.columns == board.rows else 2
    elif board.kind is BoardKind.CHESSBOARD and (board.columns + board.rows) % 2 == 0:
        quarters = 2
    angles = 2.0 * np.pi / quarters * np.arange(quarters)
    return np.array([pose_from_rvec([0.0, 0.0, float(angle)], [0.0, 0.0, 0.0]) for angle in angles])


def _first_reading(moves: Array, seen: Array, turns: Array) -> NDArray[np.int64]:
    """For every view the turn with which the board turned as far as the robot since the first view."""
    robot = Rotation.from_matrix(moves[0, :3, :3].T @ moves[:, :3, :3]).magnitude()
    back = seen[0, :3, :3].T
    angles = [Rotation.from_matrix(back @ seen[:, :3, :3] @ turn[:3, :3]).magnitude() for turn in turns]
    return np.asarray(np.abs(np.array(angles) - robot).argmin(axis=0))


def _best_reading(moves: Array, seen: Array, turns: Array, left: Array, right: Array) -> NDArray[np.int64]:
    """For every view the turn that fits the robot's chain best."""
    expected = (invert(left) @ moves @ right)[:, :3, :3]
    apart = [
        Rotation.from_matrix(np.swapaxes(expected, 1, 2) @ seen[:, :3, :3] @ turn[:3, :3]).magnitude()
        for turn in turns
    ]
    return np.asarray(np.array(apart).argmin(axis=0))


def _start(moves: Array, seen: Array) -> tuple[Array, Array]:
    """The two poses in closed form: the rotations from pairs of views, then the places, which are linear.

    Raises:
        CalibrationPoorFit: The robot hardly turned, or about one axis only.
    """
    pairs = [(i, j) for i in range(len(moves)) for j in range(i)]
    first = np.array([moves[i] @ invert(moves[j]) for i, j in pairs])[:, :3, :3]
    other = np.array([seen[i] @ invert(seen[j]) for i, j in pairs])[:, :3, :3]
    a, b = Rotation.from_matrix(first).as_rotvec(), Rotation.from_matrix(other).as_rotvec()
    enough = np.linalg.norm(a, axis=1) > _LEAST_TURN
    axes = a[enough] / np.linalg.norm(a[enough], axis=1)[:, None]
    if len(axes) < 2 or np.linalg.svd(axes, compute_uv=False)[1] < _LEAST_SPREAD * np.sqrt(len(axes)):
        raise CalibrationPoorFit(
            "the robot did not turn about two different axes between the views", "turn its tool in several directions"
        )
    R_left = Rotation.align_vectors(a, b)[0].as_matrix()
    R_right = Rotation.from_matrix(np.swapaxes(moves[:, :3, :3], 1, 2) @ R_left @ seen[:, :3, :3]).mean().as_matrix()
    rows = np.concatenate([np.hstack([np.eye(3), -move[:3, :3]]) for move in moves])
    wanted = np.concatenate([move[:3, 3] - R_left @ view[:3, 3] for move, view in zip(moves, seen, strict=True)])
    places = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    left, right = np.eye(4), np.eye(4)
    left[:3, :3], left[:3, 3] = R_left, places[:3]
    right[:3, :3], right[:3, 3] = R_right, places[3:]
    return left, right

"""The bundle: lens, board poses and the bow of the board fitted together, with their covariance.

OpenCV's `calibrateCamera` gives standard deviations only; the uncertainty in mm needs the whole
covariance, and a board that is not flat needs three more unknowns. Gauss-Newton on the Schur complement
(the poses are eliminated view by view), derivatives from `projectPoints`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.geometry import CameraModel

Array = NDArray[np.float64]

#: Unknowns of the lens in the order of the parameter vector (OpenCV's distortion order).
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
BOW_NAMES = ("bow_xx", "bow_xy", "bow_yy")
_ROUNDS = 60


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A converged bundle.

    Attributes:
        lens: ndarray of shape (12,), in the order of `NAMES`.
        bow: ndarray of shape (3,): the board's z = xx x^2 + xy x y + yy y^2, with x and y divided by
            `scale`, so that each term is mm at that distance from the middle.
        scale: mm.
        poses: ndarray of shape (V, 6): Rodrigues vector and translation of the board in `camera`.
        residuals: Per view ndarray of shape (N, 2), seen minus projected, px.
        free: Names of what was fitted, in the order of `covariance`.
        covariance: ndarray of shape (K, K) of the free unknowns (poses marginalised), scaled by the
            residuals' own variance.
    """

    lens: Array
    bow: Array
    scale: float
    poses: Array
    residuals: tuple[Array, ...]
    free: tuple[str, ...]
    covariance: Array

    @property
    def points(self) -> int:
        """Number of corners used."""
        return sum(len(r) for r in self.residuals)

    @property
    def squares(self) -> float:
        """Sum of squared residuals, px^2."""
        return float(sum((r**2).sum() for r in self.residuals))

    @property
    def rms(self) -> float:
        """OpenCV's reprojection error: root mean squared distance, px."""
        return float(np.sqrt(self.squares / self.points))

    @property
    def view_rms(self) -> Array:
        """The same for each view, shape (V,)."""
        return np.array([np.sqrt((r**2).sum() / len(r)) for r in self.residuals])

    @property
    def bic(self) -> float:
        """Bayesian information criterion up to a constant (the poses are the same in every model)."""
        n = 2 * self.points
        return float(n * np.log(self.squares / n) + len(self.free) * np.log(n))

    @property
    def aic(self) -> float:
        """Akaike's information criterion up to a constant."""
        n = 2 * self.points
        return float(n * np.log(self.squares / n) + 2.0 * len(self.free))

    def camera(self, image_size: tuple[int, int]) -> CameraModel:
        """The lens as a camera model."""
        return camera_of(self.lens, image_size)


def camera_of(lens: Array, image_size: tuple[int, int]) -> CameraModel:
    """Camera model of a lens vector (12,); five distortion terms unless it is rational."""
    matrix = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
    return CameraModel(matrix, lens[4:12].copy() if lens[9:12].any() else lens[4:9].copy(), image_size)


def lens_of(camera: CameraModel) -> Array:
    """Lens vector (12,) of a camera model; terms beyond the rational model's are not carried over."""
    matrix, lens = camera.matrix, np.zeros(12)
    lens[:4] = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    count = min(8, len(camera.distortion))
    lens[4 : 4 + count] = camera.distortion[:count]
    return lens


def solve(
    objects: Sequence[Array],
    pixels: Sequence[Array],
    lens: Array,
    poses: Array,
    free: Sequence[str],
    *,
    bow: bool = False,
) -> Fit:
    """Least squares over the free lens terms, every pose, and the board's bow when asked for.

    Args:
        objects: Per view ndarray of shape (N, 3), `board`, mm.
        pixels: Per view ndarray of shape (N, 2), px.
        lens: Start, shape (12,); terms that are not free keep their value.
        poses: Start, shape (V, 6).
        free: Names out of `NAMES`.
        bow: Fit the three bow terms.
    """
    columns = [NAMES.index(name) for name in free]
    scale = max(float(np.abs(o[:, :2]).max()) for o in objects)
    shapes = [_bow_basis(o, scale) if bow else np.zeros((len(o), 0)) for o in objects]
    bends, lens, poses = np.zeros(3 if bow else 0), lens.copy(), poses.copy()
    damping = 1e-4
    blocks = _linearise(objects, pixels, shapes, lens, poses, bends, columns)
    cost = sum(float((b[2] ** 2).sum()) for b in blocks)
    for _ in range(_ROUNDS):
        step, pose_steps = _step(blocks, damping)
        new_lens, new_bends = lens.copy(), bends + step[len(columns) :]
        new_lens[columns] += step[: len(columns)]
        new_poses = poses + pose_steps
        new_blocks = _linearise(objects, pixels, shapes, new_lens, new_poses, new_bends, columns)
        new_cost = sum(float((b[2] ** 2).sum()) for b in new_blocks)
        if new_cost <= cost:
            done = cost - new_cost <= 1e-10 * cost
            lens, poses, bends, blocks, cost = new_lens, new_poses, new_bends, new_blocks, new_cost
            damping = max(damping / 10, 1e-12)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    count = sum(len(o) for o in objects)
    unknowns = len(columns) + len(bends) + poses.size
    variance = cost / max(2 * count - unknowns, 1)
    normal = _reduced(blocks, 0.0)[0]
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    covariance = np.linalg.pinv(normal * np.outer(unit, unit), hermitian=True) * np.outer(unit, unit) * variance
    return Fit(
        lens,
        bends if bow else np.zeros(3),
        scale,
        poses,
        tuple(b[2].reshape(-1, 2) for b in blocks),
        (*free, *(BOW_NAMES if bow else ())),
        covariance,
    )


def project(points: Array, pose: Array, lens: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) of board points (N, 3) and their derivative (2N, 18): pose 6, then lens 12."""
    matrix = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
    seen, jacobian = cv2.projectPoints(np.ascontiguousarray(points), pose[:3], pose[3:], matrix, lens[4:12])
    return np.asarray(seen, np.float64).reshape(-1, 2), np.asarray(jacobian, np.float64)


_Block = tuple[Array, Array, Array]


def _bow_basis(points: Array, scale: float) -> Array:
    x, y = points[:, 0] / scale, points[:, 1] / scale
    return np.column_stack([x * x, x * y, y * y])


def _linearise(
    objects: Sequence[Array],
    pixels: Sequence[Array],
    shapes: Sequence[Array],
    lens: Array,
    poses: Array,
    bends: Array,
    columns: list[int],
) -> list[_Block]:
    """Per view (derivative by lens and bow, derivative by pose, residual)."""
    blocks: list[_Block] = []
    for points, seen, shape, pose in zip(objects, pixels, shapes, poses, strict=True):
        bent = points
        if len(bends):
            bent = points + np.column_stack([np.zeros((len(points), 2)), shape @ bends])
        model, jacobian = project(bent, pose, lens)
        shared = jacobian[:, 6:][:, columns]
        if len(bends):
            out_of_board: Any = cv2.Rodrigues(pose[:3])[0][:, 2]
            along = jacobian[:, 3:6] @ np.asarray(out_of_board, np.float64)
            shared = np.hstack([shared, along[:, None] * np.repeat(shape, 2, axis=0)])
        blocks.append((shared, jacobian[:, :6], (seen - model).ravel()))
    return blocks


def _reduced(blocks: Sequence[_Block], damping: float) -> tuple[Array, Array, list[tuple[Array, Array]]]:
    """Schur complement of the poses, its right side, and what back substitution needs per view."""
    count = blocks[0][0].shape[1]
    normal, right = np.zeros((count, count)), np.zeros(count)
    back: list[tuple[Array, Array]] = []
    for shared, own, residual in blocks:
        mixed = own.T @ shared
        square = own.T @ own
        square[np.diag_indices(6)] *= 1.0 + damping
        inverse = np.linalg.inv(square)
        gain, offset = inverse @ mixed, inverse @ (own.T @ residual)
        mine = shared.T @ shared
        mine[np.diag_indices(count)] *= 1.0 + damping
        normal += mine - mixed.T @ gain
        right += shared.T @ residual - mixed.T @ offset
        back.append((gain, offset))
    return normal, right, back


def _step(blocks: Sequence[_Block], damping: float) -> tuple[Array, Array]:
    normal, right, back = _reduced(blocks, damping)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))  # px per unit differ by 1e6 between the unknowns
    step = unit * np.linalg.lstsq(normal * np.outer(unit, unit), unit * right, rcond=1e-14)[0]
    return step, np.array([offset - gain @ step for gain, offset in back])

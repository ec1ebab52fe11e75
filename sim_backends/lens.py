"""The true camera of the simulated cell: its lens, where it hangs, and what each of its pixels looks at.

Written apart from `controller.geometry`, so that one mistake cannot pass on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from sim_backends.solids import Array

_KNOT_STEP = 8  # px


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """A pinhole with OpenCV's distortion, in its place.

    Attributes:
        matrix: ndarray of shape (3, 3), px.
        distortion: ndarray of shape (5,): k1, k2, p1, p2, k3.
        size: (width, height), px.
        T_base_camera: ndarray of shape (4, 4), mm.
        position: ndarray of shape (3,): the optical centre in `base`, mm.
    """

    matrix: Array
    distortion: Array
    size: tuple[int, int]
    T_base_camera: Array
    position: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", self.T_base_camera[:3, 3])

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (N, 2) of points (N, 3) in `base`, mm, and which of them lie before the camera."""
        local = (points - self.position) @ self.T_base_camera[:3, :3]
        zero: Any = np.zeros(3)
        ahead = local[:, 2] > 10.0
        # A point behind the camera has no pixel; any finite one will do for what is not shown.
        local[:, 2] = np.where(ahead, local[:, 2], 10.0)
        pixels, _ = cv2.projectPoints(local.reshape(-1, 1, 3), zero, zero, self.matrix, self.distortion)
        return np.asarray(pixels, np.float64).reshape(-1, 2), ahead

    def rays(self) -> NDArray[np.float32]:
        """Directions (x, y) with z = 1, in `camera`, that the pixels look along; (H, W, 2)."""
        (columns, x), (rows, y) = (_knots(length) for length in self.size)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
        # The stub has no None for R and P, which means identity.
        undone = cv2.undistortPointsIter(grid, self.matrix, self.distortion, None, None, criteria)  # type: ignore[call-overload]
        knots = undone.reshape(len(y), len(x), 2)
        return np.asarray(columns @ (rows @ knots.reshape(len(y), -1)).reshape(-1, len(x), 2), np.float32)


def _knots(length: int) -> tuple[Array, Array]:
    """Matrix (L, K) that gives a smooth function at all of `length` pixels from its values at some, and those (K,).

    A cubic spline over knots `_KNOT_STEP` px apart follows the strongest lens used to 1e-4 px.
    """
    at = np.linspace(0.0, length - 1.0, max(length // _KNOT_STEP, 4))
    return np.asarray(make_interp_spline(at, np.eye(len(at)))(np.arange(length))), at

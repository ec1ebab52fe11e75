"""The true camera of the simulated cell: its lens, where it hangs, and what each of its pixels looks at.

Written apart from `controller.geometry`, so that one mistake cannot pass on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_backends.solids import Array


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
        width, height = self.size
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
        # The stub has no None for R and P, which means identity.
        undone = cv2.undistortPointsIter(grid.astype(np.float64), self.matrix, self.distortion, None, None, criteria)  # type: ignore[call-overload]
        return np.asarray(undone, np.float32).reshape(height, width, 2)

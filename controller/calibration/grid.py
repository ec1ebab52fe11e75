"""Corners of a chessboard that overfills the view, indexed from whatever part is seen."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def find(gray: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Corners (N, 2), px, and their whole-numbered cell coordinates (N, 2), from an image (H, W)."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(gray, (3, 3), flags)
    if not found:
        return np.empty((0, 2)), np.empty((0, 2))
    rows, columns = meta.shape
    x, y = np.tile(np.arange(columns), rows), np.repeat(np.arange(rows), columns)
    return np.asarray(corners, np.float64).reshape(-1, 2), np.column_stack([x, y]).astype(np.float64)

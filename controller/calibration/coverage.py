"""The picture of a lens calibration: where in the view corners were seen, and how well the lens is known."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration.board_search import BoardView
from controller.calibration.lens import CameraCalibration

Image = NDArray[np.uint8]

_WIDTH = 960
_CELLS = (8, 6)
_FOOT = 120
_INK, _PALE, _SEEN, _EMPTY = (60, 50, 40), (190, 185, 180), (214, 232, 205), (205, 205, 240)


def coverage_picture(views: Sequence[BoardView], made: CameraCalibration) -> Image:
    """Corners of all views over the picture's cells, (H, W, 3), dtype uint8, BGR; cells without any are marked.

    The outlines of the boards show tilts and sizes; below stands what came out of it.
    """
    width, height = made.camera.image_size
    scale = _WIDTH / width
    tall = round(height * scale)
    picture = np.full((tall + _FOOT, _WIDTH, 3), 255, np.uint8)
    points = np.vstack([view.image_points for view in views])
    for row in range(_CELLS[1]):
        for column in range(_CELLS[0]):
            low = np.array([column / _CELLS[0], row / _CELLS[1]])
            high = np.array([(column + 1) / _CELLS[0], (row + 1) / _CELLS[1]])
            share = points / [width, height]
            reached = bool(((share >= low) & (share < high)).all(axis=1).any())
            a, b = (np.rint(corner * [_WIDTH, tall]).astype(int) for corner in (low, high))
            cv2.rectangle(picture, a.tolist(), b.tolist(), _SEEN if reached else _EMPTY, -1)
            cv2.rectangle(picture, a.tolist(), b.tolist(), _PALE, 1)
    for index, view in enumerate(views):
        hue = np.array([[[179 * index // max(1, len(views)), 190, 170]]], np.uint8)
        colour = [int(v) for v in cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0]]
        hull = cv2.convexHull((view.image_points * scale).astype(np.float32))
        cv2.polylines(picture, [np.rint(hull).astype(np.int32)], True, colour, 1, cv2.LINE_AA)
        for u, v in np.rint(view.image_points * scale).astype(int):
            cv2.circle(picture, (int(u), int(v)), 2, colour, -1, cv2.LINE_AA)
    lens = made.camera.matrix
    focal = max(made.sigma.get("fx", 0.0), made.sigma.get("fy", 0.0)) / min(lens[0, 0], lens[1, 1])
    lines = (
        f"{made.views_used} views, {made.coverage:.0%} of the picture's cells reached; "
        f"focal length known to {focal:.2%}; lens model {made.model}",
        f"positions on a plane {made.distance_mm:.0f} mm away: {made.uncertainty_mm:.2f} mm at the 95th percentile "
        "over the picture, from the lens alone",
        f"reprojection RMS {made.rms_px:.3f} px (says little); left out: {len(made.views_rejected)}; "
        f"{made.calibration_id}",
    )
    for index, line in enumerate(lines):
        at = 12, tall + 34 + 30 * index
        cv2.putText(picture, line, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
    return picture

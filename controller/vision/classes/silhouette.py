"""A part's outline as a picture of the frame's own fineness, holes left out: what its form is measured on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection
from controller.vision.appearance.hole import blobs_like_table

_RIM = 0.07
"""Holes are looked for this share of the short side inside the outline."""


@dataclass(frozen=True, slots=True, eq=False)
class Silhouette:
    """One part.

    Attributes:
        solid: ndarray of shape (h, w), dtype uint8: 255 where the part is.
        corner: (x, y) of its first pixel in the frame.
        hole: Share of the outline where the table shows through.
    """

    solid: NDArray[np.uint8]
    corner: tuple[int, int]
    hole: float


def silhouette(
    image: NDArray[np.uint8], item: Detection, table: NDArray[np.float32], holed: bool
) -> Silhouette:
    """The silhouette of a detection.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8, BGR: the frame.
        item: The part.
        table: BGR codes (3,) of the table around it.
        holed: Whether there is a hole to look for.
    """
    height, width = image.shape[:2]
    x, y, w, h = item.bbox_px
    left, top = max(int(x) - 1, 0), max(int(y) - 1, 0)
    right, low = min(int(x + w) + 3, width), min(int(y + h) + 3, height)
    inside = np.zeros((max(low - top, 1), max(right - left, 1)), np.uint8)
    ring = np.rint((item.outline_px - (left, top)) * 16.0).astype(np.int32)[:, None]
    cv2.fillPoly(inside, [ring], (255,), shift=4)
    if not holed or low <= top or right <= left:
        return Silhouette(inside, (left, top), 0.0)
    core = inside.copy()
    wide = 2 * max(1, round(_RIM * item.size_px[1])) - 1
    cv2.polylines(core, [np.rint(ring / 16.0).astype(np.int32)], True, (0,), wide)
    planes = np.ascontiguousarray(image[top:low, left:right].transpose(2, 0, 1))
    found = blobs_like_table(planes[None], core[None] > 0, table[None], ["hole" in item.flags])[0]
    inside[found] = 0
    missing = int(np.count_nonzero(found))
    return Silhouette(inside, (left, top), missing / max(missing + cv2.countNonZero(inside), 1))

"""A part's outline as a picture of the frame's own fineness, holes left out: what its form is measured on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.appearance.hole import blob_like_table
from controller.vision.appearance.rings import SHIFT, Rings
from controller.vision.appearance.tiles import Tiles

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


def silhouettes(image: NDArray[np.uint8], surface: Tiles) -> list[Silhouette]:
    """The silhouettes of parts.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8, BGR: the frame.
        surface: The parts.
    """
    detections = surface.detections
    height, width = image.shape[:2]
    boxes = np.array([item.bbox_px for item in detections]).reshape(-1, 4)
    low = np.maximum(boxes[:, :2].astype(int) - 1, 0)
    high = np.minimum((boxes[:, :2] + boxes[:, 2:]).astype(int) + 3, (width, height))
    rings = Rings(detections).drawn(low.astype(np.float64), np.ones(len(boxes)))
    out = []
    for k, (ring, (left, top), (right, bottom)) in enumerate(zip(rings, low.tolist(), high.tolist(), strict=True)):
        solid = np.zeros((max(bottom - top, 1), max(right - left, 1)), np.uint8)
        cv2.fillPoly(solid, [ring], (255,), shift=SHIFT)
        hole = None
        if surface.holed[k] and bottom > top and right > left:
            core = solid.copy()
            wide = 2 * max(1, round(_RIM * detections[k].size_px[1])) - 1
            cv2.polylines(core, [ring], True, (0,), wide, shift=SHIFT)
            cut = image[top:bottom, left:right]
            hole = blob_like_table(cut, core, surface.alike[k])
        missing = 0.0
        if hole is not None:
            solid &= ~hole
            count = cv2.countNonZero(hole)
            missing = count / max(count + cv2.countNonZero(solid), 1)
        out.append(Silhouette(solid, (left, top), missing))
    return out

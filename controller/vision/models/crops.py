"""Parts cut out for a classifier: a square around each, with a little of the table, at the network's size."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection

Image = NDArray[np.uint8]


def crops(image: Image, detections: Sequence[Detection], margin: float, size: tuple[int, int]) -> Image:
    """(n, height, width, 3) squares around the detections.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8, BGR.
        detections: Parts.
        margin: Side of the square over the diameter of the circle around the part's centre.
        size: (height, width) of each result, px.
    """
    out = np.empty((len(detections), *size, 3), np.uint8)
    for k, item in enumerate(detections):
        radius = float(np.sqrt(((item.outline_px - item.center_px) ** 2).sum(axis=1).max()))
        out[k] = square(image, item.center_px, 2.0 * margin * radius, size)
    return out


def square(image: Image, center: tuple[float, float], side: float, size: tuple[int, int]) -> Image:
    """The square of `side` px about a centre, brought to (height, width); beyond the frame's rim, the rim repeats."""
    whole = max(4, math.ceil(side))
    x, y = (math.floor(c + 0.5 - whole / 2.0 + 0.5) for c in center)
    height, width = image.shape[:2]
    cut = image[max(0, y) : max(0, y + whole), max(0, x) : max(0, x + whole)]
    if not cut.size:
        return np.zeros((*size, 3), np.uint8)
    if cut.shape[0] < whole or cut.shape[1] < whole:
        above, left = max(0, -y), max(0, -x)
        below, right = max(0, y + whole - height), max(0, x + whole - width)
        cut = np.asarray(cv2.copyMakeBorder(cut, above, below, left, right, cv2.BORDER_REPLICATE), np.uint8)
    how = cv2.INTER_AREA if whole > min(size) else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(cut, size[::-1], interpolation=how), np.uint8)

"""Small shapes compared as pictures.

Of an outline of a dozen pixels the blur leaves hardly anything but corners, and profiles across sides avoid those. What
tells a disc from a hexagon there is the whole picture: each shape is drawn, blurred, and laid over the pixels.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.scene import Judged, Scene

Floats = NDArray[np.float64]

SMALL = 20.0
"""Root of the area, px, below which shapes are compared as pictures."""
_FINE = 8
"""Points of a pixel in each direction whose share covers it."""
_AROUND = 3.0
"""How far around an outline, px, the pixels count besides three blurs: neighbours do not."""


def looks_more_like(scene: Scene, item: Judged, other: Judged) -> bool:
    """Whether the pixels look more like `other` than like `item`, two outlines of one small thing."""
    outlines = item.outline, other.outline
    margin = 2.0 + _AROUND + 3.0 * max(item.refined.blur, other.refined.blur)
    height, width = scene.image.shape[:2]
    low = np.maximum(np.floor(np.minimum(*(o.min(axis=0) for o in outlines)) - margin), 0.0).astype(int)
    high = np.ceil(np.maximum(*(o.max(axis=0) for o in outlines)) + margin).astype(int) + 1
    high = np.minimum(high, [width, height])
    if (high - low < 4).any():
        return False
    patch = scene.image[low[1] : high[1], low[0] : high[0]].reshape(-1, 3).astype(np.float64)
    values = patch @ np.linalg.inv(np.linalg.cholesky(scene.noise)).T
    covers = [_cover(o - low, tuple(high - low), j.refined.blur) for o, j in zip(outlines, (item, other), strict=True)]
    near = np.maximum(*(_cover(o - low, tuple(high - low), 0.5 * _AROUND) for o in outlines)).ravel() > 0.02
    return _rest(values[near], covers[1].ravel()[near]) < _rest(values[near], covers[0].ravel()[near])


def _cover(outline: Floats, size: tuple[int, ...], blur: float) -> Floats:
    """Share of each pixel of a patch (width, height) that a blurred outline covers."""
    width, height = size
    fine = np.zeros((height * _FINE, width * _FINE), np.uint8)
    points = np.rint(((outline + 0.5) * _FINE - 0.5) * 256.0).astype(np.int32)
    cv2.fillPoly(fine, [points[:, None]], (255,), shift=8)
    cover = np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), np.float32) / np.float32(255.0)
    # A pixel's own width is a blur of 1/12 px^2.
    return np.asarray(cv2.GaussianBlur(cover, (0, 0), math.sqrt(max(blur**2 - 1.0 / 12.0, 0.04))), np.float64)


def _rest(values: Floats, cover: Floats) -> float:
    """Sum of squares (N, 3) that a shape's cover (N,) over an even ground leaves unexplained."""
    basis = np.stack([np.ones_like(cover), cover], axis=1)
    found = np.linalg.lstsq(basis, values, rcond=None)[0]
    return float(np.sum((values - basis @ found) ** 2))

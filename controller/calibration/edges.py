"""Straight printed edges in an image, to a few hundredths of a pixel."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SAMPLES = 13
_NO_MAP: Any = None


def offsets(gray: NDArray[np.uint8] | NDArray[np.float32], places: Array, normals: Array, reach: Array) -> Array:
    """How far (N,) an edge lies from places near it along their normals, px; nan where there is none.

    The centroid of the slope across the edge: blur, exposure and contrast leave it where it is, as long as
    nothing else comes within the reach.

    Args:
        gray: ndarray of shape (H, W).
        places: ndarray of shape (N, 2), px, within the reach of the edge.
        normals: ndarray of shape (N, 2), unit vectors.
        reach: ndarray of shape (N,), px: how far to look to either side.
    """
    across = reach[:, None] * np.linspace(-1.0, 1.0, _SAMPLES)
    middle = (across[:, 1:] + across[:, :-1]) / 2
    found = np.zeros(len(places))
    for _ in range(2):  # the second time the window is centred on the edge
        at = places[:, None] + (found[:, None] + across)[..., None] * normals[:, None]
        profile = cv2.remap(
            gray, at.astype(np.float32), _NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).astype(np.float64)
        rise = profile[:, -1] - profile[:, 0]
        # Slopes against the edge's own direction are noise.
        slope = np.maximum(np.diff(profile, axis=1) * np.sign(rise)[:, None], 0.0)
        total = slope.sum(axis=1)
        found = found + np.einsum("ns,ns->n", slope, middle) / np.maximum(total, 1e-9)
    height, width = gray.shape
    ends = places + found[:, None] * normals
    # Ten levels out of 255 stand clear of a webcam's noise.
    good = (np.abs(rise) > 10.0) & (np.abs(found) < reach)
    good &= ((ends > reach[:, None]) & (ends < np.array([width - 1, height - 1]) - reach[:, None])).all(axis=1)
    return np.where(good, found, np.nan)


def line(points: Array) -> Array:
    """Homogeneous line (3,) through points (N, 2), stray ones left out."""
    kept = points
    for _ in range(3):
        middle = kept.mean(axis=0)
        direction = np.linalg.svd(kept - middle)[2][0]
        off = np.abs((points - middle) @ np.array([direction[1], -direction[0]]))
        kept = points[off <= 3.0 * np.median(off) + 1e-9]
    return np.array([direction[1], -direction[0], direction[0] * middle[1] - direction[1] * middle[0]])

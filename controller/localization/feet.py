"""The foot of a part in the picture: whether an outline goes around it, or around it and its shadow as well.

A dark side face may be taken for a piece of the top face; the foot is then expected one strip too far out,
where the picture shows no edge, while there is one a strip further in than there should be.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Strips narrower than this cannot be told from the edge's own blur, px.
_NARROWEST = 2.0
#: The edge further in must be this much clearer than the one at the outline, ...
_CLEARER = 2.5
#: ... and this clear by itself, levels of 255 a pixel.
_LEAST = 4.0
#: More slope than this says no more about a side being there, levels of 255 a pixel.
_ENOUGH = 20.0
_STEP = 0.5
_ALONG = np.linspace(0.15, 0.85, 16)[:, None]


def corrected(image: NDArray[np.uint8], outline: Array, foot: Array, top: Array) -> Array | None:
    """The outline with every false foot moved in by its strip, or None when all are as the picture has them.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8.
        outline: ndarray of shape (N, 2), px.
        foot: ndarray of shape (K, 2), px: where the fitted prism has its foot's corners.
        top: ndarray of shape (K, 2), px: and those of its top face.
    """
    moved: Array | None = None
    middle = top.mean(axis=0)
    for a, b, c, d in zip(foot, np.roll(foot, -1, axis=0), top, np.roll(top, -1, axis=0), strict=True):
        length = float(np.linalg.norm(b - a))
        normal = np.array([b[1] - a[1], a[0] - b[0]]) / length
        normal *= np.sign(normal @ ((a + b) / 2 - middle))
        strip = float(normal @ ((a + b) - (c + d)) / 2)
        if strip < _NARROWEST or not _false(image, a, b, normal, strip):
            continue
        out = outline if moved is None else moved
        apart = out - a
        share = apart @ (b - a) / length**2
        on = (np.abs(apart @ normal) < 0.5 * strip) & (share > -0.02) & (share < 1.02)
        moved = out - np.where(on, strip, 0.0)[:, None] * normal
    return moved


def support(image: NDArray[np.uint8], foot: Array, top: Array) -> float:
    """How well the picture bears out a prism's silhouette: the slope across its sides, levels a pixel, summed.

    A side counts up to a limit, so that a bright one does not stand in for one that is not there.
    """
    middle = top.mean(axis=0)
    total = 0.0
    for a, b, c, d in zip(foot, np.roll(foot, -1, axis=0), top, np.roll(top, -1, axis=0), strict=True):
        normal = np.array([b[1] - a[1], a[0] - b[0]]) / float(np.linalg.norm(b - a))
        normal *= np.sign(normal @ ((a + b) / 2 - middle))
        near = normal @ ((a + b) - (c + d)) > 0.0
        start, end = (a, b) if near else (c, d)
        at, slope = _slope(image, start, end, normal, -2.0)
        total += min(float(slope[np.abs(at) <= 1.0].max()), _ENOUGH)
    return total


def _false(image: NDArray[np.uint8], a: Array, b: Array, normal: Array, strip: float) -> bool:
    """Whether the picture has an edge two strips inside the line from `a` to `b`, and none on it."""
    at, slope = _slope(image, a, b, normal, -2 * strip - 2.0)
    here, inside = (float(slope[np.abs(at + shift) <= 1.0].max()) for shift in (0.0, 2 * strip))
    return inside > _LEAST and inside > _CLEARER * here


def _slope(image: NDArray[np.uint8], a: Array, b: Array, normal: Array, low: float) -> tuple[Array, Array]:
    """Distances (M,) along the normal from `low` px to 2, and the slope (M,) there, levels a pixel."""
    across = np.arange(low, 2.0 + _STEP, _STEP)
    places = (a + _ALONG * (b - a))[:, None] + across[:, None] * normal
    seen = cv2.remap(image, places.astype(np.float32), np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = np.asarray(seen, np.float64).mean(axis=0)
    slope = np.linalg.norm(np.diff(profile, axis=0), axis=1) / _STEP
    return (across[1:] + across[:-1]) / 2, np.asarray(slope)

"""Unbiased polygons: masks whose half-way line lies on the true edge.

OpenCV's anti-aliased fill grows a shape by about 0.67 px on every side. Left alone, every painted part would
look 0.8 mm too wide and the localizer would learn a size that no real camera shows. Polygons are therefore
filled at a multiple of the resolution, drawn in by that much, and averaged down to a box-filtered coverage.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_backends.solids import Array

Mask = NDArray[np.uint8]
Region = tuple[int, int, int, int]  # x0, y0, x1, y1 of a picture; the ends excluded

# How far `fillConvexPoly` with LINE_AA grows a shape, px (0.60 along diagonals to 0.73 along the axes).
GROWTH = 0.665
_SHIFT = 8  # fractional bits of OpenCV's polygon coordinates


def offset(ring: Array, by: Array | float) -> Array:
    """A convex ring (N, 2) with each side moved outwards by `by` (scalar or one value a side: corner i to i + 1).

    The ring's orientation does not matter; corners closer than 1e-3 px to the next must not occur.
    """
    along = np.empty_like(ring)
    along[:-1] = ring[1:] - ring[:-1]
    along[-1] = ring[0] - ring[-1]
    doubled_area = float((ring[:, 0] * along[:, 1] - ring[:, 1] * along[:, 0]).sum())
    length = np.sqrt((along**2).sum(axis=1))
    if doubled_area < 0.0:
        length = -length
    normal = np.empty_like(ring)
    normal[:, 0] = along[:, 1] / length
    normal[:, 1] = along[:, 0] / -length
    before = np.concatenate([normal[-1:], normal[:-1]])
    cosine = (before * normal).sum(axis=1)
    flat = cosine > 0.999
    if isinstance(by, np.ndarray):
        moved = np.concatenate([by[-1:], by[:-1]])
        # Almost parallel lines moved by different amounts meet far away: such a corner goes half-way instead.
        flat |= (cosine > 0.9) & (moved != by)
    # A needle's point would move far; it moves four times the offset at most.
    determinant = np.where(flat, 1.0, np.maximum(1.0 - cosine**2, np.where(cosine < 0.0, 0.05, 0.0)))
    if isinstance(by, np.ndarray):
        a = np.where(flat, 0.5 * (moved + by), moved - cosine * by) / determinant
        b = np.where(flat, 0.0, by - cosine * moved) / determinant
    else:
        a = by * np.where(flat, 1.0, 1.0 - cosine) / determinant
        b = np.where(flat, 0.0, a)
    return np.asarray(ring + a[:, None] * before + b[:, None] * normal)


def fill(mask: NDArray[np.uint8], ring: Array, colour: float | Sequence[float]) -> None:
    """Fill a nearly convex ring of pixels (N, 2), anti-aliased, as OpenCV does it: grown by `GROWTH`."""
    points = np.rint(ring * (1 << _SHIFT)).astype(np.int32)
    cv2.fillConvexPoly(mask, points, colour, cv2.LINE_AA, _SHIFT)


def clean(ring: Array) -> Array:
    """The ring without corners that repeat the next one."""
    return ring[distinct(ring)]


def distinct(ring: Array) -> NDArray[np.bool_]:
    """Which corners of a ring (N, 2) are not the same as the next."""
    step = np.empty_like(ring)
    step[:-1] = ring[1:] - ring[:-1]
    step[-1] = ring[0] - ring[-1]
    return np.asarray((np.abs(step) > 1e-2).any(axis=1))


def coverage(ring: Array, region: Region, oversample: int) -> Mask:
    """Share of each pixel of `region` that lies inside a nearly convex ring, 0..255.

    Args:
        ring: ndarray of shape (N, 2), px of the picture.
        region: Which part of the picture.
        oversample: Fine pixels per pixel and direction.
    """
    x0, y0, x1, y1 = region
    fine = (ring - (x0, y0) + 0.5) * oversample - 0.5
    mask = np.zeros(((y1 - y0) * oversample, (x1 - x0) * oversample), np.uint8)
    fill(mask, offset(fine, -GROWTH), 255)
    if oversample == 1:
        return mask
    return np.asarray(cv2.resize(mask, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA), np.uint8)


def region_of(ring: Array, size: tuple[int, int], margin: int = 2) -> Region | None:
    """The pixels around a ring that lie inside a picture of `size` (width, height), or None."""
    low, high = ring.min(axis=0), ring.max(axis=0)
    x0, y0 = max(0, int(np.floor(low[0])) - margin), max(0, int(np.floor(low[1])) - margin)
    x1, y1 = min(size[0], int(np.ceil(high[0])) + margin + 1), min(size[1], int(np.ceil(high[1])) + margin + 1)
    return (x0, y0, x1, y1) if x1 > x0 and y1 > y0 else None


def blend(picture: NDArray[np.uint8], patch: NDArray[np.uint8], mask: Mask, region: Region) -> None:
    """Lay `patch` over a region of the picture, as opaque as the mask says."""
    x0, y0, x1, y1 = region
    under = picture[y0:y1, x0:x1]
    alpha = cv2.merge([mask, mask, mask])
    # under + (patch - under) * alpha, in 8 bits without overflow.
    inverse = cv2.bitwise_not(alpha)
    cv2.add(
        cv2.multiply(under, inverse, scale=1 / 255.0), cv2.multiply(patch, alpha, scale=1 / 255.0), dst=under
    )

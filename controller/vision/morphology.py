"""Binary pictures: filling, opening, components, and what the toolbox measures on them.

Masks are uint8, 0 outside and 1 inside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.uint8]
Floats = NDArray[np.float64]


def fill_holes(mask: Mask, connectivity: int = 4) -> Mask:
    """The mask with everything filled that the background cannot reach from outside (`imfill(..., 'holes')`).

    Args:
        mask: The mask.
        connectivity: How the background is connected: 4 (the default of the toolbox) or 8.
    """
    padded = cv2.copyMakeBorder(mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    cv2.floodFill(padded, None, (0, 0), 2, flags=connectivity)
    return np.ascontiguousarray(padded[1:-1, 1:-1] != 2).astype(np.uint8)


def area_open(mask: Mask, pixels: int, connectivity: int = 8) -> Mask:
    """The mask without components of fewer than `pixels` pixels (`bwareaopen`)."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=connectivity, ltype=cv2.CV_32S)
    keep = (stats[:, cv2.CC_STAT_AREA] >= pixels).astype(np.uint8)
    keep[0] = 0
    return np.asarray(keep[labels], np.uint8)


def disk(radius: int) -> Mask:
    """Disk x^2 + y^2 <= r^2: `strel('disk', r, 0)`; the toolbox's default approximates it for r >= 3."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return np.asarray(x * x + y * y <= radius * radius, np.uint8)


def open_disk(mask: Mask, radius: int) -> Mask:
    """Erosion and dilation by a disk (`imopen`); outside the picture counts as whatever changes nothing."""
    return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, disk(radius)), np.uint8)


def close_disk(mask: Mask, radius: int) -> Mask:
    """Dilation and erosion by a disk (`imclose`)."""
    padded = cv2.copyMakeBorder(mask, radius, radius, radius, radius, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disk(radius))
    return np.ascontiguousarray(closed[radius:-radius, radius:-radius]) if radius else mask.copy()


def bwarea(mask: Mask) -> float:
    """Area of the `on` pixels, every 2 x 2 window weighed by its pattern (`bwarea`).

    One pixel on counts 1/4, two neighbours 1/2, two across 3/4, three 7/8, four 1.
    """
    m = np.pad(mask, 1).astype(np.int32)
    a, b, c, d = m[:-1, :-1], m[:-1, 1:], m[1:, :-1], m[1:, 1:]
    total = a + b + c + d
    across = (total == 2) & (a == d)
    weights = np.array([0.0, 0.25, 0.5, 0.875, 1.0])
    return float(np.bincount(total.ravel(), minlength=5) @ weights + 0.25 * across.sum())


def boundary(mask: Mask) -> NDArray[np.int32]:
    """Pixels (N, 2) as (x, y) of the outer boundary of a mask with one component, 8-connected (`bwboundaries`).

    A one-pixel-wide part is walked there and back, as in the toolbox.
    """
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(max(contours, key=len)[:, 0], np.int32)


def chain_length(points: NDArray[np.int32]) -> float:
    """Length of a closed chain of boundary pixels (N, 2): the sum of its Euclidean steps."""
    steps = np.roll(points, -1, axis=0) - points
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """One 8-connected component (`bwconncomp`, `regionprops`), pixels 0-based with integers at their centres.

    Attributes:
        mask: ndarray of shape (h, w), dtype uint8: the component alone, within its bounding box.
        area: Number of pixels.
        centroid: (x, y).
        bbox: (x, y, width, height): the box around the pixels' squares, so x and y end in .5.
        major, minor: Axes of the ellipse with the same second moments, px.
        orientation: Its major axis, degrees, counter-clockwise as displayed, in (-90, 90].
    """

    mask: Mask
    area: int
    centroid: tuple[float, float]
    bbox: tuple[float, float, float, float]
    major: float
    minor: float
    orientation: float


def components(mask: Mask) -> list[Component]:
    """The 8-connected components of a mask, in the toolbox's order: by their first pixel, column by column."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_32S)
    found: list[tuple[int, int, Component]] = []
    for label in range(1, count):
        x, y, w, h = (int(v) for v in stats[label, :4])
        own = np.ascontiguousarray(labels[y : y + h, x : x + w] == label).astype(np.uint8)
        ys, xs = np.nonzero(own)
        found.append((x, y + int(np.flatnonzero(own[:, 0])[0]), _component(own, xs, ys, x, y)))
    return [item for _, _, item in sorted(found, key=lambda item: item[:2])]


def _component(own: Mask, xs: NDArray[np.intp], ys: NDArray[np.intp], x: int, y: int) -> Component:
    cx, cy = float(xs.mean()), float(ys.mean())
    # 1/12 is the second moment of one pixel's own square.
    uxx = float(((xs - cx) ** 2).mean()) + 1.0 / 12.0
    uyy = float(((ys - cy) ** 2).mean()) + 1.0 / 12.0
    uxy = float(-((xs - cx) * (ys - cy)).mean())
    common = math.hypot(uxx - uyy, 2.0 * uxy)
    major = 2.0 * math.sqrt(2.0) * math.sqrt(uxx + uyy + common)
    minor = 2.0 * math.sqrt(2.0) * math.sqrt(max(uxx + uyy - common, 0.0))
    if uyy > uxx:
        top, bottom = uyy - uxx + common, 2.0 * uxy
    else:
        top, bottom = 2.0 * uxy, uxx - uyy + common
    if top == 0.0 and bottom == 0.0:
        orientation = 0.0
    else:
        orientation = math.degrees(math.atan2(top, bottom))
        orientation = orientation - 180.0 if orientation > 90.0 else orientation
        orientation = orientation + 180.0 if orientation <= -90.0 else orientation
    h, w = own.shape
    return Component(own, len(xs), (cx + x, cy + y), (x - 0.5, y - 0.5, float(w), float(h)), major, minor, orientation)

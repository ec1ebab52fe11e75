"""The first tier: what stands out clearly and alone is measured at once.

Most objects are a plain shape of strong contrast on an empty patch of table. The line where such an object's
strength falls to half is its outline to a fraction of a pixel, so that a few Gauss-Newton steps on the families and
one look at the pixels around the winner decide it. What is not seen completely then, or does not fit well, is left
to the second tier (`thorough`).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.contours import Standing
from controller.vision.fitting import edges_of, fit_at_once
from controller.vision.local_map import local_maps
from controller.vision.profiles import bilinear
from controller.vision.proposals import Region
from controller.vision.robust import median
from controller.vision.scene import Judged, Scene, whole
from controller.vision.small import SMALL
from controller.vision.trial import tried

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

_POINTS = 48
"""Points of an outline."""
_SAMPLES = 16
"""Places looked at across the outline at each of them."""
_OUTSIDE, _DEEPEST = 1.0, 6.0
"""How far outwards and inwards, px of the searched image: the strength of a blurred edge has fallen to half by then."""
_SHALLOW = 0.75
"""... but no farther inwards than this share of the object's mean radius."""
_CONVEX = 0.93
"""Area over the hull's, above which a region may be one convex object."""
_COMPLETE = 0.95
"""Share of the points where the outline must be found."""
_ON_OUTLINE = 0.9
"""Share of the points that must lie on the best family's outline."""
_GROWN, _GROWN_SHARE = 0.6, 0.01
"""How much the root of the area may change, px of the searched image and share: its blur rounds corners off."""
_DOUBT = 1.5
"""Another family is tried as well when its cost is within this ratio, ..."""
_DOUBT_COST = 0.03
"""... or this much, of the best one's; all are where the shape is small."""


def clear_objects(scene: Scene, strength: Floats32, standing: Standing, smallest: float) -> tuple[Scene, list[Judged]]:
    """Objects that need no further guess.

    Args:
        scene: The frame; its regions and maps are not looked at.
        strength: ndarray of shape (H, W), dtype float32: how far the searched image differs from the table.
        standing: What stands out there.
        smallest: Smallest area, px of the searched image.

    Returns:
        The scene with the regions looked at, and the objects.
    """
    regions = _alone(standing, smallest)
    points, found = _half_lines(strength, regions)
    points = points * scene.factor + (scene.factor - 1) / 2.0
    use = found.mean(axis=1) >= _COMPLETE
    if scene.plane is not None and len(points):
        # Beyond the horizon of the plane there is nothing to measure.
        use &= np.isfinite(scene.plane.to_plane(points.reshape(-1, 2))).reshape(len(points), -1).all(axis=1)
    regions = [region for region, yes in zip(regions, use, strict=True) if yes]
    points, found = points[use], found[use]
    centers = points.mean(axis=1)
    shifted = points - centers[:, None]
    reach = np.hypot(shifted[..., 0], shifted[..., 1]).max(axis=1, initial=0.0)
    maps = local_maps(centers, (reach + 6.0 * scene.factor) * 1.3, scene.plane)
    scene = scene.with_regions(regions, maps)
    if not regions:
        return scene, []
    local = maps.all_to_local(points)
    edges = edges_of(local[:, :, None], found[..., None].astype(np.float64))
    wanted = fit_at_once(local, edges, scene.factor, _plausible)
    return scene, [item for item in tried(scene, wanted, 1.0) if whole(item) and _stayed(item, scene.factor)]


def _plausible(cost: Floats, inliers: Floats, size: Floats) -> NDArray[np.bool_]:
    """Which of the fits (F, K) of families to outlines may be the right ones."""
    cost = np.where(np.isnan(cost), np.inf, cost)
    best = cost.min(axis=0)
    near = (cost <= np.maximum(_DOUBT * best, best + _DOUBT_COST)) | (size < SMALL)
    return np.asarray(near & (inliers[cost.argmin(axis=0), np.arange(cost.shape[1])] > _ON_OUTLINE))


def _stayed(item: Judged, factor: int) -> bool:
    """Whether the pixels leave an outline about as large as its line of half strength."""
    size = item.hypothesis.size
    return abs(math.sqrt(item.area) - size) < _GROWN * factor + _GROWN_SHARE * size


def _alone(standing: Standing, smallest: float) -> list[Region]:
    """Convex regions of what stands out that do not reach the image's rim."""
    height, width = standing.mask.shape
    out = []
    for contour in standing.contours:
        if len(contour) < 12:
            continue
        x, y, w, h = cv2.boundingRect(contour)
        if x < 2 or y < 2 or x + w > width - 2 or y + h > height - 2 or w * h > 0.8 * height * width:
            continue
        rim = 0.5 * len(contour) + 1.0
        area = cv2.contourArea(contour) + rim
        if area < smallest or area < _CONVEX * (cv2.contourArea(cv2.convexHull(contour)) + rim):
            continue
        out.append(Region(contour[:, 0].astype(np.float32), area, "alone", 1.0, core=True))
    return out


def _half_lines(strength: Floats32, regions: list[Region]) -> tuple[Floats, NDArray[np.bool_]]:
    """Points (K, _POINTS, 2) where the strength of each region is half of what it is in its middle, px.

    Returns:
        The points, and which of them were found.
    """
    if not regions:
        return np.empty((0, _POINTS, 2)), np.zeros((0, _POINTS), bool)
    count = np.array([len(region.contour) for region in regions])
    first = (np.cumsum(count) - count)[:, None]
    count = count[:, None]
    contour = np.concatenate([region.contour for region in regions])
    at = np.arange(_POINTS) * count // _POINTS
    # A pixel's contour turns by 45 degrees at every step: its direction is that over some of them.
    apart = np.maximum(2, count // 40)
    start = contour[first + at]
    along = contour[first + (at + apart) % count] - contour[first + (at - apart) % count]
    inwards = np.stack([along[..., 1], -along[..., 0]], axis=2)
    inwards /= np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-6)[..., None]
    radius = np.sqrt(np.array([region.area for region in regions]) / math.pi)
    step = (np.minimum(_SHALLOW * radius, _DEEPEST) + _OUTSIDE) / (_SAMPLES - 1)
    depth = (step[:, None] * np.arange(_SAMPLES) - _OUTSIDE).astype(np.float32)
    x, y = (start[..., i, None] + inwards[..., i, None] * depth[:, None] for i in (0, 1))
    values = bilinear(strength, x, y)[..., 0]
    middle = start.mean(axis=1, keepdims=True)
    inner = np.rint(middle + 0.4 * (start - middle)).astype(np.intp)
    half = 0.5 * median(strength[inner[..., 1], inner[..., 0]], 1)[:, None]
    above = values > half[..., None]
    after = above.argmax(axis=2)
    found = after > 0
    flat = np.arange(after.size).reshape(after.shape) * _SAMPLES + np.maximum(after, 1)
    low, high = values.ravel()[flat - 1], values.ravel()[flat]
    share = (half - low) / np.maximum(high - low, 1e-6)
    crossing = (np.maximum(after, 1) - 1 + share) * step[:, None] - _OUTSIDE
    points = start + inwards * crossing[..., None]
    return points.astype(np.float64), found

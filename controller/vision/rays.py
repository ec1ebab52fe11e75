"""Edges along rays from inside a region: a few sub-pixel candidates on each, for all regions at once."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.profiles import bilinear

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

RAYS = 64
SAMPLES = 28
CHOICES = 3


def radial_profiles(contours: Sequence[Floats32], centers: Floats) -> Floats:
    """Radii (K, RAYS) of K contours' hulls seen from a point (K, 2) inside each, at equal angles."""
    hulls = [cv2.convexHull(contour)[:, 0] for contour in contours]
    count = np.array([len(hull) for hull in hulls])
    ends = np.cumsum(count)
    hull = np.concatenate(hulls).astype(np.float64) - np.repeat(centers, count, axis=0)
    after = np.arange(1, len(hull) + 1)
    after[ends - 1] = ends - count
    edge = hull[after] - hull
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    reach = np.vecdot(normal, hull)
    normal = np.where(reach[:, None] < 0.0, -normal, normal)
    reach = np.abs(reach)
    along = normal @ DIRECTIONS.T
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = np.where(along > 1e-9, reach[:, None] / along, np.inf)
    return np.asarray(np.minimum.reduceat(hit, ends - count, axis=0))


_TURNS = np.arange(RAYS) * 2.0 * math.pi / RAYS
DIRECTIONS: Floats = np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1)


def find_edges(
    image: Floats32, units: Floats, centers: Floats, radii: Floats, window: Floats
) -> tuple[Floats, Floats]:
    """The strongest edges on each ray.

    Args:
        image: ndarray of shape (H, W, 3), dtype float32.
        units: ndarray of shape (K, 3, 3): what steps of the image are multiplied by before they are measured.
        centers: ndarray of shape (K, 2).
        radii: ndarray of shape (K, RAYS): where the edge is expected.
        window: ndarray of shape (K,): how far to either side to look, px.

    Returns:
        edges (K, RAYS, CHOICES, 2) and their strengths (K, RAYS, CHOICES), in `units`; 0 where there is none.
    """
    step = 2.0 * window / (SAMPLES - 1)
    start = np.maximum(radii - window[:, None], 0.15 * radii)
    t = start[..., None] + step[:, None, None] * np.arange(SAMPLES)
    x = centers[:, None, None, 0] + t * DIRECTIONS[:, 0, None]
    y = centers[:, None, None, 1] + t * DIRECTIONS[:, 1, None]
    values = bilinear(image, x.astype(np.float32), y.astype(np.float32))
    slope = (values[:, :, 2:] - values[:, :, :-2]) @ units.transpose(0, 2, 1)[:, None].astype(np.float32)
    slope[:, :, 1:-1] = 0.5 * slope[:, :, 1:-1] + 0.25 * (slope[:, :, 2:] + slope[:, :, :-2])
    strength = np.sqrt(np.einsum("krsc,krsc->krs", slope, slope))
    return _peaks(strength, t, centers)


def _peaks(strength: Floats32, t: Floats, centers: Floats) -> tuple[Floats, Floats]:
    """The CHOICES highest local maxima of every ray, refined by a parabola."""
    middle = strength[:, :, 1:-1]
    low, high = strength[:, :, :-2], strength[:, :, 2:]
    is_peak = (middle > low) & (middle >= high)
    score = np.where(is_peak, middle, 0.0)
    order = np.argpartition(-score, CHOICES - 1, axis=2)[:, :, :CHOICES]
    k = np.arange(order.shape[0])[:, None, None]
    r = np.arange(order.shape[1])[:, None]
    weight = score[k, r, order]
    a, b, c = low[k, r, order], middle[k, r, order], high[k, r, order]
    bend = a - 2.0 * b + c
    shift = np.where(bend < -1e-9, 0.5 * (a - c) / np.where(bend < -1e-9, bend, -1.0), 0.0)
    step = t[:, :, 1] - t[:, :, 0]
    at = t[:, :, 0][..., None] + (order + 2 + np.clip(shift, -0.5, 0.5)) * step[..., None]
    edges = centers[:, None, None] + at[..., None] * DIRECTIONS[None, :, None]
    return edges, np.asarray(weight, np.float64)

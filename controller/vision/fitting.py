"""First fits of every family to the edges around every region: good to a fraction of a pixel of the searched image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from controller.vision.rays import DIRECTIONS
from controller.vision.shapes import (
    CIRCLE,
    FAMILIES,
    HEXAGON,
    RECTANGLE,
    TRIANGLE,
    Family,
    area,
    edge_residuals,
    fit_edges,
    from_polygon,
)

Floats = NDArray[np.float64]

_ROUGH = (0, 1, 2)
"""Steps after which the families that do not suit a region are plain."""
_FINE = (3, 4, 5)
"""Steps that bring the others to the end."""
_SIXTH = np.exp(6j * np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]))


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One family fitted to the edges around one region.

    Attributes:
        region: Which region.
        family: Which family.
        q: Its parameters, local coordinates.
        cost: Clipped distance of the edges, 0 (all on the outline) to 1.
        inliers: Share of rays with an edge on the outline.
        size: Root of the outline's area.
    """

    region: int
    family: Family
    q: Floats
    cost: float
    inliers: float
    size: float


def fit_all(hulls: list[Floats], edges: Floats, weight: Floats, factor: int) -> list[list[Hypothesis]]:
    """For every region, its fits to the two families that suit it best, best first.

    All families are fitted roughly, on every other ray; the best two are fitted to the end.
    """
    starts: dict[Shape, list[Floats]] = {shape: [] for shape in FAMILIES}
    for hull in hulls:
        for shape, start in _starts(hull).items():
            starts[shape].append(start)
    relative = weight / np.maximum(np.median(weight[:, :, 0], axis=1), 1e-9)[:, None, None]
    light = np.asarray(np.where(weight > 0.0, np.clip(relative, 0.0, 1.0), 0.0), np.float32)
    points = edges.astype(np.float32)
    half = np.ascontiguousarray(points[:, ::2]), np.ascontiguousarray(light[:, ::2])
    rough: list[Floats] = []
    costs = np.empty((len(FAMILIES), len(hulls)))
    for i, family in enumerate(FAMILIES.values()):
        q = np.array(starts[family.shape])
        q = fit_edges(family, q, *half, _scale(family, q, factor), _ROUGH)
        rough.append(q)
        costs[i] = _quality(family, q, *half, factor)[0]
    rank = np.nan_to_num(costs, nan=np.inf).argsort(axis=0, kind="stable").argsort(axis=0, kind="stable")
    out: list[list[Hypothesis]] = [[] for _ in hulls]
    for family, start, place in zip(FAMILIES.values(), rough, rank, strict=True):
        rows = np.flatnonzero((place < 2) & np.isfinite(start).all(axis=1))
        near = points[rows], light[rows]
        q = fit_edges(family, start[rows], *near, _scale(family, start[rows], factor), _FINE)
        cost, inliers, size = _quality(family, q, *near, factor)
        for k, region in enumerate(rows.tolist()):
            if np.isfinite(q[k]).all():
                out[region].append(
                    Hypothesis(region, family, q[k], float(cost[k]), float(inliers[k]), float(size[k]))
                )
    for hypotheses in out:
        hypotheses.sort(key=lambda h: h.cost)
    return out


def _scale(family: Family, q: Floats, factor: int) -> Floats:
    """How near to the outline (K,) edges must finally be to count."""
    return np.maximum(0.5 * factor, 0.008 * np.sqrt(np.maximum(area(family, q), 1.0)))


def _quality(
    family: Family, q: Floats, edges: NDArray[np.float32], weight: NDArray[np.float32], factor: int
) -> tuple[Floats, Floats, Floats]:
    """Cost, share of inliers and size (K,) of fitted outlines, see `Hypothesis`."""
    distance, strength = edge_residuals(family, q, edges, weight)
    size = np.sqrt(np.maximum(area(family, q), 1.0))
    tolerance = np.maximum(0.7 * factor, 0.02 * size)[:, None]
    off = np.abs(distance)
    valid = strength > 0.15
    inliers = np.mean((off < tolerance) & valid, axis=1)
    clipped = np.where(valid, np.minimum(off, tolerance), tolerance)
    return np.sqrt(np.mean(clipped**2, axis=1)) / tolerance[:, 0], inliers, size


def _starts(hull: Floats) -> dict[Shape, Floats]:
    """Rough parameters of every family for one convex outline."""
    points = hull.astype(np.float32)
    (cx, cy), (w, h), turn = cv2.minAreaRect(points)
    m = cv2.moments(points)
    covered = max(m["m00"], 1.0)
    center = np.array([m["m10"], m["m01"]]) / m["m00"] if m["m00"] > 1e-6 else hull.mean(axis=0)
    rectangle = np.array([cx, cy, max(w, 1.0) / 2, max(h, 1.0) / 2, math.radians(turn)])
    circle = np.array([*center, math.sqrt(covered / math.pi)])
    # The sixth harmonic of the support function points at the sides' normals.
    reach = (hull - center) @ DIRECTIONS.T
    support = reach.max(axis=0)
    phase = np.angle(support @ _SIXTH)
    hexagon = np.array([*center, math.sqrt(covered / (2.0 * math.sqrt(3.0))), phase / 6.0 + math.pi / 6.0])
    # Three far corners of the hull: the farthest from the centre, from that, and from the line between both.
    first = hull[np.argmax(np.sum((hull - center) ** 2, axis=1))]
    second = hull[np.argmax(np.sum((hull - first) ** 2, axis=1))]
    along = second - first
    third = hull[np.argmax(np.abs((hull[:, 0] - first[0]) * along[1] - (hull[:, 1] - first[1]) * along[0]))]
    triangle = from_polygon(np.stack([first, second, third]))
    return {CIRCLE.shape: circle, HEXAGON.shape: hexagon, RECTANGLE.shape: rectangle, TRIANGLE.shape: triangle}

"""First fits of every family to the edges around every region: good to a fraction of a pixel of the searched image.

All polygons of all regions are fitted at once, as rows of padded parameters (cx, cy, three sizes, three turns) with
six sides each; circles beside them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from controller.vision.padded import KINDS, OWN, PARAMETERS, POLYGONS, ROUND, Rows, areas
from controller.vision.rays import DIRECTIONS, RAYS
from controller.vision.robust import median, tukey
from controller.vision.shapes import TRIANGLE, Family

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

_SIDES = max(len(family.normals) for family in POLYGONS)
# Sides beyond a family's own repeat its first one.
_PLACE = [np.where(np.arange(_SIDES) < len(f.normals), np.arange(_SIDES), 0) for f in POLYGONS]
_NORMALS = np.array([f.normals[place] for f, place in zip(POLYGONS, _PLACE, strict=True)])
_SIZE_OF = np.array([2 + f.size_of[place] for f, place in zip(POLYGONS, _PLACE, strict=True)])
_TURN_OF = np.array([5 + f.turn_of[place] for f, place in zip(POLYGONS, _PLACE, strict=True)])
_MOVES = np.array([-1.0 if f.moves else 0.0 for f in POLYGONS], np.float32)
# Which parameters each side follows: -1 for its size, 1 for its turn.
_FOLLOWS: Floats32 = np.array(
    [
        [[-1.0 if s == 2 + i else 0.0 for i in range(3)] + [1.0 if t == 5 + i else 0.0 for i in range(3)]
         for s, t in zip(sizes, turns, strict=True)]
        for sizes, turns in zip(_SIZE_OF, _TURN_OF, strict=True)
    ],
    np.float32,
)  # fmt: skip
_SIXTH = np.exp(6j * np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]))
_RIDGE = 1e-5 * np.eye(PARAMETERS)
_ROUGH, _FINE, _AT_ONCE = (0, 1, 2), (3, 4, 5), (1, 4)
"""Numbers of the Gauss-Newton steps after which the families that do not suit a region are plain, of those that bring
the others to the end, and of those that are enough among edges of one outline."""
_TINY = 10.0
"""Root of the area, px of the searched image, below which the blur makes all families look alike."""


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
        top: It was not fitted, but is where the top face would be within a silhouette.
    """

    region: int
    family: Family
    q: Floats
    cost: float
    inliers: float
    size: float
    top: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Where edges were found around K regions: C candidates on each of M rays.

    Attributes:
        points: ndarray of shape (K, 3, M * C), dtype float32: x, y, 1.
        weight: ndarray of shape (K, M, C), dtype float32, 0 where there is no edge.
    """

    points: Floats32
    weight: Floats32

    def some(self, rows: Rows | slice) -> Edges:
        """The edges of some regions, or of some again and again."""
        return Edges(self.points[rows], self.weight[rows])

    def coarser(self) -> Edges:
        """The edges of every other ray."""
        count, rays, choices = self.weight.shape
        points = self.points.reshape(count, 3, rays, choices)[:, :, ::2]
        return Edges(points.reshape(count, 3, -1), self.weight[:, ::2])


Plausible = Callable[[Floats, Floats, Floats], NDArray[np.bool_]]
Model = Callable[[Rows, Floats, Edges, Floats32 | None], tuple[Floats32, Floats32]]


def edges_of(places: Floats, weight: Floats) -> Edges:
    """Edges from their places (K, M, C, 2), local coordinates, and strengths (K, M, C)."""
    relative = weight / np.maximum(median(weight[:, :, 0], 1), 1e-9)[:, None, None]
    points = np.ones((len(places), 3, weight[0].size if len(weight) else 0), np.float32)
    points[:, :2] = places.reshape(len(places), -1, 2).transpose(0, 2, 1)
    return Edges(points, np.minimum(relative, 1.0).astype(np.float32))


def fit_at_once(outlines: Floats, edges: Edges, factor: int, plausible: Plausible) -> list[Hypothesis]:
    """Plausible fits of all families, where there are no stray edges to find a way between: region by region.

    Args:
        outlines: ndarray of shape (K, N, 2): points of the outline of each region, local coordinates.
        edges: The edges around each, one a ray.
        factor: How many times smaller the searched image is: so much worse the edges are known.
        plausible: Of the costs, shares of inliers and sizes (F, K) of F families, which are worth a look.
    """
    count = len(outlines)
    kind, region = _every(count)
    near = edges.some(region)
    q = _fit(kind, _starts(outlines), near, factor, _AT_ONCE)
    quality = _quality(kind, q, near, factor)
    chosen = plausible(*(values.reshape(len(KINDS), count) for values in quality)).ravel()
    return list(chain.from_iterable(_hypotheses(kind, region, q, quality, count, chosen)))


def fit_all(outlines: Floats, edges: Edges, factor: int) -> list[list[Hypothesis]]:
    """For every region, its fits to the two families that suit it best, best first; of what is tiny, to all.

    All families are fitted roughly, on every other ray; the best two are fitted to the end.

    Args:
        outlines: ndarray of shape (K, N, 2): points of a rough convex outline of each region, local coordinates.
        edges: The edges around each.
        factor: How many times smaller the searched image is: so much worse the edges are known.
    """
    count = len(outlines)
    kind, region = _every(count)
    half = edges.coarser().some(region)
    q = _fit(kind, _starts(outlines), half, factor, _ROUGH)
    cost, _, size = (values.reshape(len(KINDS), count) for values in _quality(kind, q, half, factor))
    place = np.argsort(np.argsort(np.where(np.isnan(cost), np.inf, cost), axis=0, kind="stable"), axis=0)
    tiny = np.fmin.reduce(size, axis=0) < _TINY * factor
    rows = np.flatnonzero(((place < 2) | tiny).ravel())
    rows = rows[np.isfinite(q[rows]).all(axis=1)]
    kind, region = kind[rows], region[rows]
    near = edges.some(region)
    q = _fit(kind, q[rows], near, factor, _FINE)
    return _hypotheses(kind, region, q, _quality(kind, q, near, factor), count)


def _every(count: int) -> tuple[Rows, Rows]:
    """Kinds and regions (4 K,) of the rows that fit every family to each of K regions."""
    return np.repeat(np.arange(len(KINDS)), count), np.tile(np.arange(count), len(KINDS))


def _hypotheses(
    kind: Rows, region: Rows, q: Floats, quality: tuple[Floats, Floats, Floats], count: int,
    chosen: NDArray[np.bool_] | bool = True,
) -> list[list[Hypothesis]]:
    """Those of the fits (R,) to each of `count` regions that are chosen, best first."""
    cost, inliers, size = quality
    out: list[list[Hypothesis]] = [[] for _ in range(count)]
    usable = np.isfinite(q).all(axis=1) & chosen
    order = np.flatnonzero(usable)[np.argsort(cost[usable], kind="stable")]
    told = (values[order].tolist() for values in (kind, region, cost, inliers, size))
    for own, k, at, *figures in zip(q[order], *told, strict=True):
        out[at].append(Hypothesis(at, KINDS[k], own[OWN[k]], *figures))
    return out


def _starts(outlines: Floats) -> Floats:
    """Rough parameters (4 K, 8) of every family for outlines (K, N, 2): those of the first family first."""
    count = len(outlines)
    x, y = outlines[..., 0], outlines[..., 1]
    after = np.concatenate([outlines[:, 1:], outlines[:, :1]], axis=1)
    cross = x * after[..., 1] - after[..., 0] * y
    twice = cross.sum(axis=1)
    twice = np.where(np.abs(twice) < 1e-6, 1e-6, twice)
    center = ((outlines + after) * cross[..., None]).sum(axis=1) / (3.0 * twice)[:, None]
    covered = np.maximum(0.5 * np.abs(twice), 1.0)
    out = np.zeros((len(KINDS), count, PARAMETERS))
    out[:, :, :2] = center
    out[ROUND, :, 2] = np.sqrt(covered / math.pi)
    shifted = outlines - center[:, None]
    support = (shifted @ DIRECTIONS.T).max(axis=1)
    # The sixth harmonic of the support function points at the sides' normals.
    out[0, :, 2] = np.sqrt(covered / (2.0 * math.sqrt(3.0)))
    out[0, :, 5] = np.angle(support @ _SIXTH) / 6.0 + math.pi / 6.0
    # The smallest rectangle around it, to the next of the directions.
    quarter = RAYS // 4
    width = support[:, : 2 * quarter] + support[:, 2 * quarter :]
    turn = (width[:, :quarter] * width[:, quarter:]).argmin(axis=1)
    rows = np.arange(count)
    ahead, left, back, right = (support[rows, turn + i * quarter] for i in range(4))
    along = DIRECTIONS[turn]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    out[1, :, :2] += 0.5 * ((ahead - back)[:, None] * along + (left - right)[:, None] * across)
    out[1, :, 2] = np.maximum(0.5 * (ahead + back), 0.5)
    out[1, :, 3] = np.maximum(0.5 * (left + right), 0.5)
    out[1, :, 5] = turn * (2.0 * math.pi / RAYS)
    # Three far corners: the farthest from the centre, from that, and from the line between both.
    first = outlines[rows, np.vecdot(shifted, shifted).argmax(axis=1)]
    apart = outlines - first[:, None]
    second = outlines[rows, np.vecdot(apart, apart).argmax(axis=1)]
    line = second - first
    third = outlines[rows, np.abs(apart[..., 0] * line[:, 1:] - apart[..., 1] * line[:, :1]).argmax(axis=1)]
    out[2] = _triangles(np.stack([first, second, third], axis=1))
    return out.reshape(-1, PARAMETERS)


def _triangles(corners: Floats) -> Floats:
    """Padded parameters (K, 8) of triangles with corners (K, 3, 2), any order."""
    center = corners.mean(axis=1)
    side = np.concatenate([corners[:, 1:], corners[:, :1]], axis=1) - corners
    normal = np.stack([side[..., 1], -side[..., 0]], axis=2)
    normal /= np.maximum(np.hypot(normal[..., 0], normal[..., 1]), 1e-9)[..., None]
    reach = np.vecdot(normal, corners - center[:, None])
    outwards = np.where(reach[..., None] < 0.0, -normal, normal)
    turn = np.arctan2(outwards[..., 1], outwards[..., 0])
    order = np.argsort(np.mod(turn, 2.0 * math.pi), axis=1)
    own = np.arange(len(order))[:, None]
    turn = turn[own, order] - TRIANGLE.normals
    return np.concatenate([center, np.abs(reach)[own, order], turn], axis=1)


def _fit(kind: Rows, q: Floats, edges: Edges, factor: int, steps: Sequence[int]) -> Floats:
    """Parameters (R, 8) of rows of kinds (R,) after a robust fit to the edges around each.

    Every ray offers several edges; the one nearest to the present outline counts, weighed by Tukey's function
    whose width halves with every step, from a fifth of the object to half a pixel of the searched image.
    """
    q = q.copy()
    models = _models(kind, edges)
    count, rays, _ = edges.weight.shape
    distance, strength = np.empty((count, rays), np.float32), np.empty((count, rays), np.float32)
    jacobian = np.empty((count, PARAMETERS, rays), np.float32)
    size = np.sqrt(np.maximum(areas(kind, q), 1.0))
    limit = np.full(q.shape, 0.3)
    limit[:, :5] *= size[:, None]
    scale = np.maximum(0.5 * factor, 0.008 * size)
    for step in steps:
        width = 3.0 * np.maximum(scale, 0.2 * size * 0.5**step)
        for rows, model, near in models:
            distance[rows], strength[rows] = model(kind[rows], q[rows], near, jacobian[rows])
        weighted = jacobian * (strength * tukey(np.abs(distance) / width[:, None].astype(np.float32)))[:, None]
        normal = (weighted @ jacobian.transpose(0, 2, 1)).astype(np.float64)
        normal += _RIDGE * (np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-4)
        change = np.linalg.solve(normal, weighted @ distance[..., None])[..., 0]
        q -= np.minimum(np.maximum(change, -limit), limit)
        used = q[:, 2:5] != 0.0
        q[:, 2:5] = np.where(used, np.maximum(q[:, 2:5], 0.1 * size[:, None]), 0.0)
    return q


def _models(kind: Rows, edges: Edges) -> list[tuple[slice, Model, Edges]]:
    """Which rows of kinds in rising order are to be measured in which way, and the edges around them."""
    first = int(np.searchsorted(kind, ROUND))
    both = (slice(0, first), _polygons), (slice(first, len(kind)), _circles)
    return [(rows, model, edges.some(rows)) for rows, model in both if rows.stop > rows.start]


def _polygons(kind: Rows, q: Floats, edges: Edges, jacobian: Floats32 | None) -> tuple[Floats32, Floats32]:
    """Distance (R, M) of each ray's nearest edge from polygons, and its strength (R, M).

    The distances' derivatives (R, 8, M) are written into `jacobian` if there is one.
    """
    where = np.arange(len(q))[:, None]
    turn = q[where, _TURN_OF[kind]] + _NORMALS[kind]
    reach = q[where, _SIZE_OF[kind]]
    lines = np.empty((len(q), _SIDES, 3), np.float32)
    lines[..., 0], lines[..., 1] = np.cos(turn), np.sin(turn)
    lines[..., 2] = -(reach + lines[..., 0] * q[:, :1] + lines[..., 1] * q[:, 1:2])
    apart = lines @ edges.points
    distance, strength, chosen = _nearest(apart.max(axis=1), edges)
    if jacobian is None:
        return distance, strength
    own = apart if chosen is None else np.take_along_axis(apart, chosen[:, None], axis=2)
    side = own.argmax(axis=1)
    across, down = lines[where, side, 0], lines[where, side, 1]
    points = edges.points if chosen is None else np.take_along_axis(edges.points, chosen[:, None], axis=2)
    moves = _MOVES[kind, None]
    jacobian[:, 0], jacobian[:, 1] = across * moves, down * moves
    jacobian[:, 2:] = _FOLLOWS[kind[:, None], side].transpose(0, 2, 1)
    middle = q[:, :2].astype(np.float32)
    turning = (points[:, 1] - middle[:, 1:]) * across - (points[:, 0] - middle[:, :1]) * down
    jacobian[:, 5:] *= turning[:, None]
    return distance, strength


def _circles(kind: Rows, q: Floats, edges: Edges, jacobian: Floats32 | None) -> tuple[Floats32, Floats32]:
    """The same for circles."""
    del kind
    shifted = edges.points[:, :2] - q[:, :2, None].astype(np.float32)
    far = np.sqrt(shifted[:, 0] ** 2 + shifted[:, 1] ** 2)
    distance, strength, chosen = _nearest(far - q[:, 2:3].astype(np.float32), edges)
    if jacobian is None:
        return distance, strength
    if chosen is not None:
        shifted = np.take_along_axis(shifted, chosen[:, None], axis=2)
        far = np.take_along_axis(far, chosen, axis=1)
    jacobian[:, :2] = shifted / -np.maximum(far, 1e-6)[:, None]
    jacobian[:, 2], jacobian[:, 3:] = -1.0, 0.0
    return distance, strength


def _nearest(distance: Floats32, edges: Edges) -> tuple[Floats32, Floats32, Rows | None]:
    """Of the edges of each ray the nearest to the outline: distance and strength (R, M), and which it is.

    The last is None where there is one edge a ray.
    """
    count, rays, choices = edges.weight.shape
    if choices == 1:
        return distance, edges.weight[..., 0], None
    off = np.abs(distance).reshape(count, rays, choices)
    chosen = np.where(edges.weight > 0.0, off, np.inf).argmin(axis=2) + np.arange(rays) * choices
    strength = np.take_along_axis(edges.weight.reshape(count, -1), chosen, axis=1)
    return np.take_along_axis(distance, chosen, axis=1), strength, chosen


def _quality(kind: Rows, q: Floats, edges: Edges, factor: int) -> tuple[Floats, Floats, Floats]:
    """Cost, share of inliers and size (R,) of fitted outlines, see `Hypothesis`."""
    distance = np.empty(edges.weight.shape[:2], np.float32)
    strength = np.empty_like(distance)
    for rows, model, near in _models(kind, edges):
        distance[rows], strength[rows] = model(kind[rows], q[rows], near, None)
    size = np.sqrt(np.maximum(areas(kind, q), 1.0))
    tolerance = np.maximum(0.7 * factor, 0.02 * size)[:, None]
    off = np.abs(distance)
    valid = strength > 0.15
    inliers = np.mean((off < tolerance) & valid, axis=1)
    clipped = np.where(valid, np.minimum(off, tolerance), tolerance)
    return np.sqrt(np.mean(clipped * clipped, axis=1)) / tolerance[:, 0], inliers, size

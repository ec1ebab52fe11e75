"""The shape families as sets of half-planes, and their robust fit to outline points, many objects at once.

A polygon of a family is a centre, one or more half sizes and one or more turns; every side is a normal direction
and a distance from the centre. A circle is the limit with a normal for every direction. Signed distances are
negative inside. Coordinates are any right-angled plane: pixels (y down) or the calibrated table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Family:
    """One family of outlines.

    Parameters of an object are (cx, cy, sizes..., turns...).

    Attributes:
        shape: What it is called.
        normals: Direction of each side's outward normal at turn 0, rad; empty for the circle.
        size_of: Which size each side's distance from the centre is.
        turn_of: Which turn each side follows.
        sizes: Number of sizes.
        turns: Number of turns.
        moves: Whether the centre is free (three free lines fix a triangle by themselves).
    """

    shape: Shape
    normals: Floats
    size_of: NDArray[np.intp]
    turn_of: NDArray[np.intp]
    sizes: int
    turns: int
    moves: bool = True

    @property
    def parameters(self) -> int:
        """Length of the parameter vector."""
        return 2 + self.sizes + self.turns


def _polygon(shape: Shape, sides: int, size_of: list[int], turn_of: list[int], moves: bool = True) -> Family:
    normals = np.arange(sides) * 2.0 * math.pi / sides
    sizes, turns = max(size_of) + 1, max(turn_of) + 1
    return Family(shape, normals, np.array(size_of), np.array(turn_of), sizes, turns, moves)


CIRCLE = Family(Shape.CIRCLE, np.empty(0), np.empty(0, np.intp), np.empty(0, np.intp), 1, 0)
HEXAGON = _polygon(Shape.HEXAGON, 6, [0] * 6, [0] * 6)
RECTANGLE = _polygon(Shape.RECTANGLE, 4, [0, 1, 0, 1], [0] * 4)
TRIANGLE = _polygon(Shape.TRIANGLE, 3, [0, 1, 2], [0, 1, 2], moves=False)
FAMILIES: Mapping[Shape, Family] = {family.shape: family for family in (CIRCLE, HEXAGON, RECTANGLE, TRIANGLE)}


def fit_edges(
    family: Family, q: Floats, edges: Floats32, weight: Floats32, scale: Floats, steps: Sequence[int]
) -> Floats:
    """Parameters (K, P) after a robust fit to edge points.

    Every ray offers several edges; the one nearest to the present outline counts, weighed by Tukey's function
    whose width halves with every step, from a fifth of the object to `scale`.

    Args:
        family: The family.
        q: Start, shape (K, P).
        edges: ndarray of shape (K, M, C, 2): C candidate edges on each of M rays.
        weight: ndarray of shape (K, M, C), 0 where there is no edge.
        scale: Final width of the weight function for each object, shape (K,).
        steps: Numbers of the Gauss-Newton steps to take, counted from 0.
    """
    q = q.copy()
    size = np.sqrt(np.maximum(area(family, q), 1.0))
    limit = 0.3 * size[:, None]
    eye = np.eye(family.parameters)
    for step in steps:
        distance, strength, nearest = _nearest(family, q, edges, weight)
        jacobian = _jacobian(family, q, nearest)
        width = 3.0 * np.maximum(scale, 0.2 * size * 0.5**step)
        ratio = np.minimum(np.abs(distance) / width[:, None].astype(np.float32), 1.0)
        w = strength * (1.0 - ratio * ratio) ** 2
        weighted = (jacobian * w[:, None]).astype(np.float64)
        normal = weighted @ jacobian.transpose(0, 2, 1)
        normal += eye * (1e-9 + 1e-5 * np.trace(normal, axis1=1, axis2=2)[:, None, None])
        step_q = np.linalg.solve(normal, weighted @ distance[..., None])[..., 0]
        step_q[:, : 2 + family.sizes] = np.clip(step_q[:, : 2 + family.sizes], -limit, limit)
        step_q[:, 2 + family.sizes :] = np.clip(step_q[:, 2 + family.sizes :], -0.3, 0.3)
        q -= step_q
        q[:, 2 : 2 + family.sizes] = np.maximum(q[:, 2 : 2 + family.sizes], 0.1 * size[:, None])
    return q


def edge_residuals(family: Family, q: Floats, edges: Floats32, weight: Floats32) -> tuple[Floats32, Floats32]:
    """Signed distance (K, M) of each ray's nearest edge from the outline, and that edge's weight (K, M)."""
    distance, strength, _ = _nearest(family, q, edges, weight)
    return distance, strength


def _nearest(
    family: Family, q: Floats, edges: Floats32, weight: Floats32
) -> tuple[Floats32, Floats32, tuple[Floats32, Floats32]]:
    """Of the edges of each ray the nearest to the outline: distance and weight (K, M), place from the centre (K, M)."""
    middle = q[:, None, None, :2].astype(np.float32)
    dx, dy = edges[..., 0] - middle[..., 0], edges[..., 1] - middle[..., 1]
    distance = _signed_distance(family, q, dx, dy)
    best = np.where(weight > 0.0, np.abs(distance), np.inf).argmin(axis=2)[..., None]
    chosen = [np.take_along_axis(values, best, axis=2)[..., 0] for values in (distance, weight, dx, dy)]
    return chosen[0], chosen[1], (chosen[2], chosen[3])


def _sides(family: Family, q: Floats) -> tuple[Floats32, Floats32, Floats32]:
    """Normals' cosines and sines, and distances from the centre, of every side, (K, S)."""
    turns = q[:, 2 + family.sizes :][:, family.turn_of] + family.normals
    reach = q[:, 2 + family.size_of]
    return np.cos(turns).astype(np.float32), np.sin(turns).astype(np.float32), reach.astype(np.float32)


def _signed_distance(family: Family, q: Floats, dx: Floats32, dy: Floats32) -> Floats32:
    """Signed distances (K, M, C) of points given from the outlines' centres."""
    if not len(family.normals):
        return np.asarray(np.sqrt(dx * dx + dy * dy) - q[:, None, None, 2].astype(np.float32))
    cos, sin, reach = (values[:, :, None, None] for values in _sides(family, q))
    out = dx * cos[:, 0] + dy * sin[:, 0] - reach[:, 0]
    for i in range(1, len(family.normals)):
        np.maximum(out, dx * cos[:, i] + dy * sin[:, i] - reach[:, i], out=out)
    return np.asarray(out)


def _jacobian(family: Family, q: Floats, points: tuple[Floats32, Floats32]) -> Floats32:
    """Derivatives (K, P, M) of the signed distances of points given from the outlines' centres."""
    dx, dy = points
    out = np.zeros((len(dx), family.parameters, dx.shape[1]), np.float32)
    if not len(family.normals):
        radius = np.maximum(np.hypot(dx, dy), 1e-9)
        out[:, 0], out[:, 1], out[:, 2] = -dx / radius, -dy / radius, -1.0
        return out
    cos, sin, reach = _sides(family, q)
    side = (dx[..., None] * cos[:, None] + dy[..., None] * sin[:, None] - reach[:, None]).argmax(axis=2)
    n_x, n_y = np.take_along_axis(cos, side, axis=1), np.take_along_axis(sin, side, axis=1)
    if family.moves:
        out[:, 0], out[:, 1] = -n_x, -n_y
    size_of, turn_of, turning = family.size_of[side], family.turn_of[side], dy * n_x - dx * n_y
    for i in range(family.sizes):
        out[:, 2 + i] = np.where(size_of == i, -1.0, 0.0)
    for i in range(family.turns):
        out[:, 2 + family.sizes + i] = np.where(turn_of == i, turning, 0.0)
    return out


def area(family: Family, q: Floats) -> Floats:
    """Areas (K,) of outlines with parameters q (K, P)."""
    if family is CIRCLE:
        return np.asarray(math.pi * q[:, 2] ** 2)
    if family is HEXAGON:
        return np.asarray(2.0 * math.sqrt(3.0) * q[:, 2] ** 2)
    if family is RECTANGLE:
        return np.asarray(4.0 * q[:, 2] * q[:, 3])
    # Three lines at distances h from a point, with angles g between their normals: (h . sin g)^2 / (2 product sin g).
    turns = q[:, 5:] + TRIANGLE.normals
    opposite = np.sin(np.stack([turns[:, j] - turns[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1))
    product = 2.0 * np.prod(opposite, axis=1)
    product = np.where(np.abs(product) < 1e-9, 1e-9, product)
    return np.asarray(np.abs(np.sum(q[:, 2:5] * opposite, axis=1) ** 2 / product))


def rotated(values: Floats) -> Floats:
    """The rows with the first moved to the end: what follows each along a closed outline."""
    return np.concatenate([values[1:], values[:1]])


def vertices(family: Family, q: Floats, circle_points: int = 72) -> Floats:
    """Corners (N, 2) of one outline, in the order of increasing normal direction; a circle is sampled."""
    if not len(family.normals):
        turn = np.arange(circle_points) * 2.0 * math.pi / circle_points
        return np.stack([q[0] + q[2] * np.cos(turn), q[1] + q[2] * np.sin(turn)], axis=1)
    turns = q[2 + family.sizes :][family.turn_of] + family.normals
    order = np.argsort(np.mod(turns, 2.0 * math.pi))
    turns, reach = turns[order], q[2 + family.size_of][order]
    following, reach_2 = rotated(turns), rotated(reach)
    det = np.sin(following - turns)
    det = np.where(np.abs(det) < 1e-6, 1e-6, det)
    x = (reach * np.sin(following) - reach_2 * np.sin(turns)) / det
    y = (reach_2 * np.cos(turns) - reach * np.cos(following)) / det
    return np.stack([q[0] + x, q[1] + y], axis=1)


def from_polygon(points: Floats) -> Floats:
    """Parameters of the TRIANGLE family for three corners of shape (3, 2), any order."""
    center = points.mean(axis=0)
    sides = np.roll(points, -1, axis=0) - points
    normal = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    reach = np.sum(normal * (points - center), axis=1)
    normal = np.where(reach[:, None] < 0.0, -normal, normal)
    order = np.argsort(np.mod(np.arctan2(normal[:, 1], normal[:, 0]), 2.0 * math.pi))
    turn = np.arctan2(normal[order, 1], normal[order, 0]) - TRIANGLE.normals
    return np.concatenate([center, np.abs(reach[order]), turn])

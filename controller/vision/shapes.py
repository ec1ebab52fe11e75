"""The shape families as sets of half-planes, and their robust fit to outline points, many objects at once.

A polygon of a family is a centre, one or more half sizes and one or more turns; every side is a normal direction
and a distance from the centre. A circle is the limit with a normal for every direction. Signed distances are
negative inside. Coordinates are any right-angled plane: pixels (y down) or the calibrated table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape

Floats = NDArray[np.float64]


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
OCTAGON = _polygon(Shape.OTHER, 8, [0] * 8, [0] * 8)
"""Nearest to a circle of all polygons seen in practice: fitted only to be told from one."""
FAMILIES: Mapping[Shape, Family] = {family.shape: family for family in (CIRCLE, HEXAGON, RECTANGLE, TRIANGLE)}


def signed_distance(family: Family, q: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Signed distance of points from outlines, with its derivatives.

    Args:
        family: The family.
        q: ndarray of shape (K, P), parameters of K objects.
        points: ndarray of shape (K, M, 2), M points for each.

    Returns:
        distance (K, M); jacobian (K, M, P).
    """
    dx = points[..., 0] - q[:, None, 0]
    dy = points[..., 1] - q[:, None, 1]
    jacobian = np.zeros((*dx.shape, family.parameters))
    if not len(family.normals):
        radius = np.hypot(dx, dy)
        safe = np.maximum(radius, 1e-9)
        jacobian[..., 0], jacobian[..., 1], jacobian[..., 2] = -dx / safe, -dy / safe, -1.0
        return radius - q[:, None, 2], jacobian
    turns = q[:, 2 + family.sizes :][:, family.turn_of] + family.normals
    cos, sin = np.cos(turns), np.sin(turns)
    planes = dx[..., None] * cos[:, None] + dy[..., None] * sin[:, None] - q[:, None, 2 + family.size_of]
    side = planes.argmax(axis=2)
    rows = np.arange(len(q))[:, None]
    n_x, n_y = cos[rows, side], sin[rows, side]
    if family.moves:
        jacobian[..., 0], jacobian[..., 1] = -n_x, -n_y
    k, m = np.indices(side.shape, sparse=True)
    jacobian[k, m, 2 + family.size_of[side]] = -1.0
    jacobian[k, m, 2 + family.sizes + family.turn_of[side]] = dy * n_x - dx * n_y
    return np.take_along_axis(planes, side[..., None], axis=2)[..., 0], jacobian


def fit_edges(family: Family, q: Floats, edges: Floats, weight: Floats, scale: Floats, rounds: int = 6) -> Floats:
    """Parameters (K, P) after a robust fit to edge points.

    Every ray offers several edges; the one nearest to the present outline counts, weighed by Tukey's function
    whose width shrinks from a tenth of the object to a few pixels.

    Args:
        family: The family.
        q: Start, shape (K, P).
        edges: ndarray of shape (K, M, C, 2): C candidate edges on each of M rays.
        weight: ndarray of shape (K, M, C), 0 where there is no edge.
        scale: Final width of the weight function for each object, shape (K,).
        rounds: Gauss-Newton steps.
    """
    q = q.copy()
    size = np.sqrt(np.maximum(area(family, q), 1.0))
    eye = np.eye(family.parameters)
    for step in range(rounds):
        strength, distance, jacobian = _nearest(family, q, edges, weight)
        width = np.maximum(scale, 0.2 * size * 0.5**step)
        ratio = np.clip(distance / (3.0 * width[:, None]), -1.0, 1.0)
        w = strength * (1.0 - ratio**2) ** 2
        weighted = jacobian * w[..., None]
        normal = np.einsum("kmp,kmq->kpq", weighted, jacobian, optimize=True)
        normal += eye * (1e-9 + 1e-5 * np.trace(normal, axis1=1, axis2=2)[:, None, None])
        step_q = np.linalg.solve(normal, np.einsum("kmp,km->kp", weighted, distance)[..., None])[..., 0]
        limit = 0.3 * size[:, None]
        step_q[:, : 2 + family.sizes] = np.clip(step_q[:, : 2 + family.sizes], -limit, limit)
        step_q[:, 2 + family.sizes :] = np.clip(step_q[:, 2 + family.sizes :], -0.3, 0.3)
        q -= step_q
        q[:, 2 : 2 + family.sizes] = np.maximum(q[:, 2 : 2 + family.sizes], 0.1 * size[:, None])
    return q


def edge_residuals(family: Family, q: Floats, edges: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Signed distance (K, M) of each ray's nearest edge from the outline, and that edge's weight (K, M)."""
    strength, distance, _ = _nearest(family, q, edges, weight)
    return distance, strength


def _nearest(family: Family, q: Floats, edges: Floats, weight: Floats) -> tuple[Floats, Floats, Floats]:
    count, rays, choices = weight.shape
    distance, jacobian = signed_distance(family, q, edges.reshape(count, rays * choices, 2))
    distance = distance.reshape(count, rays, choices)
    cost = np.where(weight > 0.0, np.abs(distance), np.inf)
    best = cost.argmin(axis=2)
    k, m = np.indices(best.shape, sparse=True)
    jacobian = jacobian.reshape(count, rays, choices, -1)[k, m, best]
    return weight[k, m, best], distance[k, m, best], jacobian


def area(family: Family, q: Floats) -> Floats:
    """Areas (K,) of outlines with parameters q (K, P)."""
    if family is CIRCLE:
        return np.asarray(math.pi * q[:, 2] ** 2)
    if family is HEXAGON:
        return np.asarray(2.0 * math.sqrt(3.0) * q[:, 2] ** 2)
    if family is OCTAGON:
        return np.asarray(8.0 * math.tan(math.pi / 8.0) * q[:, 2] ** 2)
    if family is RECTANGLE:
        return np.asarray(4.0 * q[:, 2] * q[:, 3])
    return np.array([abs(cv2.contourArea(vertices(family, one).astype(np.float32))) for one in q])


def vertices(family: Family, q: Floats, circle_points: int = 72) -> Floats:
    """Corners (N, 2) of one outline, in the order of increasing normal direction; a circle is sampled."""
    if not len(family.normals):
        turn = np.arange(circle_points) * 2.0 * math.pi / circle_points
        return np.stack([q[0] + q[2] * np.cos(turn), q[1] + q[2] * np.sin(turn)], axis=1)
    turns = q[2 + family.sizes :][family.turn_of] + family.normals
    order = np.argsort(np.mod(turns, 2.0 * math.pi))
    turns, reach = turns[order], q[2 + family.size_of][order]
    following, reach_2 = np.roll(turns, -1), np.roll(reach, -1)
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

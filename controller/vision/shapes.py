"""The shape families as sets of half-planes.

A polygon of a family is a centre, one or more half sizes and one or more turns; every side is a normal direction
and a distance from the centre. A circle is the limit with a normal for every direction. Signed distances are
negative inside. Coordinates are any right-angled plane: pixels (y down) or the calibrated table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
"""Of each side of a triangle the one after it, and the one before."""


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
    opposite = np.sin(turns.take(_LAST, axis=1) - turns.take(_NEXT, axis=1))
    product = 2.0 * opposite[:, 0] * opposite[:, 1] * opposite[:, 2]
    product = np.where(np.abs(product) < 1e-9, 1e-9, product)
    return np.asarray(np.abs(np.vecdot(q[:, 2:5], opposite) ** 2 / product))


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

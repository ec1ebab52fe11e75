"""Convex solids: the one description of a shape that both the physics and the painter are built from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Colour = tuple[float, float, float]

# A cylinder is a prism with this many sides: 0.02 mm from round at 30 mm radius.
ROUND_SIDES = 72


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A convex polyhedron fixed to a body.

    Attributes:
        body: Name of the body that carries it; `world` is fixed.
        vertices: ndarray of shape (N, 3), mm, in the body's coordinates.
        faces: Vertex indices of each face, counter-clockwise seen from outside.
        colour: BGR, 0..255.
        split: Into how many pieces an edge is cut, so that it can bend in the lens.
        decal: Name of a picture shown on face 0, or "".
    """

    body: str
    vertices: Array
    faces: tuple[tuple[int, ...], ...]
    colour: Colour
    split: int = 4
    decal: str = ""


def prism(
    ring: ArrayLike, low: float, high: float, *, body: str, colour: Colour, split: int = 4, decal: str = ""
) -> Solid:
    """Upright prism over a counter-clockwise convex ring of shape (N, 2), from z = low to high; face 0 is its top."""
    base = np.asarray(ring, np.float64)
    n = len(base)
    vertices = np.vstack([np.column_stack([base, np.full(n, low)]), np.column_stack([base, np.full(n, high)])])
    top = tuple(range(n, 2 * n))
    bottom = tuple(range(n - 1, -1, -1))
    sides = tuple((i, (i + 1) % n, n + (i + 1) % n, n + i) for i in range(n))
    return Solid(body, vertices, (top, bottom, *sides), colour, split, decal)


def turned(solid: Solid, rotation: ArrayLike, origin: ArrayLike) -> Solid:
    """The solid turned by a (3, 3) rotation and then moved to `origin`, mm, within its body."""
    vertices = solid.vertices @ np.asarray(rotation, np.float64).T + np.asarray(origin, np.float64)
    return Solid(solid.body, vertices, solid.faces, solid.colour, solid.split, solid.decal)


def box(low: ArrayLike, high: ArrayLike, *, body: str, colour: Colour, chamfer: float = 0.0, decal: str = "") -> Solid:
    """Box between two corners, mm; `chamfer` breaks the four edges along its longest side."""
    lo, hi = np.asarray(low, np.float64), np.asarray(high, np.float64)
    axis = int(np.argmax(hi - lo)) if chamfer else 2
    # Cyclic permutation that brings `axis` to z keeps the ring counter-clockwise.
    u, v = (axis + 1) % 3, (axis + 2) % 3
    half = (hi - lo)[[u, v]] / 2.0
    middle = (hi + lo)[[u, v]] / 2.0
    c = min(chamfer, 0.6 * float(half.min()))
    a, b = half
    if c > 0.0:
        ring = np.array(
            [[a, -b + c], [a, b - c], [a - c, b], [-a + c, b], [-a, b - c], [-a, -b + c], [-a + c, -b], [a - c, -b]]
        )
    else:
        ring = np.array([[a, -b], [a, b], [-a, b], [-a, -b]])
    flat = prism(ring + middle, lo[axis], hi[axis], body=body, colour=colour, decal=decal)
    rotation = np.zeros((3, 3))
    rotation[u, 0] = rotation[v, 1] = rotation[axis, 2] = 1.0
    return turned(flat, rotation, (0.0, 0.0, 0.0))


def regular(sides: int, radius: float, phase: float = 0.0) -> Array:
    """Corners (N, 2) of a regular polygon, counter-clockwise, the first at direction `phase`."""
    angles = phase + 2.0 * math.pi * np.arange(sides) / sides
    return np.asarray(radius * np.column_stack([np.cos(angles), np.sin(angles)]))


def disc(diameter: float) -> Array:
    """Corners (N, 2) of a polygon with the area of a circle."""
    step = 2.0 * math.pi / ROUND_SIDES
    return regular(ROUND_SIDES, diameter / 2.0 * math.sqrt(step / math.sin(step)))

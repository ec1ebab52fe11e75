"""The parts on the table: what they are, and a seeded hand that scatters them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from controller.errors import ConfigError
from sim_backends.imperfections import Imperfections
from sim_backends.solids import Array, disc, regular

SHAPES = (Shape.SQUARE, Shape.RECTANGLE, Shape.CIRCLE, Shape.HEXAGON, Shape.TRIANGLE)

# BGR albedo of dyed plastic.
COLOURS: Mapping[str, tuple[float, float, float]] = {
    "red": (48.0, 44.0, 196.0),
    "orange": (40.0, 122.0, 232.0),
    "yellow": (52.0, 202.0, 236.0),
    "green": (74.0, 150.0, 52.0),
    "blue": (186.0, 104.0, 38.0),
    "purple": (146.0, 58.0, 122.0),
}

# kg/mm^3: printed plastic with a filling; a 43 mm square weighs 17 g.
DENSITY = 0.45e-6
RECTANGLE_ASPECT = 1.4
_FRESH_STARTS = 20
_LEAST_GAP = 0.2  # mm: parts may all but touch, never overlap


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of part, where a table is to hold only chosen ones.

    Attributes:
        name: What people call it.
        shape: Any of `SHAPES`.
        colour: A name of `COLOURS`.
        marking: A name of `markings.MARKINGS`, or "" for a plain top.
        grip: Nominal extent between the jaws, mm, or None for any of the cell's.
    """

    name: str
    shape: Shape
    colour: str
    marking: str = ""
    grip: float | None = None


@dataclass(frozen=True, slots=True)
class Part:
    """One upright prism as it is put on the table.

    Attributes:
        shape: Any of `SHAPES`.
        colour: A name of `COLOURS`.
        grip: Extent between the jaws across its flats (triangle: its altitude; circle: its diameter), mm.
        height: mm.
        mass: kg.
        friction: Coefficient against anything.
        x, y: Where its centroid is put, in `base`, mm.
        yaw: Turn about z, rad.
        marking: What is on its top, a name of `markings.MARKINGS`, or "".
        kind: Name of its kind, or "".
    """

    shape: Shape
    colour: str
    grip: float
    height: float
    mass: float
    friction: float
    x: float
    y: float
    yaw: float
    marking: str = ""
    kind: str = ""

    @property
    def outline(self) -> Array:
        """Corners (N, 2) about the centroid, counter-clockwise, one side along x; mm."""
        return outline(self.shape, self.grip)

    @property
    def size(self) -> tuple[float, float]:
        """(long, short) side of the minimum-area rectangle, mm."""
        return size(self.shape, self.grip)


def outline(shape: Shape, grip: float) -> Array:
    """Corners (N, 2) of a shape about its centroid, counter-clockwise, one side along x, mm."""
    if shape is Shape.CIRCLE:
        return disc(grip)
    if shape is Shape.HEXAGON:
        return regular(6, grip / math.sqrt(3.0))
    if shape is Shape.TRIANGLE:
        return regular(3, 2.0 / 3.0 * grip, math.pi / 2.0)
    a = grip / 2.0 * (RECTANGLE_ASPECT if shape is Shape.RECTANGLE else 1.0)
    b = grip / 2.0
    return np.array([[-a, -b], [a, -b], [a, b], [-a, b]])


def size(shape: Shape, grip: float) -> tuple[float, float]:
    """(long, short) side of the shape's minimum-area rectangle, mm."""
    long = {
        Shape.RECTANGLE: RECTANGLE_ASPECT * grip,
        Shape.HEXAGON: 2.0 / math.sqrt(3.0) * grip,
        Shape.TRIANGLE: 2.0 / math.sqrt(3.0) * grip,
    }.get(shape, grip)
    return long, grip


def area(ring: Array) -> float:
    """Area of a polygon of shape (N, 2)."""
    x, y = ring.T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2.0)


def placed(ring: Array, x: float, y: float, yaw: float) -> Array:
    """A ring (N, 2) turned by `yaw` and moved to (x, y)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.asarray(ring @ np.array([[c, s], [-s, c]]) + (x, y))


def gap(a: Array, b: Array) -> float:
    """Distance between two convex rings, mm; negative (their least overlap) when they overlap.

    The largest separation along any side's normal bounds the distance from below; for corners that face
    each other the distance of the nearest corner to the nearest side is exact.
    """
    best = -math.inf
    for p, q in ((a, b), (b, a)):
        sides = np.roll(p, -1, axis=0) - p
        normals = np.column_stack([sides[:, 1], -sides[:, 0]]) / np.linalg.norm(sides, axis=1)[:, None]
        best = max(best, float(((q[None] - p[:, None]) @ normals[:, :, None]).min(axis=1).max()))
    if best <= 0.0:
        return best
    return min(_corner_distance(a, b), _corner_distance(b, a))


def _corner_distance(a: Array, b: Array) -> float:
    start, step = b, np.roll(b, -1, axis=0) - b
    t = ((a[:, None] - start) * step).sum(-1) / (step**2).sum(-1)
    nearest = start + np.clip(t, 0.0, 1.0)[..., None] * step
    return float(np.linalg.norm(a[:, None] - nearest, axis=-1).min())


@dataclass(frozen=True, slots=True)
class WorkArea:
    """Annular sector around the arm's base in which the centres of parts are scattered; mm, rad."""

    radius: tuple[float, float] = (150.0, 260.0)
    azimuth: tuple[float, float] = (-math.radians(50.0), math.radians(50.0))


def scatter(
    count: int,
    seed: int,
    imperfections: Imperfections,
    heights: Mapping[Shape, float],
    grips: Sequence[float],
    area_: WorkArea,
    of: Sequence[Kind] = (),
) -> tuple[Part, ...]:
    """`count` parts, uniform over the work area; the same for the same seed.

    With kinds in `of`, these come round in turn; without, the shapes in colours at random.

    When so many parts do not fit with the wanted gap, the gap shrinks in steps until they do.

    Raises:
        ConfigError: They do not fit at all.
    """
    random = np.random.default_rng([seed, 3])
    # Shapes come round in turn from a random start, so that a table of five has all of them.
    start = int(random.integers(len(of or SHAPES)))
    wanted = [of[(start + index) % len(of)] if of else None for index in range(count)]
    kinds = [
        _kind(random, SHAPES[(start + index) % len(SHAPES)] if kind is None else kind.shape, imperfections, heights,
              grips if kind is None or kind.grip is None else (kind.grip,))
        for index, kind in enumerate(wanted)
    ]
    rings = [kind[3] for kind in kinds]
    for distance in imperfections.part_gap * 0.8 ** np.arange(12) + _LEAST_GAP:
        places = None
        for _ in range(_FRESH_STARTS):
            places = places or _places(random, rings, float(distance), area_)
        places = places or _squeezed(random, rings, float(distance), area_)
        if places is not None:
            return tuple(
                Part(shape, colour, grip, heights[shape], mass, friction, x, y, yaw)
                if kind is None
                else Part(
                    shape, kind.colour, grip, heights[shape], mass, friction, x, y, yaw, kind.marking, kind.name
                )
                for (shape, colour, grip, _, mass, friction), kind, (x, y, yaw) in zip(
                    kinds, wanted, places, strict=True
                )
            )
    raise ConfigError(f"{count} parts do not fit into the work area", "ask for fewer or smaller parts")


def spare_parts(
    count: int,
    seed: int,
    imperfections: Imperfections,
    heights: Mapping[Shape, float],
    grips: Sequence[float],
    area_: WorkArea,
) -> tuple[Part, ...]:
    """`count` parts of random shapes that do not lie on the table yet; the same for the same seed."""
    random = np.random.default_rng([seed, 10])
    made = []
    for _ in range(count):
        kind = SHAPES[int(random.integers(len(SHAPES)))]
        shape, colour, grip, _, mass, friction = _kind(random, kind, imperfections, heights, grips)
        made.append(Part(shape, colour, grip, heights[shape], mass, friction, *somewhere(random, area_)))
    return tuple(made)


def round_part(seed: int, heights: Mapping[Shape, float], area_: WorkArea) -> Part:
    """A round part about where a person lays it who was asked for the middle of the work area."""
    random = np.random.default_rng([seed, 13])
    (near, far), (right, left) = area_.radius, area_.azimuth
    radius, azimuth = (near + far) / 2.0 + random.uniform(-6.0, 6.0), (left + right) / 2.0 + random.uniform(-0.05, 0.05)
    x, y = radius * math.cos(azimuth), radius * math.sin(azimuth)
    return Part(Shape.CIRCLE, "blue", 43.0, heights[Shape.CIRCLE], 0.015, 0.4, x, y, 0.0)


def _kind(
    random: np.random.Generator,
    shape: Shape,
    imperfections: Imperfections,
    heights: Mapping[Shape, float],
    grips: Sequence[float],
) -> tuple[Shape, str, float, Array, float, float]:
    colour = list(COLOURS)[int(random.integers(len(COLOURS)))]
    tolerance = imperfections.size_tolerance
    grip = float(grips[int(random.integers(len(grips)))]) + float(random.uniform(-tolerance, tolerance))
    ring = outline(shape, grip)
    spread = imperfections.mass_tolerance
    mass = DENSITY * area(ring) * heights[shape] * (1.0 + float(random.uniform(-spread, spread)))
    friction = float(random.uniform(imperfections.friction[0], imperfections.friction[1]))
    return shape, colour, grip, ring, mass, friction


def _places(
    random: np.random.Generator, rings: Sequence[Array], distance: float, area_: WorkArea
) -> list[tuple[float, float, float]] | None:
    """A place (x, y, yaw) for every ring, the largest first, or None when one finds no room."""
    outer = [float(np.sqrt((ring**2).sum(axis=1)).max()) for ring in rings]
    inner = [float(np.sqrt(((ring + np.roll(ring, -1, axis=0)) ** 2).sum(axis=1)).min()) / 2.0 for ring in rings]
    places: dict[int, tuple[float, float, float]] = {}
    outlines: dict[int, NDArray[np.float64]] = {}

    def has_room(index: int, here: Array, x: float, y: float) -> bool:
        near = []
        for other, (u, v, _) in places.items():
            apart = math.hypot(x - u, y - v) - distance
            if apart < inner[index] + inner[other]:
                return False
            if apart < outer[index] + outer[other]:
                near.append(other)
        return all(gap(here, outlines[other]) >= distance for other in near)

    for index in sorted(range(len(rings)), key=lambda i: -outer[i]):
        for _ in range(100):
            x, y, yaw = somewhere(random, area_)
            here = placed(rings[index], x, y, yaw)
            if has_room(index, here, x, y):
                places[index], outlines[index] = (x, y, yaw), here
                break
        else:
            return None
    return [places[index] for index in range(len(rings))]


def somewhere(random: np.random.Generator, area_: WorkArea) -> tuple[float, float, float]:
    """A place (x, y) of `base`, mm, and a turn, rad, uniform over the area."""
    radius = math.sqrt(random.uniform(area_.radius[0] ** 2, area_.radius[1] ** 2))
    azimuth = random.uniform(*area_.azimuth)
    return radius * math.cos(azimuth), radius * math.sin(azimuth), random.uniform(-math.pi, math.pi)


def _squeezed(
    random: np.random.Generator, rings: Sequence[Array], distance: float, area_: WorkArea
) -> list[tuple[float, float, float]] | None:
    """Places found by pushing a random heap apart: denser than places tried one after the other can be."""
    reach = np.array([float(np.sqrt((ring**2).sum(axis=1)).max()) for ring in rings])
    places = np.array([somewhere(random, area_) for _ in rings])
    for _ in range(300):
        apart = places[:, None, :2] - places[None, :, :2]
        separation = np.sqrt((apart**2).sum(axis=2))
        moves = np.zeros((len(rings), 2))
        for i, j in zip(*np.nonzero(np.triu(separation < reach[:, None] + reach + distance, 1)), strict=True):
            missing = distance - gap(placed(rings[i], *places[i]), placed(rings[j], *places[j]))
            if missing > 0.0:
                # A little more than needed, so that the last contacts do not creep for ever.
                push = (0.5 * missing + 0.05) * apart[i, j] / max(separation[i, j], 1e-6)
                moves[i] += push
                moves[j] -= push
        if not moves.any():
            return [(float(x), float(y), float(yaw)) for x, y, yaw in places]
        places[:, :2] += moves
        radius = np.clip(np.hypot(places[:, 0], places[:, 1]), *area_.radius)
        azimuth = np.clip(np.arctan2(places[:, 1], places[:, 0]), *area_.azimuth)
        places[:, 0], places[:, 1] = radius * np.cos(azimuth), radius * np.sin(azimuth)
    return None

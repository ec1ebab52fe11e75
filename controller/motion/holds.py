"""From which sides a part can be held: on its flats, a little off them, beside its middle, or however it lies.

Everything here is planar, in `table` (mm, rad), and of the part alone: what lies around it is asked in `grasps`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from controller.domain import Array, LocatedObject, Shape
from controller.geometry import angle_difference

_CIRCLE_DIRECTIONS = 12
# Turned by less, closing jaws bring a part flush or hold it across its corners; triangles and hexagons are held however
# they lie, if no corner comes near a jaw's edge (physics study of 12 picks a cell, friction 0.3 to 0.8).
_OBLIQUE_TURN = math.radians(15.0)
_OBLIQUE_QUALITY = 0.4
# Beyond these the jaws do not bring it flush but hold two opposite corners, which slip out at friction 0.3.
_CORNER_TURN = {Shape.SQUARE: math.radians(26.0), Shape.RECTANGLE: math.radians(40.0)}
# Jaws of 18 mm that stand this far beside the middle still have it between them: the part does not pivot. What is
# round touches them with one line only, which must stay well off their edge, and so does a triangle's corner.
_SHIFTS = (4.0, -4.0, 7.0, -7.0)
_LINE_SHIFTS = (4.0, -4.0)
# A corner of what lies askew stays before a jaw so far from its edge, or so far beyond it that the jaw bears on a side
# only: near the edge it slips off while the part is carried (physics: 320 picks of triangles, 171 of hexagons).
_INSIDE_EDGE, _BEYOND_EDGE = 3.0, 1.5
_FLUSH = math.radians(5.0)  # turned by less, a hexagon has sides before the jaws, not corners
_SHIFT_QUALITY = 0.8
_FLUSH_TURN = math.radians(20.0)  # turned by more, shifted jaws might not bring a part flush


@dataclass(frozen=True, slots=True)
class Side:
    """A closing direction and how well it holds.

    Attributes:
        direction: rad about z of `table`, in [0, pi).
        quality: 1 for parallel flats across the short side, less for what may slip or turn.
        shift: How far the jaws stand to the left of the part's middle, seen along `direction`, mm.
    """

    direction: float
    quality: float
    shift: float = 0.0


def sides(part: LocatedObject) -> tuple[Side, ...]:
    """Closing directions that a part's outline offers, parallel flats first."""
    yaw = part.yaw if part.yaw is not None else 0.0
    quarter = math.pi / 2
    if part.shape is Shape.CIRCLE:
        step = math.pi / _CIRCLE_DIRECTIONS
        offers = [(k * step, 0.9) for k in range(_CIRCLE_DIRECTIONS)]
    elif part.shape is Shape.SQUARE:
        offers = [(yaw + quarter, 1.0), (yaw, 1.0)]
    elif part.shape is Shape.HEXAGON:
        offers = [(yaw + quarter + k * math.pi / 3, 1.0) for k in range(3)]
    elif part.shape is Shape.TRIANGLE:
        # One jaw flat on a side, the other on the corner opposite: it holds because the corner's line of
        # force meets the flat jaw inside its width.
        offers = [(yaw + quarter + k * math.pi / 3, 0.8) for k in range(3)]
    else:
        offers = [(yaw + quarter, 1.0 if part.shape is Shape.RECTANGLE else 0.7), (yaw, 0.6)]
    return tuple(Side(direction % math.pi, quality) for direction, quality in offers)


def oblique_sides(part: LocatedObject, across: float) -> tuple[Side, ...]:
    """Directions a little off the flats, for when no flat is free: the closing jaws turn the part flush.

    Args:
        part: What to take; what has no flats offers none.
        across: Width of a jaw, mm.
    """
    if part.shape in (Shape.CIRCLE, Shape.OTHER):
        return ()
    return tuple(
        _side(part, side.direction + turn, _OBLIQUE_QUALITY, across)
        for side in sides(part)
        for turn in (-_OBLIQUE_TURN, _OBLIQUE_TURN)
    )


def shifted_sides(offers: Sequence[Side], part: LocatedObject, across: float) -> tuple[Side, ...]:
    """The same directions with the jaws beside the part's middle, for when a neighbour leaves no room before it.

    Args:
        offers: The directions.
        part: What to take.
        across: Width of a jaw, mm.
    """
    rounded = part.shape is Shape.CIRCLE
    flat = [side for side in offers if rounded or _turned(part, side.direction) <= _FLUSH_TURN]
    shifts = _LINE_SHIFTS if rounded or part.shape is Shape.TRIANGLE else _SHIFTS
    found = (
        replace(side, quality=_SHIFT_QUALITY * side.quality, shift=side.shift + by) for by in shifts for side in flat
    )
    return tuple(side for side in found if _corners_hold(part, side, across))


def _turned(part: LocatedObject, direction: float) -> float:
    """Angle between a closing direction and the nearest that the part's outline offers, rad."""
    return min(abs(angle_difference(direction, side.direction, math.pi)) for side in sides(part))


def fixed_side(part: LocatedObject, direction: float, across: float, corners: bool = False) -> Side | None:
    """The only direction an arm without wrist roll can close along, or None when it would not hold.

    Args:
        part: What to take.
        direction: rad about z of `table`.
        across: Width of a jaw, mm.
        corners: Whether two opposite corners are to be held too, which may slip.
    """
    nearest = min(sides(part), key=lambda side: abs(angle_difference(direction, side.direction, math.pi)))
    turn = 0.0 if part.shape is Shape.CIRCLE else _turned(part, direction)
    if not corners and turn > _CORNER_TURN.get(part.shape, math.pi):
        return None
    return _side(part, direction, nearest.quality * (1.0 - turn / math.pi), across)


def _side(part: LocatedObject, direction: float, quality: float, across: float) -> Side:
    """A side that a part may lie askew to, the jaws where they do not squeeze it out.

    One jaw holds a corner and turns the part about it, until the other bears on all of a side; or both hold corners.
    """
    direction %= math.pi
    if part.shape is Shape.TRIANGLE:
        corner, other = _corners(part, direction)
        shifts: tuple[float, ...] = (corner, (corner + other) / 2.0)
    else:
        shifts = (0.0, *_LINE_SHIFTS)
    offers = [Side(direction, quality, shift) for shift in shifts]
    return next((side for side in offers if _corners_hold(part, side, across)), offers[0])


def _corners(part: LocatedObject, direction: float) -> tuple[float, float]:
    """How far left of a part's middle its foremost corner and the one before the other jaw lie, mm."""
    away = part.footprint - np.array(part.center)
    along = away @ np.array([math.cos(direction), math.sin(direction)])
    beside = away @ np.array([-math.sin(direction), math.cos(direction)])
    first, second = sorted((int(along.argmax()), int(along.argmin())), key=lambda k: -abs(float(along[k])))
    return float(beside[first]), float(beside[second])


def _corners_hold(part: LocatedObject, side: Side, across: float) -> bool:
    """Whether no corner of a triangle or hexagon comes before a jaw near the jaw's edge, where it would slip off."""
    flush = part.shape is Shape.HEXAGON and _turned(part, side.direction) < _FLUSH
    if flush or part.shape not in (Shape.TRIANGLE, Shape.HEXAGON):
        return True
    outside = [abs(beside - side.shift) - across / 2.0 for beside in _corners(part, side.direction)]
    if part.shape is Shape.TRIANGLE and outside[0] > 0.0:
        return False  # nothing would stand against the other jaw
    return not any(-_INSIDE_EDGE < beyond < _BEYOND_EDGE for beyond in outside)


def extent_flush(part: LocatedObject, hull: Array, direction: float) -> float:
    """Extent of a part between jaws that have turned it to the nearest of its own directions, mm."""
    own = min(sides(part), key=lambda side: abs(angle_difference(direction, side.direction, math.pi))).direction
    along = hull @ np.array([math.cos(own), math.sin(own)])
    return float(along.max() - along.min())

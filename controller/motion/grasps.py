"""How to take a part: from which sides, how wide open, and with how much room for the jaws.

Everything here is planar, in `table` (mm, rad): the jaws come straight down, each a rectangle that sweeps from its
open position to the part. Whether the arm reaches the grasp is the planner's question.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from controller.domain import Array, Bin, Grasp, Gripper, LocatedObject, Point, Shape
from controller.errors import NoClearGrasp
from controller.geometry import angle_difference

# How high the jaw tips stay over the table: several times the sag the offset leaves.
TIP_HEIGHT = 4.0
# Room between an open jaw and the part on each side: generous first, then what a tight place allows.
OPENING_MARGINS = (5.0, 2.5)
# Room on each side of a part that is let go: a bin has no more to spare beside it, and the jaws arrive within 1 mm.
RELEASE_MARGIN = 3.0
# What has no known shape may bulge below the outline that is seen from above.
_UNKNOWN_MARGIN = 15.0
# A jaw may not come nearer to anything else than this: arm and localisation errors together.
MIN_CLEARANCE = 2.0
ENOUGH_CLEARANCE = 8.0
BIN_WALL = 4.0  # thickness that is kept clear of, mm
_OUTLINE_STEP = 2.0  # mm between the points of an obstacle's outline; below MIN_CLEARANCE nothing slips through
_RING_STEP = 8.0  # mm between the rings of points within it, less than a jaw is thick: none comes down between them
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
_SAME_PLACE, _SAME_TURN = 3.0, math.radians(8.0)  # mm; grasps that differ by less meet the same
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


@dataclass(frozen=True, slots=True)
class Choice:
    """One free way to take a part; `score` orders them, best first."""

    grasp: Grasp
    score: float


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


def fitting_sides(part: LocatedObject, gripper: Gripper) -> list[Side]:
    """Those of the directions that a part's outline offers along which it suits the jaws with room to spare."""
    narrowest, widest = gripper.opening
    return [
        side
        for side in sides(part)
        if narrowest <= _flush(part, part.footprint, side.direction) <= widest - 2.0 * OPENING_MARGINS[0]
    ]


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


def _flush(part: LocatedObject, hull: Array, direction: float) -> float:
    """Extent of the part between jaws that have turned it to the nearest of its own directions, mm."""
    own = min(sides(part), key=lambda side: abs(angle_difference(direction, side.direction, math.pi))).direction
    along = hull @ np.array([math.cos(own), math.sin(own)])
    return float(along.max() - along.min())


def obstacles(others: Sequence[LocatedObject], bins: Sequence[Bin], near: Point, within: float) -> Array:
    """Points (N, 2) on everything within a distance of a place that a jaw must not touch, `table`, mm."""
    found = [solid(other) for other in others if math.dist(other.center, near) < within + max(other.size)]
    for bin_ in bins:
        half = np.array(bin_.size) / 2.0 + BIN_WALL
        if math.dist(bin_.center, near) < within + float(np.hypot(*half)):
            found.append(dense(np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * half + bin_.center))
    points = np.concatenate(found) if found else np.empty((0, 2))
    return np.asarray(points[np.hypot(*(points - near).T) < within])


def solid(thing: LocatedObject) -> Array:
    """Points (N, 2) along an outline and on rings within it, mm: what comes down inside it is as much in the way."""
    rim, middle = dense(thing.footprint), np.array(thing.center)
    count = math.ceil(float(np.hypot(*(rim - middle).T).max()) / _RING_STEP)
    rings = [middle + k / count * (rim[::2] - middle) for k in range(count)]
    return np.concatenate([rim, *rings])


def dense(outline: Array) -> Array:
    """Points every 2 mm along a closed outline."""
    closed = np.concatenate([outline, outline[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    count = max(int(along[-1] / _OUTLINE_STEP) + 1, 3)
    at = np.linspace(0.0, along[-1], count, endpoint=False)
    return np.column_stack([np.interp(at, along, closed[:, 0]), np.interp(at, along, closed[:, 1])])


def ways_to_take(
    part: LocatedObject,
    gripper: Gripper,
    blocked: Array,
    tangent: float | None,
    corners: bool = False,
    avoid: Sequence[Grasp] = (),
) -> list[Choice]:
    """Every free way to take a part of the best kind there is: on its flats, beside its middle, a little askew.

    Args:
        part: What to take.
        gripper: The gripper.
        blocked: ndarray of shape (N, 2): points of `obstacles`, mm.
        tangent: The only closing direction of an arm without wrist roll, rad about z of `table`; None with one.
        corners: See `fixed_side`.
        avoid: Grasps not to be repeated while anything lies near.

    Raises:
        NoClearGrasp: There is none; the message says why on the flats.
    """
    across = gripper.jaw_size[1]
    if tangent is None:
        offers, last = sides(part), oblique_sides(part, across)
    else:
        side = fixed_side(part, tangent, across, corners)
        if side is None:
            place = f"{part.shape} at ({part.center[0]:.0f}, {part.center[1]:.0f}) mm"
            raise NoClearGrasp(f"{place}: lies turned so that the jaws would not hold it", "turn the part")
        offers, last = (side,), ()
    failure: NoClearGrasp | None = None
    for kind in (offers, shifted_sides(offers, part, across), last):
        try:
            if kind:
                return _others_than(avoid, choose(part, kind, gripper, blocked))
        except NoClearGrasp as error:
            failure = failure or error
    assert failure is not None
    raise failure


def _others_than(avoid: Sequence[Grasp], choices: Sequence[Choice]) -> list[Choice]:
    """The choices but those that are to be avoided, unless nothing lies near them any more.

    Raises:
        NoClearGrasp: There is no other.
    """
    left = [c for c in choices if c.grasp.clearance >= ENOUGH_CLEARANCE or not any(_same(c.grasp, a) for a in avoid)]
    if not left:
        raise NoClearGrasp("something lies where the jaws would have room", "move the parts apart")
    return left


def _same(a: Grasp, b: Grasp) -> bool:
    turn = abs(angle_difference(a.direction, b.direction, math.pi))
    return math.dist(a.center, b.center) < _SAME_PLACE and turn < _SAME_TURN


def grasp_height(part: LocatedObject, gripper: Gripper) -> float:
    """Height (z) of the grasp point at a part, the jaw tips just over the table, mm."""
    return min(TIP_HEIGHT, part.height / 2.0) + gripper.jaw_depth


def release_opening(grasp: Grasp, held: float = 0.0) -> float:
    """Clear opening at which a part is let go, mm.

    Args:
        grasp: How it was taken.
        held: Clear opening of the jaws that hold it, mm.
    """
    return min(max(grasp.width, held) + 2.0 * RELEASE_MARGIN, grasp.opening)


def reach_about(part: LocatedObject, gripper: Gripper) -> float:
    """How far about a part's centre something may be in the way of jaws that take it, mm."""
    return gripper.opening[1] / 2.0 + sum(gripper.jaw_size) + ENOUGH_CLEARANCE + max(part.size)


def choose(
    part: LocatedObject,
    offers: Sequence[Side],
    gripper: Gripper,
    blocked: Array,
) -> list[Choice]:
    """Every free way to take a part along the offered directions, best first.

    Args:
        part: What to take.
        offers: Closing directions.
        gripper: The gripper.
        blocked: ndarray of shape (N, 2): points of `obstacles`, mm.

    Raises:
        NoClearGrasp: The part is too wide or too narrow for the jaws everywhere, or something is in the way.
    """
    hull = cv2.convexHull(part.footprint.astype(np.float32)).reshape(-1, 2).astype(np.float64)
    center = np.array(part.center)
    narrowest, widest = gripper.opening
    thickness, across = gripper.jaw_size
    height = grasp_height(part, gripper)
    found: list[Choice] = []
    widths: list[float] = []
    for side in offers:
        axis = np.array([math.cos(side.direction), math.sin(side.direction)])
        along = (hull - center) @ axis
        low, high = float(along.min()), float(along.max())
        width = high - low
        widths.append(width)
        # Both jaws touch at the same time when the grasp point lies in the middle of the extent.
        middle = center + axis * (low + high) / 2.0 + side.shift * np.array([-axis[1], axis[0]])
        unknown = (_UNKNOWN_MARGIN,) if part.shape is Shape.OTHER else ()
        for margin in (*unknown, *OPENING_MARGINS):
            opening = min(width + 2.0 * (margin + part.sigma), widest)
            if opening - width < 2.0 * OPENING_MARGINS[-1] or width < narrowest:
                continue
            clearance = _clearance(blocked, middle, axis, width, opening + 2.0 * thickness, across)
            if clearance < MIN_CLEARANCE + part.sigma:
                continue
            grasp = Grasp(
                center=(float(middle[0]), float(middle[1])),
                height=height,
                direction=side.direction,
                width=width,
                opening=max(opening, narrowest),
                clearance=clearance,
                flush=min(width, _flush(part, hull, side.direction)),
            )
            room = min(clearance, ENOUGH_CLEARANCE) / ENOUGH_CLEARANCE
            spread = margin / OPENING_MARGINS[0]
            found.append(Choice(grasp, side.quality + 0.3 * room + 0.2 * spread))
            break
    if found:
        return sorted(found, key=lambda choice: -choice.score)
    place = f"{part.shape} at ({part.center[0]:.0f}, {part.center[1]:.0f}) mm"
    fitting = [w for w in widths if narrowest <= w <= widest - 2.0 * OPENING_MARGINS[-1]]
    if not fitting:
        size = f"{min(widths):.0f} mm" if widths else "no side that holds"
        raise NoClearGrasp(f"{place}: {size} does not suit jaws of {narrowest:.0f}..{widest:.0f} mm", "take it away")
    raise NoClearGrasp(f"{place}: no room for the jaws on any side", "move the parts apart")


def _clearance(blocked: Array, middle: Array, axis: Array, width: float, span: float, across: float) -> float:
    """Distance of the nearest blocked point from what the jaws sweep (0: inside), mm; inf without points."""
    if not len(blocked):
        return math.inf
    offset = blocked - middle
    along = np.abs(offset @ axis)
    beside = np.abs(offset @ np.array([-axis[1], axis[0]]))
    out = np.maximum(np.maximum(along - span / 2.0, width / 2.0 - along), 0.0)
    aside = np.maximum(beside - across / 2.0, 0.0)
    return float(np.sqrt((out * out + aside * aside).min()))

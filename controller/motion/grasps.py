"""How to take a part: with how wide open jaws, and with how much room for them.

Everything here is planar, in `table` (mm, rad): the jaws come straight down, each a rectangle that sweeps from its
open position to the part. Whether the arm reaches the grasp is the planner's question.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from controller.domain import Array, Bin, Grasp, Gripper, LocatedObject, Point, Shape
from controller.errors import NoClearGrasp
from controller.geometry import angle_difference
from controller.motion import holds

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
_SAME_PLACE, _SAME_TURN = 3.0, math.radians(8.0)  # mm; grasps that differ by less meet the same


@dataclass(frozen=True, slots=True)
class Choice:
    """One free way to take a part; `score` orders them, best first."""

    grasp: Grasp
    score: float


def fitting_sides(part: LocatedObject, gripper: Gripper) -> list[holds.Side]:
    """Those of the directions that a part's outline offers along which it suits the jaws with room to spare."""
    narrowest, widest = gripper.opening[0], gripper.opening[1] - 2.0 * OPENING_MARGINS[0]
    extents = [(side, holds.extent_flush(part, part.footprint, side.direction)) for side in holds.sides(part)]
    return [side for side, extent in extents if narrowest <= extent <= widest]


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
        offers, last = holds.sides(part), holds.oblique_sides(part, across)
    else:
        side = holds.fixed_side(part, tangent, across, corners)
        if side is None:
            place = f"{part.shape} at ({part.center[0]:.0f}, {part.center[1]:.0f}) mm"
            raise NoClearGrasp(f"{place}: lies turned so that the jaws would not hold it", "turn the part")
        offers, last = (side,), ()
    failure: NoClearGrasp | None = None
    for kind in (offers, holds.shifted_sides(offers, part, across), last):
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
    offers: Sequence[holds.Side],
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
                flush=min(width, holds.extent_flush(part, hull, side.direction)),
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

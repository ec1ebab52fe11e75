"""Which push makes room for the jaws: a part, or its neighbour, shoved aside by the closed gripper.

Everything is planar, in `table` (mm, rad), like the grasps: the closed jaws come down beside a part as a box, push
it straight, and rise. Whether the arm can do so is the planner's question. Where a pushed part comes to lie is
only predicted, for friction decides: the cell looks again after every push.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Array, Bin, Gripper, LocatedObject, Point
from controller.errors import NoClearGrasp
from controller.geometry import angle_difference
from controller.motion import grasps, pushing

GAP = 3.0  # mm between the box and the part where the jaws come down, beside the part's sigma
TRAVELS = (10.0, 15.0, 20.0, 30.0, 40.0, 55.0)  # mm that a part is pushed, the least that frees the target first
AREA_MARGIN = 5.0  # mm that a pushed part's middle keeps from the border of the area
_NEIGHBOURHOOD = 70.0  # mm between centres within which a part can stand in the way of another's grasp
_ASIDE = (0.0, 6.0, -6.0, 18.0, -18.0)  # mm by which the box may push beside the part's middle; one finger by the last
_HEADINGS = 16
SHOVE = 25.0  # mm that a part is pushed to loosen a heap: more than half of a part's width
_INTO = 0.9  # cosine between such a push and the way to a neighbour, at most: straight into it moves both alike
_COST_INTO = 20.0  # 45 deg into two of them still parts them best
_TAKES_ALONG = 0.5  # cosine above which a neighbour is taken along
_LEAST_TURN = math.radians(15.0)  # less is not worth a push of its own
_TURNING_TRAVEL = 30.0  # mm after which a part of up to 50 mm lies with a side against the box
_LEVER_WORTH = 3.0  # mm of travel that a turn is worth for each mm beside the middle
# What makes one push better than another that frees the target as well, in mm of travel.
_COST_NEIGHBOUR, _COST_NARROW, _COST_BLOCKED = 10.0, 8.0, 40.0
_SAME_PLACE, _SAME_WAY = 3.0, 0.9  # mm; cosine: what is pushed so again has not given way
_BACK = 12.0  # mm about where a part lay before it was pushed: it is not pushed there again
_MOST = 6  # pushes handed over: when none of them can be planned, the next are no better


@dataclass(frozen=True, slots=True, eq=False)
class Push:
    """One way to make room.

    Attributes:
        moved: The part that is pushed.
        start: (x, y) of the closed gripper's middle where it comes down, mm.
        by: (dx, dy) that the gripper goes, mm.
        direction: Closing direction of the jaws, rad.
        travel: How far the part is expected to go, mm.
        lever: How far beside the part's middle the gripper meets it, mm: what turns it.
        slack: How far the gripper goes beyond `GAP` and the part's sigma until it meets the part, mm.
        cost: The less the better.
    """

    moved: LocatedObject
    start: Point
    by: Point
    direction: float
    travel: float
    lever: float
    slack: float
    cost: float


def pushes(
    target: LocatedObject,
    others: Sequence[LocatedObject],
    bins: Sequence[Bin],
    area: Array,
    gripper: Gripper,
    tangent: Callable[[Point], float] | None,
    tried: Sequence[tuple[Point, Point]] = (),
) -> list[Push]:
    """Pushes after which the target should have a free grasp, best first.

    Args:
        target: What cannot be taken.
        others: Everything else on the table.
        bins: All bins.
        area: ndarray of shape (N, 2): outline that what is pushed must stay in, mm.
        gripper: The gripper.
        tangent: Closing direction of an arm without wrist roll at a point of `table`, rad; None with a roll.
        tried: Earlier pushes that have not freed it: where what was pushed lay, and (dx, dy) by which it was, mm.

    Raises:
        NoClearGrasp: No push, or no other, would free it.
    """
    scene = _Scene(target, tuple(others), tuple(bins), np.ascontiguousarray(area, np.float32), gripper, tangent)
    found: list[Push] = []
    for moved in (target, *scene.culprits()):
        blocked = scene.solid_about(moved)
        rest = scene.rest_without(moved)
        for heading, direction in scene.headings(moved):
            for push in scene.free_pushes(moved, heading, direction, blocked):
                freed = scene.first_that_frees(push, rest)
                if freed is not None:
                    found.append(freed)
    if not found and scene.lies_askew:
        found = list(scene.turnings())
    # Where more than one neighbour stands in the way no single push is enough: one that loosens the heap is a start.
    found = found or [push for moved in (target, *scene.neighbours()) for push in scene.shoves(moved)]
    found = [push for push in found if not any(_again(push, *earlier) for earlier in tried)]
    if not found:
        x, y = target.center
        raise NoClearGrasp(
            f"{target.shape} at ({x:.0f}, {y:.0f}) mm: no push would make room for the jaws", "move the parts apart"
        )
    return sorted(found, key=lambda push: push.cost)[:_MOST]


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """A table with a part that cannot be taken, and a gripper; attributes as for `pushes`."""

    target: LocatedObject
    others: tuple[LocatedObject, ...]
    bins: tuple[Bin, ...]
    border: NDArray[np.float32]
    gripper: Gripper
    tangent: Callable[[Point], float] | None

    def culprits(self) -> list[LocatedObject]:
        """Neighbours, each of which alone keeps the target from being taken, nearest first."""
        near = self.neighbours()
        return [thing for thing in near if self.can_be_taken(self.target, self.rest_without(thing))]

    def neighbours(self) -> list[LocatedObject]:
        """Everything that can stand in the target's way, nearest first."""
        reach = _NEIGHBOURHOOD + max(self.target.size) / 2.0
        near = [thing for thing in self.others if _distance(thing, self.target) < reach]
        return sorted(near, key=lambda thing: _distance(thing, self.target))

    def shoves(self, moved: LocatedObject) -> Iterable[Push]:
        """Pushes of a part past or into its neighbours, to loosen a heap; the less into it the better."""
        blocked = self.solid_about(moved)
        center = np.array(moved.center)
        rest = [thing for thing in (self.target, *self.others) if thing is not moved]
        touching = [thing for thing in rest if _distance(thing, moved) < _NEIGHBOURHOOD]
        ways = [np.array(thing.center) - center for thing in touching]
        if not ways:
            return
        for heading, direction in self.headings(moved):
            ahead = np.array([math.cos(heading), math.sin(heading)])
            into = max(float(way @ ahead) / max(float(np.hypot(*way)), 1e-6) for way in ways)
            taken = [way for way in ways if way @ ahead > _TAKES_ALONG * np.hypot(*way)]
            ends = [center + way + SHOVE * ahead for way in (np.zeros(2), *taken)]
            if into > _INTO or not all(self._inside(end) for end in ends):
                continue
            for push in self.free_pushes(moved, heading, direction, blocked, through=True):
                by = (GAP + moved.sigma + push.slack + SHOVE) * ahead
                cost = push.cost + _COST_INTO * into + (0.0 if moved is self.target else _COST_NEIGHBOUR)
                yield replace(push, by=(float(by[0]), float(by[1])), travel=SHOVE, cost=cost)

    @property
    def lies_askew(self) -> bool:
        """The jaws could not take the target with nothing around it."""
        return not self.can_be_taken(self.target, np.empty((0, 2)))

    def turnings(self) -> Iterable[Push]:
        """Pushes that turn the target, for where a single one does not turn it far enough; the further the better."""
        target = self.target
        blocked = self.solid_about(target)
        for heading, direction in self.headings(target):
            for push in self.free_pushes(target, heading, direction, blocked):
                ahead = np.array(push.by)
                if push.lever == 0.0 or push.travel < _TURNING_TRAVEL:
                    continue
                end = pushing.lands(target, _TURNING_TRAVEL * ahead)[-1]
                turn = abs(angle_difference(end.yaw or 0.0, target.yaw or 0.0, target.shape.period or math.pi))
                if turn > _LEAST_TURN and self._inside(np.array(end.center)):
                    by = (GAP + target.sigma + push.slack + _TURNING_TRAVEL) * ahead
                    cost = push.cost - math.degrees(turn)
                    yield replace(push, by=(float(by[0]), float(by[1])), travel=_TURNING_TRAVEL, cost=cost)

    def _inside(self, place: Array) -> bool:
        return cv2.pointPolygonTest(self.border, (float(place[0]), float(place[1])), True) >= AREA_MARGIN

    def rest_without(self, moved: LocatedObject) -> Array:
        """Points on everything near the target but itself and `moved`."""
        rest = [thing for thing in self.others if thing is not moved]
        within = grasps.reach_about(self.target, self.gripper) + max(TRAVELS)
        return grasps.obstacles(rest, self.bins, self.target.center, within)

    def solid_about(self, moved: LocatedObject) -> Array:
        """Points on everything near a part but itself."""
        rest = [thing for thing in (self.target, *self.others) if thing is not moved]
        within = 2.0 * max(TRAVELS) + self.gripper.opening[1] + max(moved.size)
        return grasps.obstacles(rest, self.bins, moved.center, within)

    def headings(self, moved: LocatedObject) -> Iterable[tuple[float, float]]:
        """(heading of the push, closing direction).

        The broad face of the gripper leads, or its narrow one; without a wrist roll a corner of it may.
        """
        if self.tangent is None:
            for k in range(_HEADINGS):
                heading = 2.0 * math.pi * k / _HEADINGS
                yield heading, heading + math.pi / 2
                yield heading, heading
        else:
            direction = self.tangent(moved.center)
            for k in range(_HEADINGS):
                yield direction + 2.0 * math.pi * k / _HEADINGS, direction

    def free_pushes(
        self, moved: LocatedObject, heading: float, direction: float, blocked: Array, *, through: bool = False
    ) -> Iterable[Push]:
        """Pushes of one part along one heading as far as nothing is in the way; `travel` is the most that is free.

        With `through` only the place where the gripper comes down must be free: what is ahead is pushed along.
        """
        ahead = np.array([math.cos(heading), math.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        broad = abs(math.sin(heading - direction)) > 0.5
        hull = pushing.hull_of(moved) - np.array(moved.center)
        fingers = pushing.finger_edges(self.gripper, direction, ahead, left)
        if self.tangent is not None:
            # The gripper turns with the waist: where it comes down it stands otherwise than at the part.
            x, y = np.array(moved.center) + (float((hull @ ahead).min()) - fingers[..., 0].max()) * ahead
            fingers = pushing.finger_edges(self.gripper, self.tangent((float(x), float(y))), ahead, left)
        deep, wide = float(fingers[..., 0].max()), float(fingers[..., 1].max())
        away = blocked - np.array(moved.center)
        along, beside = away @ ahead, away @ left
        room = grasps.MIN_CLEARANCE + moved.sigma
        most = pushing.free_travel(hull, ahead, left, along, beside)
        gap = GAP + moved.sigma
        rim = pushing.rim_of(hull)
        for aside in _ASIDE:
            # The box keeps clear of what of the rim lies in its way, which need not be the rearmost corner.
            met = rim[np.abs(rim @ left - aside) < wide + room]
            if not len(met):
                continue
            first = met[np.argmin(met @ ahead)]
            middle = float(first @ ahead) - gap - deep
            lane = np.abs(beside - aside) < wide + room
            if (lane & (np.abs(along - middle) < deep + room)).any():
                continue
            coming = along[lane & (along > middle)]
            slack, lever = pushing.contact(fingers, rim @ ahead - middle, rim @ left - aside, aside)
            slack -= gap
            free = min(most, float(coming.min(initial=math.inf)) - middle - deep - room - gap - slack)
            if not math.isfinite(slack) or (free < TRAVELS[0] and not through):
                continue
            start = np.array(moved.center) + middle * ahead + aside * left
            cost = abs(aside) + (0.0 if broad else _COST_NARROW)
            yield Push(
                moved, (float(start[0]), float(start[1])), (float(ahead[0]), float(ahead[1])), direction, free,
                lever, slack, cost,
            )  # fmt: skip

    def first_that_frees(self, push: Push, rest: Array) -> Push | None:
        """The push with the least travel after which the target can be taken past the `rest`, or None."""
        ahead, moved = np.array(push.by), push.moved
        # What the jaws could not take with nothing around is pushed in order to be turned.
        turns = moved is self.target and self.lies_askew
        gap = GAP + moved.sigma
        for travel in TRAVELS:
            if turns and travel < _TURNING_TRAVEL:
                continue
            if travel > push.travel:
                return None
            if not self._inside(np.array(moved.center) + travel * ahead):
                return None
            ends = pushing.lands(moved, travel * ahead)
            if push.lever == 0.0:
                # Both fingers hold a side or a corner of it.
                ends = ends[:1]
            elif turns:
                ends = ends[-1:]
            if all(self._freed(moved, end, rest) for end in ends):
                cost = push.cost + travel - (_LEVER_WORTH * push.lever if turns else 0.0)
                if moved is not self.target:
                    cost += _COST_NEIGHBOUR
                    stays = [thing for thing in (self.target, *self.others) if thing is not moved]
                    within = grasps.reach_about(moved, self.gripper)
                    if not self.can_be_taken(ends[-1], grasps.obstacles(stays, self.bins, ends[-1].center, within)):
                        cost += _COST_BLOCKED
                by = (gap + push.slack + travel) * ahead
                return replace(push, by=(float(by[0]), float(by[1])), travel=travel, cost=cost)
        return None

    def _freed(self, moved: LocatedObject, end: LocatedObject, rest: Array) -> bool:
        if moved is self.target:
            return self.can_be_taken(end, rest)
        return self.can_be_taken(self.target, np.vstack([rest, grasps.solid(end)]))

    def can_be_taken(self, part: LocatedObject, blocked: Array) -> bool:
        """Whether the jaws have a free grasp of a part past points of obstacles."""
        tangent = None if self.tangent is None else self.tangent(part.center)
        try:
            grasps.ways_to_take(part, self.gripper, blocked, tangent)
        except NoClearGrasp:
            return False
        return True


def _again(push: Push, lay: Point, by: Point) -> bool:
    """Whether a push repeats one that has moved nothing, or takes what was pushed back to where it lay."""
    ahead = np.array(push.by) / math.hypot(*push.by)
    stays = math.dist(push.moved.center, lay) < _SAME_PLACE and float(ahead @ by) > _SAME_WAY * math.hypot(*by)
    return stays or math.dist(np.array(push.moved.center) + push.travel * ahead, lay) < _BACK


def _distance(a: LocatedObject, b: LocatedObject) -> float:
    return math.dist(a.center, b.center)

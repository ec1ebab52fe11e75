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
from controller.motion.sliding import slide

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
# What makes one push better than another that frees the target as well, in mm of travel.
_COST_NEIGHBOUR, _COST_NARROW, _COST_UNSURE, _COST_BLOCKED = 10.0, 8.0, 30.0, 40.0
_SAME_PLACE, _SAME_WAY = 3.0, 0.9  # mm; cosine: what is pushed so again has not given way
_BACK = 12.0  # mm about where a part lay before it was pushed: it is not pushed there again
_BORDER_ROOM = 45.0  # mm, half a part and the gripper: nothing is pushed back from nearer to the rim of the reach
_COST_RIM = 2.0  # for each mm of that: what has none is left in the end
_MOST = 12  # pushes handed over: near the rim of the reach hardly any other can be planned


@dataclass(frozen=True, slots=True, eq=False)
class Push:
    """One way to make room.

    Attributes:
        moved: The part that is pushed.
        start: (x, y) of the closed gripper's middle where it comes down, mm.
        ahead: Unit vector that the gripper goes along.
        way: How far it goes, mm.
        travel: How far of it with the part before it, mm; before the push is settled, the most that is free.
        direction: Closing direction of the jaws where they come down, rad.
        cost: The less the better.
        ends: How the part may come to lie.
    """

    moved: LocatedObject
    start: Point
    ahead: Point
    way: float
    travel: float
    direction: float
    cost: float
    ends: tuple[LocatedObject, ...] = ()

    def going(self, travel: float, cost: float, ends: tuple[LocatedObject, ...]) -> Push:
        """The same push, so far."""
        return replace(self, way=self.way - self.travel + travel, travel=travel, cost=cost, ends=ends)


def pushes(
    target: LocatedObject,
    others: Sequence[LocatedObject],
    bins: Sequence[Bin],
    area: Array,
    gripper: Gripper,
    tangent: Callable[[Point], float] | None,
    tried: Sequence[tuple[Point, Point]] = (),
    *,
    unsure: bool = False,
) -> list[Push]:
    """Pushes after which the target should have a free grasp, or may have one, best first.

    Args:
        target: What cannot be taken.
        others: Everything else on the table.
        bins: All bins.
        area: ndarray of shape (N, 2): outline that what is pushed must stay in, mm.
        gripper: The gripper.
        tangent: Closing direction of an arm without wrist roll at a point of `table`, rad; None with a roll.
        tried: Earlier pushes that have not freed it: where what was pushed lay, and (dx, dy) by which it was, mm.
        unsure: Instead of those that are foreseen to free it, those that would if the part went straight; else those
            that loosen the heap.

    Raises:
        NoClearGrasp: No push, or no other, would free it.
    """
    scene = _Scene(target, tuple(others), tuple(bins), np.ascontiguousarray(area, np.float32), gripper, tangent)

    def fresh(found: Iterable[Push]) -> list[Push]:
        return [push for push in found if not any(_again(push, *earlier) for earlier in tried)]

    found = fresh(push for moved in (target, *scene.culprits()) for push in scene.freeing(moved, straight=unsure))
    if not found and unsure:
        # Where more than one neighbour stands in the way no push is enough: one that loosens the heap is a start.
        found = fresh(push for moved in (target, *scene.neighbours()) for push in scene.shoves(moved))
    elif not found and scene.lies_askew:
        found = fresh(scene.turnings())
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

    # --- what to push, and how far --------------------------------------------------------------------------

    def culprits(self) -> list[LocatedObject]:
        """Neighbours, each of which alone keeps the target from being taken, nearest first."""
        near = self.neighbours()
        return [thing for thing in near if self._can_be_taken(self.target, self._outlines_without(thing))]

    def neighbours(self) -> list[LocatedObject]:
        """Everything that can stand in the target's way, nearest first."""
        reach = _NEIGHBOURHOOD + max(self.target.size) / 2.0
        near = [thing for thing in self.others if _distance(thing, self.target) < reach]
        return sorted(near, key=lambda thing: _distance(thing, self.target))

    @property
    def lies_askew(self) -> bool:
        """The jaws could not take the target with nothing around it."""
        return not self._can_be_taken(self.target, np.empty((0, 2)))

    def freeing(self, moved: LocatedObject, *, straight: bool = False) -> Iterable[Push]:
        """Of each push of a part the shortest after which the target can be taken for sure, else perhaps."""
        rest = self._outlines_without(moved)
        for ways in self._slides(moved, straight=straight):
            perhaps = None
            for push in ways:
                freed = [self._freed(moved, end, rest) for end in push.ends]
                if all(freed) and (moved is not self.target or all(map(self._has_spare_room, push.ends))):
                    yield self._priced(push)
                    break
                if any(freed) and perhaps is None:
                    perhaps = push
            else:
                if perhaps is not None:
                    cost = self._priced(perhaps).cost + _COST_UNSURE + self._cost_of_rim(perhaps)
                    yield replace(perhaps, cost=cost)

    def turnings(self) -> Iterable[Push]:
        """Pushes that turn the target nearer to how the jaws could take it, for where one is not enough."""
        askew = self._askew(self.target)
        for ways in self._slides(self.target):
            for push in ways:
                left = max(self._askew(end) for end in push.ends)
                if askew - left > _LEAST_TURN:
                    yield replace(push, cost=push.cost + math.degrees(left) + self._cost_of_rim(push))

    def shoves(self, moved: LocatedObject) -> Iterable[Push]:
        """Pushes of a part past or into its neighbours, to loosen a heap; the less into it the better."""
        center = np.array(moved.center)
        rest = [thing for thing in (self.target, *self.others) if thing is not moved]
        touching = [thing for thing in rest if _distance(thing, moved) < _NEIGHBOURHOOD]
        ways = [np.array(thing.center) - center for thing in touching]
        if not ways:
            return
        for push in self._landings(moved, self._solid_about(moved)):
            ahead = np.array(push.ahead)
            into = max(float(way @ ahead) / max(float(np.hypot(*way)), 1e-6) for way in ways)
            taken = [way for way in ways if way @ ahead > _TAKES_ALONG * np.hypot(*way)]
            ends = [center + way + SHOVE * ahead for way in (np.zeros(2), *taken)]
            if into <= _INTO and all(self._inside(end) for end in ends):
                along = self._pushed_along(moved, ahead)
                lost = sum(self._room_lost(place, place + SHOVE * ahead) for place in along)
                cost = push.cost + _COST_INTO * into + _COST_RIM * lost
                cost += 0.0 if moved is self.target else _COST_NEIGHBOUR
                yield push.going(SHOVE, cost, (pushing.shifted(moved, (*(SHOVE * ahead), 0.0)),))

    # --- one push -------------------------------------------------------------------------------------------

    def _slides(self, moved: LocatedObject, *, straight: bool = False) -> Iterable[list[Push]]:
        """Every free push of a part, with each travel in turn until it meets something or leaves the area.

        The part slides and turns as foreseen, or goes `straight` with the gripper.
        """
        blocked = self._solid_about(moved)
        free = [push for push in self._landings(moved, blocked) if push.travel >= TRAVELS[0]]
        if not free:
            return
        center = np.array(moved.center)
        hull = pushing.coarse(pushing.hull_of(moved) - center)
        aheads = np.array([push.ahead for push in free])
        until = np.array([[push.way - push.travel] for push in free])
        starts = np.array([push.start for push in free]) + until * aheads  # where they meet the part
        turns = np.array([
            self._turns(push.direction, first, first + TRAVELS[-1] * ahead)
            for push, first, ahead in zip(free, starts, aheads, strict=True)
        ])  # fmt: skip
        if straight:
            along = aheads[:, None] * np.array(TRAVELS)[:, None]
            poses = np.concatenate([along, np.zeros((*along.shape[:2], 1))], axis=2)[None]
        else:
            poses = slide(hull, self.gripper, starts - center, aheads, turns, TRAVELS)
        away = blocked - center
        near = away[np.hypot(*away.T) < float(np.hypot(*hull.T).max()) + TRAVELS[-1] + pushing.BUMP][::2]
        clear = np.logical_and.reduce([pushing.keeps_clear(hull, pose, near) for pose in poses])
        for row, push in enumerate(free):
            found = []
            for column, travel in enumerate(TRAVELS):
                ends = tuple(pushing.shifted(moved, pose[row, column]) for pose in poses)
                if travel > push.travel or not clear[row, column] or not all(self._inside(end.center) for end in ends):
                    break
                found.append(push.going(travel, push.cost + travel, ends))
            yield found

    def _turns(self, direction: float, start: Array, end: Array) -> tuple[float, float]:
        """Closing directions at two places of a push: without a wrist roll the gripper turns with the waist."""
        if self.tangent is None:
            return direction, direction
        first = self.tangent(_point(start))
        return first, first + angle_difference(self.tangent(_point(end)), first, math.pi)

    def _landings(self, moved: LocatedObject, blocked: Array) -> Iterable[Push]:
        """Pushes of one part for which the gripper has room to come down, and to go ahead as far as `travel` says.

        What the part itself meets on its way is not asked here.
        """
        center = np.array(moved.center)
        hull = pushing.hull_of(moved) - center
        rim = pushing.rim_of(hull)
        away = blocked - center
        room, gap = grasps.MIN_CLEARANCE + moved.sigma, GAP + moved.sigma
        for heading, direction in self._headings(moved):
            ahead = np.array([math.cos(heading), math.sin(heading)])
            left = np.array([-ahead[1], ahead[0]])
            cost = 0.0 if abs(math.sin(heading - direction)) > 0.5 else _COST_NARROW
            fingers = pushing.finger_edges(self.gripper, direction, ahead, left)
            if self.tangent is not None:
                # The gripper turns with the waist: where it comes down it stands otherwise than at the part.
                place = center + (float((hull @ ahead).min()) - fingers[..., 0].max()) * ahead
                fingers = pushing.finger_edges(self.gripper, self.tangent(_point(place)), ahead, left)
            deep, wide = float(fingers[..., 0].max()), float(fingers[..., 1].max())
            along, beside = away @ ahead, away @ left
            for aside in _ASIDE:
                # The box keeps clear of what of the rim lies in its way, which need not be the rearmost corner.
                met = rim[np.abs(rim @ left - aside) < wide + room]
                if not len(met):
                    continue
                middle = float((met @ ahead).min()) - gap - deep
                lane = np.abs(beside - aside) < wide + room
                if (lane & (np.abs(along - middle) < deep + room)).any():
                    continue
                until = pushing.contact(fingers, rim @ ahead - middle, rim @ left - aside)
                free = float(along[lane & (along > middle)].min(initial=math.inf)) - middle - deep - room
                free = min(free, until + TRAVELS[-1])
                if math.isfinite(until):
                    start = _point(center + middle * ahead + aside * left)
                    turned = direction if self.tangent is None else self.tangent(start)
                    yield Push(moved, start, _point(ahead), free, free - until, turned, cost + abs(aside))

    def _headings(self, moved: LocatedObject) -> Iterable[tuple[float, float]]:
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

    # --- what it is good for --------------------------------------------------------------------------------

    def _priced(self, push: Push) -> Push:
        """A push that frees the target, dearer where a neighbour is pushed, and where that cannot be taken then."""
        moved = push.moved
        if moved is self.target:
            return push
        stays = [thing for thing in (self.target, *self.others) if thing is not moved]
        within = grasps.reach_about(moved, self.gripper)
        takable = all(
            self._can_be_taken(end, grasps.obstacles(stays, self.bins, end.center, within)) for end in push.ends
        )
        return replace(push, cost=push.cost + _COST_NEIGHBOUR + (0.0 if takable else _COST_BLOCKED))

    def _freed(self, moved: LocatedObject, end: LocatedObject, rest: Array) -> bool:
        if moved is self.target:
            return self._can_be_taken(end, rest)
        return self._can_be_taken(self.target, np.vstack([rest, grasps.dense(end.footprint)]))

    def _can_be_taken(self, part: LocatedObject, blocked: Array) -> bool:
        """Whether the jaws have a free grasp of a part past points of obstacles."""
        tangent = None if self.tangent is None else self.tangent(part.center)
        try:
            grasps.ways_to_take(part, self.gripper, blocked, tangent)
        except NoClearGrasp:
            return False
        return True

    def _has_spare_room(self, part: LocatedObject) -> bool:
        """Jaws that cannot turn reach around a part even if it comes to lie a little otherwise than foreseen."""
        if self.tangent is None:
            return True
        direction = self.tangent(part.center)
        along = part.footprint @ np.array([math.cos(direction), math.sin(direction)])
        return float(np.ptp(along)) <= self.gripper.opening[1] - 2.0 * grasps.OPENING_MARGINS[0]

    def _askew(self, part: LocatedObject) -> float:
        """How far a part is turned away from the nearest of its sides that the jaws can close flush on, rad."""
        if self.tangent is None:
            return 0.0
        direction = self.tangent(part.center)
        fitting = grasps.fitting_sides(part, self.gripper)
        return min((abs(angle_difference(direction, side.direction, math.pi)) for side in fitting), default=0.0)

    def _inside(self, place: Array | Point) -> bool:
        return cv2.pointPolygonTest(self.border, (float(place[0]), float(place[1])), True) >= AREA_MARGIN

    def _cost_of_rim(self, push: Push) -> float:
        """What the room costs that a push takes from between a part and the border."""
        return _COST_RIM * max(self._room_lost(push.moved.center, end.center) for end in push.ends)

    def _pushed_along(self, moved: LocatedObject, ahead: Array) -> list[Array]:
        """Where what may go along with a part that is pushed lies now, itself first: neighbours, and theirs."""
        waiting = [np.array(thing.center) for thing in (self.target, *self.others) if thing is not moved]
        found = [np.array(moved.center)]
        for center in found:
            ways = [(place, place - center) for place in waiting]
            met = [place for place, way in ways if _TAKES_ALONG * np.hypot(*way) < way @ ahead < _NEIGHBOURHOOD]
            waiting = [place for place in waiting if not any(place is other for other in met)]
            found += met
        return found

    def _room_lost(self, start: Array | Point, end: Array | Point) -> float:
        """How much of the room that the gripper needs between a part and the border a push takes, mm."""
        before, after = (cv2.pointPolygonTest(self.border, (float(x), float(y)), True) for x, y in (start, end))
        return max(min(before, _BORDER_ROOM) - after, 0.0)

    def _outlines_without(self, moved: LocatedObject) -> Array:
        """Points along all outlines near the target but its own and that of `moved`."""
        rest = [thing for thing in self.others if thing is not moved]
        within = grasps.reach_about(self.target, self.gripper) + max(TRAVELS)
        return grasps.obstacles(rest, self.bins, self.target.center, within)

    def _solid_about(self, moved: LocatedObject) -> Array:
        """Points on and inside everything near a part but itself: no box may come down inside an outline either."""
        rest = [thing for thing in (self.target, *self.others) if thing is not moved]
        return grasps.obstacles(rest, self.bins, moved.center, 2.0 * max(TRAVELS) + self.gripper.opening[1])


def _again(push: Push, lay: Point, by: Point) -> bool:
    """Whether a push repeats one that has moved nothing, or takes what was pushed back to where it lay."""
    along = float(np.dot(push.ahead, by)) > _SAME_WAY * math.hypot(*by)
    stays = along and math.dist(push.moved.center, lay) < _SAME_PLACE
    return stays or any(math.dist(end.center, lay) < _BACK for end in push.ends)


def _distance(a: LocatedObject, b: LocatedObject) -> float:
    return math.dist(a.center, b.center)


def _point(place: Array) -> Point:
    return float(place[0]), float(place[1])

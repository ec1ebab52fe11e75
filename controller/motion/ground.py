"""Where the closed jaws can come down beside a part and push it, how far, and how it then comes to lie.

Planar, in `table` (mm, rad). What such a push is good for is asked in `nudges`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Array, Bin, Gripper, LocatedObject, Point
from controller.geometry import angle_difference
from controller.motion import grasps, pushing
from controller.motion.sliding import slide

GAP = 3.0  # mm between the box and the part where the jaws come down, beside the part's sigma
TRAVELS = (10.0, 15.0, 20.0, 30.0, 40.0, 55.0)  # mm that a part is pushed, the least that frees the target first
AREA_MARGIN = 5.0  # mm that a pushed part's middle keeps from the border of the area
_ASIDE = (0.0, 6.0, -6.0, 18.0, -18.0)  # mm by which the box may push beside the part's middle; one finger by the last
_HEADINGS = 16  # 22.5 deg apart; more cost time in proportion
_BROADSIDE = math.sin(math.radians(30.0))  # from so far off the jaws' closing direction on their broad face leads
_COST_NARROW = 8.0  # mm of travel that a push with the narrow face is worse
_BORDER_ROOM = 45.0  # mm, half a part and the gripper: nothing is pushed back from nearer to the rim of the reach


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


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """A table with things on it, and a gripper to push them.

    Attributes:
        things: Everything on the table.
        bins: All bins.
        border: ndarray of shape (N, 2): outline that what is pushed must stay in, mm.
        gripper: The gripper.
        tangent: Closing direction of an arm without wrist roll at a point of `table`, rad; None with a roll.
    """

    things: tuple[LocatedObject, ...]
    bins: tuple[Bin, ...]
    border: NDArray[np.float32]
    gripper: Gripper
    tangent: Callable[[Point], float] | None

    def slides(self, moved: LocatedObject, *, straight: bool = False) -> list[list[Push]]:
        """Every free push of a part, with each travel in turn until it meets something or leaves the area.

        The part slides and turns as foreseen, or goes `straight` with the gripper.
        """
        blocked = self.solid_about(moved)
        free = [push for push in self.landings(moved, blocked) if push.travel >= TRAVELS[0]]
        if not free:
            return []
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
        # Every second point, 4 mm apart: a hull that keeps 3 mm from each meets nothing between them.
        near = away[np.hypot(*away.T) < float(np.hypot(*hull.T).max()) + TRAVELS[-1] + pushing.BUMP][::2]
        clear = np.logical_and.reduce([pushing.keeps_clear(hull, pose, near) for pose in poses])
        every = []
        for row, push in enumerate(free):
            found = []
            for column, travel in enumerate(TRAVELS):
                ends = tuple(pushing.shifted(moved, pose[row, column]) for pose in poses)
                if travel > push.travel or not clear[row, column] or not all(self.inside(end.center) for end in ends):
                    break
                found.append(push.going(travel, push.cost + travel, ends))
            every.append(found)
        return every

    def _turns(self, direction: float, start: Array, end: Array) -> tuple[float, float]:
        """Closing directions at two places of a push: without a wrist roll the gripper turns with the waist."""
        if self.tangent is None:
            return direction, direction
        first = self.tangent(_point(start))
        return first, first + angle_difference(self.tangent(_point(end)), first, math.pi)

    def landings(self, moved: LocatedObject, blocked: Array) -> Iterable[Push]:
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
            cost = 0.0 if abs(math.sin(heading - direction)) > _BROADSIDE else _COST_NARROW
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

    def inside(self, place: Array | Point) -> bool:
        """Whether a pushed part's middle may come there."""
        return cv2.pointPolygonTest(self.border, (float(place[0]), float(place[1])), True) >= AREA_MARGIN

    def room_lost(self, start: Array | Point, end: Array | Point) -> float:
        """How much of the room that the gripper needs between a part and the border a push takes, mm."""
        before, after = (cv2.pointPolygonTest(self.border, (float(x), float(y)), True) for x, y in (start, end))
        return max(min(before, _BORDER_ROOM) - after, 0.0)

    def solid_about(self, moved: LocatedObject) -> Array:
        """Points on and inside everything near a part but itself: no box may come down inside an outline either."""
        rest = [thing for thing in self.things if thing is not moved]
        return grasps.obstacles(rest, self.bins, moved.center, 2.0 * max(TRAVELS) + self.gripper.opening[1])


def _point(place: Array) -> Point:
    return float(place[0]), float(place[1])

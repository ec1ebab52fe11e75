"""Which push makes room for the jaws: a part, or its neighbour, shoved aside by the closed gripper.

Everything is planar, in `table` (mm, rad), like the grasps: the closed jaws come down beside a part as a box, push
it straight, and rise. Whether the arm can do so is the planner's question. Where a pushed part comes to lie is
only predicted, for friction decides: the cell looks again after every push.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from controller.domain import Array, Bin, Gripper, LocatedObject, Point
from controller.errors import NoClearGrasp
from controller.geometry import angle_difference
from controller.motion import grasps, pushing
from controller.motion.ground import TRAVELS, Ground, Push

_NEIGHBOURHOOD = 70.0  # mm between centres within which a part can stand in the way of another's grasp, or push
SHOVE = 25.0  # mm that a part is pushed to loosen a heap: more than half of a part's width
_INTO = 0.9  # cosine between such a push and the way to a neighbour, at most: straight into it moves both alike
_COST_INTO = 20.0  # 45 deg into two of them still parts them best
_TAKES_ALONG = 0.5  # cosine above which a neighbour is taken along
_LEAST_TURN = math.radians(15.0)  # less is not worth a push of its own
# What makes one push better than another that frees the target as well, in mm of travel.
_COST_NEIGHBOUR, _COST_UNSURE, _COST_BLOCKED = 10.0, 30.0, 40.0
_SAME_PLACE, _SAME_WAY = 3.0, 0.9  # mm; cosine: what is pushed so again has not given way
_BACK = 12.0  # mm about where a part lay before it was pushed: it is not pushed there again
_COST_RIM = 2.0  # for each mm of room between a part and the border: what has none is left in the end
_MOST = 12  # pushes handed over: near the rim of the reach hardly any other can be planned


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
    border = np.ascontiguousarray(area, np.float32)
    ground = Ground((target, *others), tuple(bins), border, gripper, tangent)
    scene = _Scene(target, tuple(others), ground)

    def fresh(found: Iterable[Push]) -> list[Push]:
        return [push for push in found if not any(_again(push, *earlier) for earlier in tried)]

    slides = {moved: ground.slides(moved, straight=unsure) for moved in (target, *scene.culprits())}
    found = fresh(push for moved, ways in slides.items() for push in scene.freeing(moved, ways))
    if not found and unsure:
        # Where more than one neighbour stands in the way no push is enough: one that loosens the heap is a start.
        found = fresh(push for moved in (target, *scene.neighbours()) for push in scene.shoves(moved))
    elif not found and scene.lies_askew:
        found = fresh(scene.turnings(slides[target]))
    if not found:
        x, y = target.center
        raise NoClearGrasp(
            f"{target.shape} at ({x:.0f}, {y:.0f}) mm: no push would make room for the jaws", "move the parts apart"
        )
    return sorted(found, key=lambda push: push.cost)[:_MOST]


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """A table with a part that cannot be taken.

    Attributes:
        target: The part.
        others: Everything else.
        ground: All of it.
    """

    target: LocatedObject
    others: tuple[LocatedObject, ...]
    ground: Ground

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

    def freeing(self, moved: LocatedObject, slides: Sequence[Sequence[Push]]) -> Iterable[Push]:
        """Of each push of a part the shortest after which the target can be taken for sure, else perhaps.

        Args:
            moved: The part.
            slides: See `Ground.slides`.
        """
        rest = self._outlines_without(moved)
        for ways in slides:
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

    def turnings(self, slides: Sequence[Sequence[Push]]) -> Iterable[Push]:
        """Pushes that turn the target nearer to how the jaws could take it, for where one is not enough."""
        askew = self._askew(self.target)
        for push in itertools.chain.from_iterable(slides):
            left = max(self._askew(end) for end in push.ends)
            if askew - left > _LEAST_TURN:
                yield replace(push, cost=push.cost + math.degrees(left) + self._cost_of_rim(push))

    def shoves(self, moved: LocatedObject) -> Iterable[Push]:
        """Pushes of a part past or into its neighbours, to loosen a heap; the less into it the better."""
        center = np.array(moved.center)
        rest = [thing for thing in self.ground.things if thing is not moved]
        touching = [thing for thing in rest if _distance(thing, moved) < _NEIGHBOURHOOD]
        ways = [np.array(thing.center) - center for thing in touching]
        if not ways:
            return
        for push in self.ground.landings(moved, self.ground.solid_about(moved)):
            ahead = np.array(push.ahead)
            into = max(float(way @ ahead) / max(float(np.hypot(*way)), 1e-6) for way in ways)
            taken = [way for way in ways if way @ ahead > _TAKES_ALONG * np.hypot(*way)]
            ends = [center + way + SHOVE * ahead for way in (np.zeros(2), *taken)]
            if into <= _INTO and all(self.ground.inside(end) for end in ends):
                along = self._pushed_along(moved, ahead)
                lost = sum(self.ground.room_lost(place, place + SHOVE * ahead) for place in along)
                cost = push.cost + _COST_INTO * into + _COST_RIM * lost
                cost += 0.0 if moved is self.target else _COST_NEIGHBOUR
                yield push.going(SHOVE, cost, (pushing.shifted(moved, (*(SHOVE * ahead), 0.0)),))

    # --- what it is good for --------------------------------------------------------------------------------

    def _priced(self, push: Push) -> Push:
        """A push that frees the target, dearer where a neighbour is pushed, and where that cannot be taken then."""
        moved = push.moved
        if moved is self.target:
            return push
        stays = [thing for thing in self.ground.things if thing is not moved]
        within = grasps.reach_about(moved, self.ground.gripper)
        takable = all(
            self._can_be_taken(end, grasps.obstacles(stays, self.ground.bins, end.center, within)) for end in push.ends
        )
        return replace(push, cost=push.cost + _COST_NEIGHBOUR + (0.0 if takable else _COST_BLOCKED))

    def _freed(self, moved: LocatedObject, end: LocatedObject, rest: Array) -> bool:
        if moved is self.target:
            return self._can_be_taken(end, rest)
        return self._can_be_taken(self.target, np.vstack([rest, grasps.dense(end.footprint)]))

    def _can_be_taken(self, part: LocatedObject, blocked: Array) -> bool:
        """Whether the jaws have a free grasp of a part past points of obstacles."""
        tangent = None if self.ground.tangent is None else self.ground.tangent(part.center)
        try:
            grasps.ways_to_take(part, self.ground.gripper, blocked, tangent)
        except NoClearGrasp:
            return False
        return True

    def _has_spare_room(self, part: LocatedObject) -> bool:
        """Jaws that cannot turn reach around a part even if it comes to lie a little otherwise than foreseen."""
        if self.ground.tangent is None:
            return True
        direction = self.ground.tangent(part.center)
        along = part.footprint @ np.array([math.cos(direction), math.sin(direction)])
        return float(np.ptp(along)) <= self.ground.gripper.opening[1] - 2.0 * grasps.OPENING_MARGINS[0]

    def _askew(self, part: LocatedObject) -> float:
        """How far a part is turned away from the nearest of its sides that the jaws can close flush on, rad."""
        if self.ground.tangent is None:
            return 0.0
        direction = self.ground.tangent(part.center)
        fitting = grasps.fitting_sides(part, self.ground.gripper)
        return min((abs(angle_difference(direction, side.direction, math.pi)) for side in fitting), default=0.0)

    def _cost_of_rim(self, push: Push) -> float:
        """What the room costs that a push takes from between a part and the border."""
        return _COST_RIM * max(self.ground.room_lost(push.moved.center, end.center) for end in push.ends)

    def _pushed_along(self, moved: LocatedObject, ahead: Array) -> list[Array]:
        """Where what may go along with a part that is pushed lies now, itself first: neighbours, and theirs."""
        waiting = [np.array(thing.center) for thing in self.ground.things if thing is not moved]
        found = [np.array(moved.center)]
        for center in found:
            ways = [(place, place - center) for place in waiting]
            met = [place for place, way in ways if _TAKES_ALONG * np.hypot(*way) < way @ ahead < _NEIGHBOURHOOD]
            waiting = [place for place in waiting if not any(place is other for other in met)]
            found += met
        return found

    def _outlines_without(self, moved: LocatedObject) -> Array:
        """Points along all outlines near the target but its own and that of `moved`."""
        rest = [thing for thing in self.others if thing is not moved]
        within = grasps.reach_about(self.target, self.ground.gripper) + max(TRAVELS)
        return grasps.obstacles(rest, self.ground.bins, self.target.center, within)


def _again(push: Push, lay: Point, by: Point) -> bool:
    """Whether a push repeats one that has moved nothing, or takes anything to where what was pushed lay."""
    along = float(np.dot(push.ahead, by)) > _SAME_WAY * math.hypot(*by)
    stays = along and math.dist(push.moved.center, lay) < _SAME_PLACE
    return stays or any(math.dist(end.center, lay) < _BACK for end in push.ends)


def _distance(a: LocatedObject, b: LocatedObject) -> float:
    return math.dist(a.center, b.center)

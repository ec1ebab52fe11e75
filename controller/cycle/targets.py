"""Which object is which from one look to the next, so that a part retried twice is still one part.

The camera gives places, not identities. Whatever lies where a target was last known to be is that target, and so
is an object of its shape and size a little further, where a missed grasp may have pushed it. After it was lost on
the way, it may turn up wherever nothing lay before.

What was dropped or gripped in vain may lie on its side afterwards, and a square prism on its side looks like a
rectangle. So a part that looks like another one after the jaws were at it, and what turns up unlike the part that was
just dropped, is of no known shape: it goes where such things go, not into the bin of what it looks like.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from controller.cycle.doubt import nameless
from controller.domain import LocatedObject, PickPlan, Point, Shape

VERY_PLACE_MM = 15.0
"""Nearer than half of the narrowest part (34 mm) there is room for one part only, whatever it was taken for."""
SAME_PLACE_MM = 25.0
"""A missed grasp pushes a part by less than half of the narrowest part (34 mm wide) plus the jaw's stroke."""
REST = 3
"""Parts taken away meanwhile may have been what stood in the way of one that could not be gripped."""
SAME_SIZE_MM = 3.0
"""Two looks at one part differ by less: size sigma 0.3 mm, plus what a side face can add near the border."""

STRAY_LOOKS = 3
"""Looks after a part was dropped in which it may turn up: it may roll on, or lie hidden by a neighbour at first."""

TOPPLED_MM = 3.0
"""A part that topples moves by half the difference of its height and its width, 4.5 mm for the smallest hexagon."""

GONE_AFTER = 3
"""Looks in a row that do not show what was given up, after which somebody has taken it: the next there is new."""


@dataclass(slots=True)
class Target:
    """One physical object chosen to be picked.

    Attributes:
        target_id: Unique within the run.
        located: Where it was last seen.
        started_at: s of the cell's clock, when it was first chosen.
        attempts: How often motion was started for it.
        plan: The last plan.
        lost: It left its place without arriving: it may lie anywhere.
        nudges: How often something was pushed to make room for it since `nudged_among` targets had their outcome.
        pushed: Where what was pushed for it lay before, and by how much it was, `table`, mm.
        rests_until: So many targets must have their outcome before it is tried again.
        doubtful: It may lie on its side: what it looks like is not what it is.
    """

    target_id: str
    located: LocatedObject
    started_at: float
    attempts: int = 0
    plan: PickPlan | None = None
    lost: bool = False
    reason: str = ""
    nudges: int = 0
    nudged_among: int = 0
    pushed: list[tuple[Point, Point]] = field(default_factory=list)
    rests_until: int = 0
    doubtful: bool = False


@dataclass(slots=True)
class _GivenUp:
    """What was given up and is left alone while it lies there; without its picture, as there may be many.

    Attributes:
        unseen: Looks in a row that did not show it.
    """

    center: tuple[float, float]
    shape: Shape
    size: tuple[float, float]
    unseen: int = 0

    def is_(self, thing: LocatedObject) -> bool:
        """Whether an object seen now is this one."""
        distance = math.dist(thing.center, self.center)
        return distance <= VERY_PLACE_MM or (distance <= SAME_PLACE_MM and _alike(thing, self))


class TargetBook:
    """The open targets of a run."""

    def __init__(self, prefix: str = "t") -> None:
        self._prefix = prefix
        self._count = 0
        self._open: dict[str, Target] = {}
        self._given_up: list[_GivenUp] = []
        self._previous: list[tuple[float, float]] = []
        self._doubtful: list[tuple[float, float]] = []
        self._pushed: list[LocatedObject] = []
        self._strays = 0

    @property
    def open(self) -> tuple[Target, ...]:
        """Targets without an outcome, oldest first."""
        return tuple(self._open.values())

    @property
    def resting(self) -> tuple[Target, ...]:
        """Open targets that wait until something around them may have changed."""
        return tuple(target for target in self._open.values() if target.rests_until)

    def rests(self, target: Target, attempts: int, concluded: int) -> bool:
        """Whether a target that was missed is to be tried again, at once or after a rest; or never any more.

        Args:
            target: The target.
            attempts: So many in a row, then a rest; after the second round it is over.
            concluded: How many targets have their outcome.
        """
        if target.attempts >= 2 * attempts:
            return False
        if target.attempts == attempts:
            target.rests_until = concluded + REST
        return True

    def identify(self, seen: Sequence[LocatedObject]) -> tuple[list[LocatedObject], list[Target]]:
        """Give every object of a new look the id of the open target it is.

        Returns:
            The objects, those that are open targets with their `target_id`; and the open targets that
            were tried and are nowhere to be seen any more.
        """
        if any(target.lost for target in self._open.values()):
            self._strays = STRAY_LOOKS
        free = list(range(len(seen)))
        ids: dict[int, str] = {}
        doubtful = {i for i, thing in enumerate(seen) if _near(thing.center, self._doubtful, VERY_PLACE_MM)}
        for target in self._open.values():
            match = self._match(target, seen, free)
            if match is not None:
                free.remove(match)
                ids[match] = target.target_id
                before = target.located
                if target.attempts and _toppled(before, seen[match]):
                    target.doubtful = True
                if target.doubtful:
                    doubtful.add(match)
                target.located = dataclasses.replace(seen[match], target_id=target.target_id)
                target.lost = False
        if self._strays:
            self._strays -= 1
            doubtful |= {
                i
                for i in free
                if not _near(seen[i].center, self._previous, SAME_PLACE_MM) and not self._is_pushed(seen[i])
            }
        self._doubtful = [seen[i].center for i in doubtful]
        named = [
            dataclasses.replace(nameless(thing) if i in doubtful else thing, target_id=ids.get(i, ""))
            for i, thing in enumerate(seen)
        ]
        gone = [t for t in self._open.values() if t.attempts and t.target_id not in ids.values()]
        self._previous = [thing.center for thing in seen]
        self._pushed = self._pushed if self._strays else []
        for old in self._given_up:
            old.unseen = 0 if any(old.is_(thing) for thing in seen) else old.unseen + 1
        self._given_up = [old for old in self._given_up if old.unseen < GONE_AFTER]
        return named, gone

    def _match(self, target: Target, seen: Sequence[LocatedObject], free: list[int]) -> int | None:
        best, best_distance = None, math.inf
        for index in free:
            thing = seen[index]
            distance = math.dist(thing.center, target.located.center)
            if distance > VERY_PLACE_MM and not _alike(thing, target.located):
                continue
            if distance > SAME_PLACE_MM:
                newcomer = not _near(thing.center, self._previous, SAME_PLACE_MM)
                if not ((target.attempts or target.pushed) and newcomer):
                    continue
            if distance < best_distance:
                best, best_distance = index, distance
        return best

    def choose(self, located: LocatedObject, now: float) -> Target:
        """The open target an object is, or a new one."""
        known = self._open.get(located.target_id)
        if known is not None:
            return known
        self._count += 1
        target_id = f"{self._prefix}{self._count}"
        target = Target(target_id, dataclasses.replace(located, target_id=target_id), now)
        self._open[target_id] = target
        return target

    def pushed(self, ends: Sequence[LocatedObject]) -> None:
        """A thing was pushed and may lie so now: there it is no stray."""
        self._pushed += ends

    def _is_pushed(self, thing: LocatedObject) -> bool:
        return any(
            _alike(thing, pushed) and math.dist(thing.center, pushed.center) <= SAME_PLACE_MM for pushed in self._pushed
        )

    def close(self, target: Target) -> None:
        """Forget a target that has its outcome."""
        if target.lost:
            self._strays = STRAY_LOOKS
        # Where it lay there is room for another.
        self._previous = [at for at in self._previous if math.dist(at, target.located.center) > VERY_PLACE_MM]
        del self._open[target.target_id]

    def give_up(self, target: Target) -> None:
        """Forget a target that lies where it was and is not to be tried again."""
        self.close(target)
        located = target.located
        self._given_up.append(_GivenUp(located.center, located.shape, located.size))

    def is_given_up(self, thing: LocatedObject) -> bool:
        """Whether an object is one that was given up and still lies there."""
        return any(old.is_(thing) for old in self._given_up)


def _alike(a: LocatedObject, b: LocatedObject | _GivenUp) -> bool:
    return a.shape is b.shape and all(abs(x - y) <= SAME_SIZE_MM for x, y in zip(a.size, b.size, strict=True))


def _toppled(before: LocatedObject, now: LocatedObject) -> bool:
    """Whether a part that the jaws were at may lie on its side: of known shape, it has moved and looks unlike."""
    moved = math.dist(before.center, now.center) > TOPPLED_MM
    return moved and before.shape is not Shape.OTHER and not _alike(now, before)


def _near(place: tuple[float, float], places: Sequence[tuple[float, float]], within: float) -> bool:
    return any(math.dist(place, other) <= within for other in places)

"""Which share of scattered parts the jaws can take: at once, after clearing what can be taken, and after nudging.

Layouts: parts of 34 to 44 mm (squares, circles, hexagons, triangles) at random, 1 mm apart at least, on a ring
sector 150 to 240 mm from the waist, 50 degrees to either side: 8 or 12 of them on some 280 cm2. Nothing is simulated:
where a pushed part comes to lie is drawn between what little and much friction would give, within 3 mm.
The planner's own gate judges every move. `python -m tests.benchmarks.crowded --clear` asks the physics engine instead.

    python -m tests.benchmarks.finger_room [--layouts N] [--seed N] [--arms NAME ...] [--parts N ...]
"""

from __future__ import annotations

import argparse
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from controller.config.arm import load_arm
from controller.domain import LocatedObject, Shape
from controller.errors import NoClearGrasp, PlanError
from controller.motion.planner import Planner
from tests.benchmarks.motion import AREA
from tests.unit.motion.scene import PARTS, at, bins, calibration, part, polygon_gap

BIN_RADIUS = {"pincherx_100": 190.0, "open_manipulator_x": 200.0}
MOST_NUDGES = 3  # of one part
_TRIES = 2000


@dataclass(slots=True)
class Room:
    """What became of the parts of one or more layouts."""

    parts: int = 0
    at_once: int = 0
    cleared: int = 0
    nudged: int = 0
    nudges: int = 0
    unreachable: int = 0


def pile(rng: np.random.Generator, count: int) -> list[LocatedObject]:
    """Parts scattered at random, 1 mm apart at least (by their true outlines)."""
    for _ in range(100):
        found: list[LocatedObject] = []
        for _ in range(_TRIES):
            radius, azimuth = math.sqrt(rng.uniform(150.0**2, 240.0**2)), rng.uniform(-50.0, 50.0)
            shape = PARTS[int(rng.integers(5))]
            shape = shape if shape is not Shape.RECTANGLE else Shape.SQUARE
            thing = part(shape, rng.uniform(34.0, 44.0), at(radius, azimuth), rng.uniform(0, 6.3))
            if all(polygon_gap(thing.footprint, other.footprint) > 1.0 for other in found):
                found.append(thing)
                if len(found) == count:
                    return found
    raise ValueError(f"{count} parts do not fit")


class Table:
    """One layout being cleared."""

    def __init__(self, planner: Planner, things: list[LocatedObject], rng: np.random.Generator, room: Room) -> None:
        self._planner, self._rng, self._room = planner, rng, room
        self.left = things
        self._ready = np.array(planner.arm.ready)

    def can_be_taken(self, thing: LocatedObject) -> bool | None:
        """Whether a plan exists; None when there never will be."""
        bin_ = self._planner.bins[0]
        others = [other for other in self.left if other is not thing]
        try:
            self._planner.plan_pick(thing, others, bin_, bin_.center, self._ready)
        except NoClearGrasp:
            return False
        except PlanError:
            return None
        return True

    def clear(self) -> int:
        """Take away what can be taken until nothing can; how much that was."""
        taken = 0
        while gone := [thing for thing in self.left if self.can_be_taken(thing)]:
            taken += len(gone)
            self.left = [thing for thing in self.left if thing not in gone]
        return taken

    def nudge(self, tries: dict[int, int]) -> bool:
        """Push once for the first part that a push can free; False when there is none."""
        for unsure, thing in itertools.product((False, True), self.left):
            if tries.get(id(thing.detection), 0) >= MOST_NUDGES or self.can_be_taken(thing) is not False:
                continue
            others = [other for other in self.left if other is not thing]
            try:
                plan = self._planner.plan_nudge(thing, others, AREA, self._ready, unsure=unsure)
            except PlanError:
                continue
            tries[id(thing.detection)] = tries.get(id(thing.detection), 0) + 1
            self._room.nudges += 1
            end = plan.ends[int(self._rng.integers(len(plan.ends)))]
            self.left = [self._shaken(end, other) if other is plan.moved else other for other in self.left]
            return True
        return False

    def _shaken(self, end: LocatedObject, before: LocatedObject) -> LocatedObject:
        """Where a pushed part lies in the end: up to 3 mm off, unless it would lie on another."""
        rest = [other for other in self.left if other is not before]
        for _ in range(20):
            dx, dy = self._rng.uniform(-3.0, 3.0, 2)
            moved = _shifted(end, dx, dy)
            if all(polygon_gap(moved.footprint, other.footprint) > 0.2 for other in rest):
                return moved
        return end


def _shifted(thing: LocatedObject, dx: float, dy: float) -> LocatedObject:
    center = thing.center[0] + dx, thing.center[1] + dy
    return replace(thing, center=center, footprint=thing.footprint + np.array([dx, dy]))


def study(name: str, count: int, layouts: int, seed: int) -> Room:
    """Clear layouts of one arm."""
    arm = load_arm(name)
    planner = Planner(arm, calibration(), bins(BIN_RADIUS.get(name, 230.0))[::3])
    room = Room()
    for k in range(layouts):
        rng = np.random.default_rng([seed, k])
        table = Table(planner, pile(rng, count), rng, room)
        verdicts = [table.can_be_taken(thing) for thing in table.left]
        reachable = [thing for thing, verdict in zip(table.left, verdicts, strict=True) if verdict is not None]
        room.unreachable += count - len(reachable)
        room.parts += len(reachable)
        room.at_once += sum(verdict is True for verdict in verdicts)
        room.cleared += table.clear()
        tries: dict[int, int] = {}
        while table.nudge(tries):
            room.nudged += table.clear()
    return room


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layouts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--arms", nargs="*", default=["reactorx_150", "open_manipulator_x", "pincherx_100"])
    parser.add_argument("--parts", type=int, nargs="*", default=[8, 12])
    options = parser.parse_args()
    print(f"{'arm':20} {'joints':>6} {'parts':>5} {'at once':>8} {'cleared':>8} {'nudged':>8} {'nudges':>7}")
    for name in options.arms:
        for count in options.parts:
            room = study(name, count, options.layouts, options.seed)
            cleared, nudged = room.cleared / room.parts, (room.cleared + room.nudged) / room.parts
            print(
                f"{name:20} {len(load_arm(name).joints):6} {count:5} {room.at_once / room.parts:8.0%} {cleared:8.0%}"
                f" {nudged:8.0%} {room.nudges:7}" + (f"  ({room.unreachable} never)" if room.unreachable else "")
            )


if __name__ == "__main__":
    main()

"""How soon the arm stands when a hand reaches over the table while it goes down to a part or carries one.

    python -m tests.benchmarks.hand
    python -m tests.benchmarks.hand --seed 7100 --runs 4

Six hands a table come in with 900 mm/s at random moments, three of a pick, three of a place. Counted are those that
come over the work area while the arm is on its way. Printed are, for each, how long and how far the grasp point still
moved, the camera's latency included, and how far the fingertips were from it when it stood; and what became of the
parts. Exit code 1 when the arm went on under a hand for longer than `WITHIN`, or a part ended in a wrong bin.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

import numpy as np

from controller.backends import Level, Mode
from controller.backends.devices import Devices
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.cycle.view import MARGIN_MM
from controller.domain import Array
from controller.errors import Intruder, SorterError
from controller.geometry import invert, transform
from controller.service.session import RunOptions, Session
from sim_backends.person import SPEED, Person

FIRST_SEED = 7100
WISH = "hand@PICK:2, hand@PICK:5, hand@PICK:8, hand@PLACE:1, hand@PLACE:4, hand@PLACE:7"
WAYS = {State.PICK: "down to a part", State.PLACE: "to a bin"}
BEAT = 0.01  # s between two looks at where the grasp point is
STANDS = 5.0  # mm/s of the grasp point, below which it stands
WITHIN = {State.PICK: 0.5, State.PLACE: 1.0}
"""s from when the fingertips are over the work area: latency, a glance's period, and what slowing down takes; where a
part is taken up the arm hides what comes in behind it, until it has gone on."""


@dataclass(frozen=True, slots=True)
class Reach:
    """One hand that came over the work area while the arm was on its way.

    Attributes:
        state: PICK on the way down, PLACE on the way to a bin.
        stood: s until the grasp point stood.
        moved: mm that it moved meanwhile.
        apart: mm between it and the fingertips then.
        held: The cell held for the hand within the time its way allows, else that had come to its end before.
    """

    state: State
    stood: float
    moved: float
    apart: float
    held: bool


@dataclass
class Watch(Observer):
    """Follows the grasp point and the fingertips through a run; give `join` to the session, `show` to the person."""

    config: CellConfig
    tool: list[tuple[float, Array]] = field(default_factory=list)
    tips: list[tuple[float, Array]] = field(default_factory=list)
    states: list[tuple[float, State]] = field(default_factory=list)
    holds: list[float] = field(default_factory=list)

    def join(self, devices: Devices) -> Sequence[Observer]:
        """Look at the cell on a beat."""
        truth, clock = devices.truth, devices.clock
        assert truth is not None
        assert devices.on_step is not None

        def step(dt: float) -> None:
            if not self.tool or clock.now() >= self.tool[-1][0] + BEAT - 1e-9:
                self.tool.append((clock.now(), np.array(truth.tool())))

        devices.on_step(step)
        self._now = clock.now
        return (self,)

    def entered(self, state: State, at: float) -> None:
        """When the cell came to a state."""
        self.states.append((at, state))

    def held(self, cause: SorterError, at: float) -> None:
        """A hand was seen."""
        if isinstance(cause, Intruder):
            self.holds.append(at)

    def showing(self, at: Array) -> None:
        """The fingertips are at (x, y) of `base`, mm."""
        place = transform(invert(self.config.table.T_base_table()), np.array([*at, 0.0]))[:2]
        self.tips.append((self._now(), place))

    def reaches(self) -> list[Reach]:
        """Every hand that came over the work area while the arm was on its way."""
        found, over = [], False
        for at, tip in self.tips:
            before, over = over, self._is_over(tip)
            if over and not before and (reach := self._reach(at)) is not None:
                found.append(reach)
        return found

    def _is_over(self, tip: Array) -> bool:
        x, y = float(tip[0]), float(tip[1])
        return self.config.in_work_area((x, y), self.config.table.T_base_table(), MARGIN_MM)

    def _reach(self, at: float) -> Reach | None:
        """What followed from fingertips that came over the work area; None when the arm was not on its way."""
        state = [state for entered, state in self.states if entered <= at][-1]
        times = np.array([time for time, _ in self.tool])
        points = np.array([point for _, point in self.tool])
        speeds = np.linalg.norm(np.diff(points, axis=0), axis=1) / np.diff(times)
        here = int(np.searchsorted(times, at)) - 1
        if state not in WAYS or speeds[here] <= STANDS:
            return None
        still = here + int(np.argmax(speeds[here:] <= STANDS))
        tip = [place for time, place in self.tips if time <= times[still]][-1]
        apart = float(np.linalg.norm(points[still, :2] - tip))
        held = any(at <= hold <= times[still] + WITHIN[state] for hold in self.holds)
        moved = float(np.linalg.norm(points[still] - points[here]))
        return Reach(state, float(times[still] - at), moved, apart, held)


def main() -> int:
    """Sort the tables and judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=4, help="tables of 10 parts")
    parser.add_argument("--seed", type=int, default=FIRST_SEED)
    asked = parser.parse_args()
    config = load_cell(shipped("sim.toml"))
    reaches: list[Reach] = []
    wrong = 0
    for seed in range(asked.seed, asked.seed + asked.runs):
        watch = Watch(config)
        figures = _sort(config, seed, watch)
        new = watch.reaches()
        reaches += new
        wrong += figures["missorted"] + figures["silent"]
        told = ", ".join(f"{r.stood:.2f} s {r.moved:.0f} mm {r.apart:.0f} mm{'' if r.held else ' (late)'}" for r in new)
        print(f"{seed}: {figures['correct']} of {figures['parts']} right, {len(watch.holds)} holds; {told}", flush=True)
    held = [reach for reach in reaches if reach.held]
    for state, way in WAYS.items():
        on_it = [reach for reach in held if reach.state is state]
        late = sum(reach.state is state for reach in reaches) - len(on_it)
        print(f"hands of {SPEED:g} mm/s over the table on the way {way}: {len(on_it)}, and {late} at its end")
        if on_it:
            stood, apart = [reach.stood for reach in on_it], [reach.apart for reach in on_it]
            print(f"  the arm stood after {np.median(stood):.2f} s in the median, {max(stood):.2f} s at worst;")
            print(f"  the fingertips were then {np.median(apart):.0f} mm away in the median, {min(apart):.0f} at least")
    # At the end of a way the next look holds the cell.
    soon = all(reach.stood <= WITHIN[reach.state] for reach in reaches)
    met = {reach.state for reach in held} == set(WAYS) and soon and not wrong
    bounds = ", ".join(f"{bound:g} s on the way {WAYS[state]}" for state, bound in WITHIN.items())
    print(f"{'met' if met else 'MISSED'}: stands within {bounds}, 0 missorted, 0 silent ({wrong})")
    return 0 if met else 1


def _sort(config: CellConfig, seed: int, watch: Watch) -> dict[str, int]:
    show = Person.show

    def showing(person: Person, at: Array) -> None:
        watch.showing(at)
        show(person, at)

    with tempfile.TemporaryDirectory() as folder, mock.patch.object(Person, "show", showing):
        options = RunOptions(
            Mode.SIM, config, out=Path(folder) / "run", parts=10, seed=seed, level=Level.DYNAMIC, disturb=WISH,
            watch=watch.join,
        )  # fmt: skip
        return dict(Session(options).run())


if __name__ == "__main__":
    sys.exit(main())

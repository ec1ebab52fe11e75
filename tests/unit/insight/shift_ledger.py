"""A ledger of a working day, written by the program's own ledger and chronicle, on a clock that is only counted."""

from __future__ import annotations

import random
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from controller.cycle.machine import State
from controller.domain import Bin, Outcome, Result
from controller.errors import CameraLost, MotionTimeout
from controller.ledger import SqliteLedger
from controller.service.chronicle import Chronicle
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan

BEGIN = datetime(2026, 3, 10, 6, 0, tzinfo=UTC)


class Day:
    """A cell at work; everything it does takes the time it says.

    Args:
        path: The ledger to write.
        config: Hash of the configuration.
        begin: When the program starts.
    """

    def __init__(self, path: Path, config: str = "abc", begin: datetime = BEGIN) -> None:
        self.clock = VirtualClock()
        started = self.clock.now()
        self.ledger = SqliteLedger(
            path, clock=self.clock, wall=lambda: begin + timedelta(seconds=self.clock.now() - started)
        )
        self.ledger.begin_run(software_version="1", config_hash=config, calibration_id="cal-1", mode="real", arm="rx")
        self.chronicle = Chronicle(self.ledger, self.clock)
        self._parts = 0

    def enter(self, *states: State) -> None:
        for state in states:
            self.chronicle.entered(state, self.clock.now())

    def start(self) -> None:
        self.chronicle.commanded("start", 1000)
        self.enter(State.HOMING, State.CAPTURE)

    def part(self, seconds: float, result: Result = Result.PLACED, label: str = "nut", bin_: str = "left") -> None:
        """Look, pick and place one."""
        self._parts += 1
        name = f"t{self._parts}"
        target = plan(name).target
        target = replace(target, detection=replace(target.detection, label=label))
        planned = replace(plan(name), target=target, bin=Bin(bin_, (0.0, 0.0), (9.0, 9.0), 3.0, 9))
        self.ledger.intend(name, planned, 1, self.clock.now())
        self.chronicle.attempted(planned, 1)
        self.clock.sleep(seconds)
        final = outcome(name, result)
        tries = 1 if result is Result.PLACED else 3
        self.ledger.conclude(Outcome(planned.target, planned, result, final.reason, tries, 0.0, self.clock.now()))
        self.enter(State.CAPTURE)

    def wait(self, seconds: float) -> None:
        """Nothing lies on the table."""
        self.enter(State.IDLE)
        self.clock.sleep(seconds)

    def hold(self, seconds: float) -> None:
        """The camera is away."""
        self.chronicle.held(CameraLost("camera", "read", "unplugged", "plug it in"), self.clock.now())
        self.enter(State.HELD)
        self.clock.sleep(seconds)
        self.chronicle.resumed(self.clock.now())

    def pause(self, seconds: float) -> None:
        """An operator's break."""
        self.enter(State.HELD)
        self.clock.sleep(seconds)
        self.enter(State.CAPTURE)

    def fault(self, seconds: float) -> None:
        """The elbow is stuck, until somebody comes."""
        stuck = MotionTimeout("arm", "follow", "the elbow does not move", "clear the way")
        self.chronicle.faulted(stuck, self.clock.now())
        self.enter(State.FAULT)
        self.clock.sleep(seconds)
        self.chronicle.cleared()
        self.chronicle.commanded("reset", 1000)

    def end(self) -> None:
        self.enter(State.STOPPED)
        self.ledger.end_run("stopped")
        self.ledger.close()


def busy_day(path: Path, seed: int = 1, scale: float = 1.0) -> None:
    """Two runs with a break between them, parts of four classes, and everything that can come in between.

    Args:
        path: The ledger to write.
        seed: Of everything that is left to chance.
        scale: Share of a whole day that is worked.
    """
    chance = random.Random(seed)
    ends = (Result.PLACED, Result.REJECTED, Result.GRASP_MISSED, Result.DROPPED)
    kinds = [("hexagon", "hexagons"), ("square", "squares"), ("circle", "circles"), ("triangle", "triangles")]

    def sort(day: Day, hours: float) -> None:
        end = day.clock.now() + 3600.0 * hours * scale
        while day.clock.now() < end:
            for _ in range(chance.randint(5, 30)):
                label, bin_ = chance.choices(kinds, (5, 3, 2, 1))[0]
                result = chance.choices(ends, (95, 2, 2, 1))[0]
                day.part(chance.gauss(4.0, 0.3), result, label, "rest" if result is Result.REJECTED else bin_)
            day.wait(chance.expovariate(1 / 60.0))

    day = Day(path)
    day.clock.sleep(300.0)
    day.start()
    sort(day, 1.2)
    day.hold(190.0)
    sort(day, 1.0)
    day.fault(700.0)
    day.start()
    sort(day, 0.8)
    day.hold(45.0)
    day.pause(1200.0)
    sort(day, 0.4)
    day.end()
    day = Day(path, "abd", BEGIN + timedelta(hours=4.6))
    day.start()
    sort(day, 1.5)
    day.hold(600.0)
    sort(day, 1.6)
    day.end()

"""What is done with the table during a soak, and what is seen of the process."""

from __future__ import annotations

import json
import math
import os
import statistics
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from controller.backends import Devices
from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.domain import Outcome, PickPlan, Result
from controller.errors import Intruder, SorterError
from controller.service.client import ControlClient
from controller.service.faults import fault_code
from sim_backends.person import Person
from tests.benchmarks.soak.operator import ask

WINDOW = 600.0
"""Simulated s from one line to the next."""
STUCK = 900.0
"""Simulated s in which a table of parts is dealt with, faults included; longer, and something is stuck."""
PATIENCE = 30.0
"""Simulated s after which somebody takes away what the cell holds for: parts that lie as one heap, say."""


@dataclass(slots=True)
class Window:
    """What was seen in ten simulated minutes.

    Attributes:
        sim_s: At its end, s since the start.
        rss_mb, files, threads: Of the process, at its end.
        placed: Parts placed.
        cycle_s: Median of the simulated time from plan to outcome of placed parts, s.
        cpu_s: Processor time a placed part, s.
        yardstick_s: Processor time of a fixed piece of work, median: what else the machine has to do makes the
            same work take more of it.
    """

    sim_s: float
    rss_mb: float
    files: int
    threads: int
    placed: int
    cycle_s: float
    cpu_s: float
    yardstick_s: float


@dataclass(slots=True)
class Found:
    """What a soak has shown.

    Attributes:
        windows: Ten minutes each.
        results: Targets by result.
        faults: How often each was noticed.
        supplies: How often the table was laid anew.
        complaints: Everything that was not as it has to be.
    """

    windows: list[Window] = field(default_factory=list)
    results: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    supplies: int = 0
    complaints: list[str] = field(default_factory=list)


class Soak(Observer):
    """Supplies the table, keeps the accounts and watches the process, in the cell's own thread.

    Args:
        seconds: Simulated time to go on for.
        seed: Of where parts are laid.
        found: Is filled in.
    """

    def __init__(self, seconds: float, seed: int, found: Found) -> None:
        self.found = found
        self.over = threading.Event()
        self.devices: Devices | None = None
        self._seconds = seconds
        self._random = np.random.default_rng([seed, 21])
        self._batch: Counter[Result] = Counter()
        self._supplied_at = self._window_at = self._began = 0.0
        self._planned_at = 0.0
        self._cycles: list[float] = []
        self._yardsticks = [_yardstick()]
        self._placed, self._cpu = 0, time.process_time()
        self._latched = False
        self._heap_since = math.inf
        self._latest = deque[str](maxlen=16)
        self._operator: ControlClient | None = None

    def watch(self, devices: Devices) -> tuple[Observer, ...]:
        """The devices are open."""
        self.devices = devices
        self._began = self._supplied_at = self._window_at = devices.clock.now()
        cast(Any, devices.truth).cell.world.on_step(self._clear_a_heap)
        return (self,)

    @property
    def lasted(self) -> float:
        """Simulated s so far."""
        return self._now() - self._began

    def repair(self) -> None:
        """Mend what the script of faults has broken for good."""
        assert self.devices is not None
        assert self.devices.script is not None
        self.devices.script.repair()

    def planned(self, plan: PickPlan) -> None:
        """A cycle begins."""
        self._planned_at = self._now()
        if self._latched:
            self.found.complaints.append("a pick was planned while a fault was latched")

    def concluded(self, outcome: Outcome) -> None:
        """Book it."""
        self._batch[outcome.result] += 1
        self._told(f"{outcome.result}: {outcome.reason}")
        self.found.results[str(outcome.result)] += 1
        if outcome.result is Result.PLACED:
            self._placed += 1
            self._cycles.append(self._now() - self._planned_at)

    def held(self, cause: SorterError, at: float) -> None:
        """Count what the cell held for."""
        self._heap_since = at if isinstance(cause, Intruder) else math.inf
        self.found.faults[fault_code(cause)] += 1
        self._told(f"held: {cause}")

    def resumed(self, at: float) -> None:
        """It goes on."""
        self._heap_since = math.inf

    def warned(self, code: str, cause: str, at: float) -> None:
        """Count what was warned of."""
        self.found.faults[code] += 1

    def faulted(self, error: SorterError, at: float) -> None:
        """Count what latched."""
        self.found.faults[fault_code(error)] += 1
        self._told(f"faulted: {error}")

    def entered(self, state: State, at: float) -> None:
        """Look at the clock; lay the table anew when there is nothing more to do on it."""
        self._latched = state is State.FAULT
        # What cannot be put on record yet is not on the accounts either: the cell holds, and comes here again.
        if state is State.IDLE and not self._record_is_stuck:
            self._supply()
        if at - self._window_at >= WINDOW:
            self._look_at_process(at)
        if at - self._supplied_at > STUCK:
            latest = "; ".join(self._latest)
            self.found.complaints.append(f"stuck in {state.value} at {at - self._began:.0f} s; before: {latest}")
            self._seconds = 0.0
        if at - self._began >= self._seconds and not self.over.is_set():
            self.over.set()

    @property
    def _record_is_stuck(self) -> bool:
        assert self.devices is not None
        assert self.devices.script is not None
        return self.devices.script.ledger_unwritable

    # --- the table ------------------------------------------------------------------------------------

    def _clear_a_heap(self, dt: float) -> None:
        """Take away what the cell waits for, as its alarm says, when it is no hand that leaves by itself."""
        assert self.devices is not None
        if self._now() - self._heap_since > PATIENCE and not cast(Any, self.devices.truth).cell.world.held:
            self._heap_since = math.inf
            self._supply()

    def _supply(self) -> None:
        """Compare what is on record with where the parts are, empty the bins, and lay all parts on the table."""
        assert self.devices is not None
        assert self.devices.truth is not None
        cell = cast(Any, self.devices.truth).cell
        world = cell.world
        bins = {bin_.name for bin_ in cell.spec.bins}
        parts = self.devices.truth.now()
        outside = [part for part in parts if part.place not in bins]
        inside = len(parts) - len(outside)
        sure = self._batch[Result.PLACED] + self._batch[Result.REJECTED]
        unsure = self._batch[Result.DROPPED] + self._batch[Result.INDETERMINATE] + self._batch[Result.ABORTED]
        if not sure <= inside <= sure + unsure:
            self.found.complaints.append(
                f"at {self._now() - self._began:.0f} s {inside} parts lie in the bins, on record are {sure} placed"
                f" and {unsure} of which nobody knows; elsewhere lie {outside}; before: {'; '.join(self._latest)}"
            )
        self._batch.clear()
        self._yardsticks.append(_yardstick())
        self.found.supplies += 1
        person = Person(world, cell.spec.work_area)
        count = len(cell.truth())
        for index in range(count):
            world.loose.take_away(index)
        for index in self._random.permutation(count):
            place = person.room_for(world.parts[index], self._random)
            if place is not None:
                (x, y), yaw = place
                world.loose.lay_at(int(index), float(x), float(y), yaw)
        world.forget(self._now() - 60.0)
        world.collisions.clear()
        self._operator = self._operator or ControlClient(Path(os.environ["STATE_DIRECTORY"]))
        ask(self._operator, "emptied")
        self._supplied_at = self._now()

    # --- the process ----------------------------------------------------------------------------------

    def _look_at_process(self, at: float) -> None:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        cpu = time.process_time()
        window = Window(
            round(at - self._began, 1),
            round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1),
            len(os.listdir("/proc/self/fd")),
            threading.active_count(),
            self._placed,
            round(statistics.median(self._cycles), 3) if self._cycles else 0.0,
            round((cpu - self._cpu) / max(self._placed, 1), 3),
            round(statistics.median(self._yardsticks), 5),
        )
        self.found.windows.append(window)
        print(json.dumps({name: getattr(window, name) for name in Window.__slots__}), flush=True)
        self._window_at, self._cpu, self._placed = at, cpu, 0
        self._cycles.clear()
        del self._yardsticks[:-1]

    def _told(self, what: str) -> None:
        self._latest.append(f"{self._now() - self._began:.0f} s {what}")

    def _now(self) -> float:
        assert self.devices is not None
        return self.devices.clock.now()


def _yardstick() -> float:
    """Processor time of a fixed piece of work, half of it Python's and half numpy's, s."""
    began = time.process_time()
    values, total = np.arange(50_000.0), 0
    for number in range(60_000):
        total += number & 3
    for _ in range(20):
        values = np.sqrt(values + 1.0)
    return time.process_time() - began

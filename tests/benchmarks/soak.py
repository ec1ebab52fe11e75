"""Hours of sorting with faults and disturbances: does anything grow, slow down, get stuck or go missing?

    python -m tests.benchmarks.soak --hours 8

The service itself sorts a simulated table, in simulated time. Whenever the table is empty somebody takes the parts out
of the bins and lays them on the table anew; faults of the catalogue and disturbances strike at random moments; an
operator at the control socket puts right what is wrong, resets, resumes and starts. Prints one line for every ten
simulated minutes and a summary; the exit code is 1 when a part is not accounted for, something moves where nothing
may, the cell gets stuck, or memory, file descriptors or times are not flat.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast
from unittest.mock import patch

import cv2
import numpy as np

from controller.backends import DEVICES, BackendOptions, Devices, Level, Mode
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.domain import ArmDescription, Outcome, PickPlan, Result
from controller.errors import Intruder, SorterError
from controller.ledger.view import LedgerView
from controller.service import session as session_module
from controller.service.client import CommandFailed, ControlClient
from controller.service.faults import fault_code
from controller.service.session import RunOptions, Session
from sim_backends.person import Person
from tests.benchmarks.cell_vision import look_at_cell
from tests.unit.calibration.certified import certify

PASSING = (
    "camera_lost", "camera_stalled", "picture_frozen", "picture_black", "picture_overexposed", "picture_torn",
    "picture_light", "picture_soft", "picture_moved", "picture_covered", "light_drifting", "pictures_damaged",
    "ledger_unwritable", "bus_corrupt", "bus_noisy", "supply_low", "part_lost", "part_held",
)  # fmt: skip
LATCHING = (
    "bus_timeout", "bus_lost", "servo_overload", "servo_shock", "servo_overheat", "servo_undervoltage",
    "servo_encoder", "servo_rebooted", "motion_timeout",
)  # fmt: skip
DISTURBANCES = ("slip", "knock", "remove", "move", "swap", "hand")
WINDOW = 600.0
"""Simulated s from one line to the next."""
STUCK = 900.0
"""Simulated s in which a table of parts is dealt with, faults included; longer, and something is stuck."""
PATIENCE = 30.0
"""Simulated s after which somebody takes away what the cell holds for: parts that lie as one heap, say."""
MOST_GROWTH_MB = 3.0
"""Memory that may be gained a simulated hour: what the allocator does not give back, and the counts of a run."""
MOST_SLOWER = 1.25
"""Times of the last third of the windows against the first: the mix of faults alone makes them differ by a tenth."""


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
        if state is State.IDLE:
            self._supply()
        if at - self._window_at >= WINDOW:
            self._look_at_process(at)
        if at - self._supplied_at > STUCK:
            latest = "; ".join(self._latest)
            self.found.complaints.append(f"stuck in {state.value} at {at - self._began:.0f} s; before: {latest}")
            self._seconds = 0.0
        if at - self._began >= self._seconds and not self.over.is_set():
            self.over.set()

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
        places = Counter(part.place for part in self.devices.truth.now())
        bins = {bin_.name for bin_ in cell.spec.bins}
        inside = sum(number for place, number in places.items() if place in bins)
        sure = self._batch[Result.PLACED] + self._batch[Result.REJECTED]
        unsure = self._batch[Result.DROPPED] + self._batch[Result.INDETERMINATE] + self._batch[Result.ABORTED]
        if not sure <= inside <= sure + unsure:
            self.found.complaints.append(
                f"at {self._now() - self._began:.0f} s {inside} parts lie in the bins, on record are {sure} placed"
                f" and {unsure} of which nobody knows"
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
        _ask(self._operator, "emptied")
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


def _ask(operator: ControlClient, command: str) -> None:
    """Ask again for as long as another command is being worked on."""
    while True:
        try:
            operator.ask(command)
        except CommandFailed as error:
            if error.code not in ("busy", "too_fast"):
                raise
            time.sleep(0.01)
        else:
            return


def operate(soak: Soak, session: Session) -> None:
    """The operator: starts, puts right, resets, resumes, until it is over."""
    operator = ControlClient(Path(os.environ["STATE_DIRECTORY"]))
    try:
        while not soak.over.wait(0.05):
            with suppress(SorterError):
                _operate_once(operator, soak)
    finally:
        session.stop()


def _operate_once(operator: ControlClient, soak: Soak) -> None:
    status = operator.ask("status")
    active = [alarm["code"] for alarm in status["alarms"] if alarm["active"]]
    if status["state"] == "ABORTED":
        assert soak.devices is not None
        assert soak.devices.script is not None
        soak.devices.script.repair()
        operator.ask("reset")
    elif status["state"] == "STOPPED":
        operator.ask("start")
    elif status["state"] == "HELD" and "part_held" in active:
        operator.ask("resume")
    if status["alarms"]:
        operator.ask("acknowledge")


def script(seconds: float, seed: int, faults_an_hour: float) -> str:
    """A script of faults at random moments."""
    random_ = random.Random(seed)
    at, lines = 0.0, list[str]()
    while True:
        at += random_.expovariate(faults_an_hour / 3600.0)
        if at >= seconds:
            break
        name = random_.choice(LATCHING if random_.random() < 0.3 else PASSING)
        lasts = random_.uniform(2.0, 20.0)
        lines.append(f'[[fault]]\nfault = "{name}"\nat_s = {at:.3f}\nduration_s = {lasts:.3f}\n')
    return "\n".join(lines) or '[[fault]]\nfault = "camera_stalled"\nat_s = 5.0\nduration_s = 3.0\n'


def wish(seconds: float, seed: int, disturbances_an_hour: float) -> str:
    """Disturbances at random moments."""
    random_ = random.Random(seed + 1)
    at, words = 0.0, list[str]()
    while True:
        at += random_.expovariate(disturbances_an_hour / 3600.0)
        if at >= seconds:
            return ", ".join(words)
        words.append(f"{random_.choice(DISTURBANCES)}@{at:.2f}")


def run(
    hours: float,
    seed: int,
    parts: int,
    *,
    faults_an_hour: float,
    disturbances_an_hour: float,
    folder: Path,
    calibration: Path | None = None,
) -> Found:
    """Sort for so long; the environment's state folder is the soak's for as long as it lasts.

    The cell is calibrated into the folder, unless its calibration is given.
    """
    seconds = 3600.0 * hours
    if calibration is None:
        look_at_cell(seed, parts, "dynamic", folder)
        calibration = folder / "calibration"
        certify(calibration)
    faults = folder / "faults.toml"
    faults.write_text(script(seconds, seed, faults_an_hour), encoding="utf-8")
    found = Found()
    soak = Soak(seconds, seed, found)

    def devices(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
        options = BackendOptions(
            folder,
            parts=parts,
            seed=seed,
            level=Level.DYNAMIC,
            faults=faults,
            disturb=wish(seconds, seed, disturbances_an_hour),
            watch_clock=options.watch_clock,
        )
        made = DEVICES[Mode.SIM](config, arm, options)
        made.presenter = None
        return made

    config = load_cell(shipped("sim.toml"))
    session = Session(RunOptions(Mode.REAL, config, calibration=calibration, watch=soak.watch))
    operator = threading.Thread(target=operate, args=(soak, session), name="operator")
    state = {"STATE_DIRECTORY": str(folder / "state")}
    with patch.object(session_module, "DEVICES", {Mode.REAL: devices}), patch.dict(os.environ, state):
        operator.start()
        try:
            session.run()
        except SorterError as error:
            # A fault may have latched just as it was stopped.
            if not soak.over.is_set():
                found.complaints.append(f"the service has ended: {error}")
        finally:
            if not soak.over.is_set():
                found.complaints.append(f"it ended before its time, at {soak.lasted:.0f} s")
            soak.over.set()
            operator.join()
    _judge(found, folder / "state" / "ledger.db")
    return found


def _judge(found: Found, path: Path) -> None:
    say = found.complaints.append
    with LedgerView(path) as ledger:
        for problem in ledger.verify():
            say(f"ledger: {problem}")
        counts = {name: number for name, number in ledger.counts().items() if number and name != "targets"}
    if counts != {name: number for name, number in found.results.items() if number}:
        say(f"on record are {counts}, seen were {dict(found.results)}")
    later = found.windows[1:]
    third = len(later) // 3
    if third == 0:
        return
    first, last = later[:third], later[-third:]
    apart = (last[-1].sim_s - first[0].sim_s) / 3600.0
    growth = statistics.median(w.rss_mb for w in last) - statistics.median(w.rss_mb for w in first)
    if growth > MOST_GROWTH_MB * max(apart, 1.0):
        say(f"memory has grown by {growth:.1f} MB in {apart:.1f} h")
    if max(w.files for w in last) > max(w.files for w in first) + 2:
        say("file descriptors have grown")
    if max(w.threads for w in last) > max(w.threads for w in first):
        say("threads have grown")
    times: dict[str, Callable[[Window], float]] = {
        "cycle_s": lambda window: window.cycle_s,
        "cpu_s in yardsticks": lambda window: window.cpu_s / window.yardstick_s,
    }
    for name, of in times.items():
        before, after = (statistics.median(map(of, part)) for part in (first, last))
        if after > MOST_SLOWER * before:
            say(f"{name} has grown from {before:.3f} to {after:.3f}")


def main() -> int:
    """Run the soak."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--parts", type=int, default=8)
    parser.add_argument("--faults-per-hour", type=float, default=60.0)
    parser.add_argument("--disturbances-per-hour", type=float, default=60.0)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        found = run(
            arguments.hours,
            arguments.seed,
            arguments.parts,
            faults_an_hour=arguments.faults_per_hour,
            disturbances_an_hour=arguments.disturbances_per_hour,
            folder=Path(name),
        )
    figures = {
        "hours": arguments.hours,
        "supplies": found.supplies,
        "results": dict(found.results),
        "faults": dict(found.faults),
        "complaints": found.complaints,
        "cpu_s": round(time.process_time(), 1),
        "wall_s": round(time.perf_counter() - began, 1),
    }
    print(json.dumps(figures))
    return 1 if found.complaints else 0


if __name__ == "__main__":
    sys.exit(main())

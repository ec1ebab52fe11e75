"""Kill -9 at random moments of a sorting service: every acknowledged record is there, once; what the next start says.

    python -m tests.benchmarks.kills --count 500 --jobs 2

Every kill hits a process of its own that sorts a simulated table as the service would, after a random amount of its
processor time. It says on a pipe what the ledger has acknowledged, before it goes on. Then the service is started
again in the same state folder and asked over its socket: it must be STOPPED, and must say that the gripper may hold a
part whenever it did at the moment of the kill. Processes are forked from one that has opened the simulated devices, so
that a kill costs about a second of one processor. Ctrl-C ends the study and prints what was found until then. The
exit code is 1 when anything was not as it has to be.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2

from controller.backends import Devices, Mode
from controller.cycle.rig import Observer
from controller.domain import Outcome, PickPlan
from controller.ledger.view import LedgerView
from controller.service import session as session_module
from controller.service.client import ControlClient, NotRunning
from controller.service.session import RunOptions, Session
from tests.benchmarks.open_cell import FORK, OpenCell, apart

SORTED_IN = 1.1
"""s of processor time in which the table is sorted; kills are spread evenly over it."""
_PATIENCE = 60.0  # s for anything that is waited for


@dataclass(frozen=True, slots=True)
class Verdict:
    """What one kill left behind.

    Attributes:
        acknowledged: Records that the process knew to be safe when it died.
        open: Cycles that the next start found open, and settled.
        held: The jaws held a part when the process died.
        said: What the next start said of the jaws.
        complaints: Everything that was not as it has to be.
    """

    acknowledged: int
    open: int
    held: bool
    said: bool
    complaints: tuple[str, ...]


@dataclass(slots=True)
class Prepared:
    """What processes that sort are forked from.

    Attributes:
        cell: Calibrated, its devices open.
        holding: Whether both jaws touch a part, in memory that the processes share.
    """

    cell: OpenCell
    holding: mmap.mmap = field(default_factory=lambda: mmap.mmap(-1, 1))

    def __post_init__(self) -> None:
        """Feel what the jaws hold."""
        assert self.cell.devices.on_step is not None
        world = self.cell.world

        def feel(dt: float) -> None:
            self.holding[0] = bool(world.held)

        self.cell.devices.on_step(feel)


class _Told(Observer):
    """Tells the parent what the ledger has acknowledged: the cycle tells its observers only afterwards."""

    def __init__(self, line: Connection) -> None:
        self._line = line

    def watch(self, devices: Devices) -> tuple[Observer, ...]:
        """The devices are ready: the work begins."""
        self._line.send(("ready", "", 0))
        return (self,)

    def attempted(self, plan: PickPlan, attempt: int) -> None:
        """An intent is on record."""
        self._line.send(("intent", "", attempt))

    def concluded(self, outcome: Outcome) -> None:
        """An outcome is on record."""
        self._line.send((str(outcome.result), outcome.target.target_id, outcome.attempts))


def _serve(prepared: Prepared, state: Path, line: Connection | None) -> None:
    """A service in a process of its own; it sorts at once when somebody listens, else waits STOPPED."""
    os.environ["STATE_DIRECTORY"] = str(state)
    os.environ.pop("RUNTIME_DIRECTORY", None)

    patch.object(session_module, "DEVICES", {Mode.REAL: prepared.cell.factory}).start()
    watch: Callable[[Devices], tuple[Observer, ...]] = _Told(line).watch if line is not None else lambda devices: ()
    options = RunOptions(
        Mode.REAL,
        prepared.cell.config,
        calibration=prepared.cell.calibration,
        start=line is not None,
        watch=watch,
    )
    session = Session(options)
    signal.signal(signal.SIGTERM, lambda number, frame: session.stop())
    session.run()


def kill_one(prepared: Prepared, after: float, state: Path) -> Verdict:
    """Let a service sort, kill it `after` s of processor time, start the next one in its state folder and ask it.

    To be called `apart`.
    """
    said: list[tuple[str, str, int]] = []
    prepared.holding = mmap.mmap(-1, 1)
    ours, theirs = FORK.Pipe(duplex=False)
    process = FORK.Process(target=_serve, args=(prepared, state, theirs))
    process.start()
    theirs.close()
    assert process.pid is not None
    # Source: Linux, the clock of a process's processor time, MAKE_PROCESS_CPUCLOCK(pid, CPUCLOCK_SCHED).
    clock = (~process.pid << 3) | 2
    deadline = None
    with suppress(EOFError):
        while deadline is None or time.clock_gettime(clock) < deadline:
            if ours.poll(0.002):
                said.append(ours.recv())
                deadline = deadline or time.clock_gettime(clock) + after
    process.kill()
    process.join()
    with suppress(EOFError):
        while ours.poll(0.0):
            said.append(ours.recv())
    ours.close()
    held = bool(prepared.holding[0])
    return _judge(said, held, _next_start(prepared, state), state)


def _next_start(prepared: Prepared, state: Path) -> Mapping[str, Any]:
    """The status of the service that comes up next, which is then ended."""
    process = FORK.Process(target=_serve, args=(prepared, state, None))
    process.start()
    operator, until = ControlClient(state), time.monotonic() + _PATIENCE
    status: Mapping[str, Any] = {}
    while time.monotonic() < until and status.get("state") not in ("STOPPED", "ABORTED"):
        with suppress(NotRunning):
            status = operator.ask("status")
        time.sleep(0.01)
    process.terminate()
    process.join(_PATIENCE)
    process.kill()
    return status


def _judge(said: list[tuple[str, str, int]], held: bool, status: Mapping[str, Any], state: Path) -> Verdict:
    complaints: list[str] = []
    intents = sum(what == "intent" for what, _, _ in said)
    outcomes = {target: what for what, target, _ in said if what not in ("ready", "intent")}
    with LedgerView(state / "ledger.db") as ledger:
        complaints += ledger.verify()
        found = {(row["target_id"], row["attempt"]) for row in ledger.rows("intents")}
        ends = Counter(row["target_id"] for row in ledger.rows("outcomes"))
        results = {row["target_id"]: row["result"] for row in ledger.rows("outcomes")}
        runs = [row["end_reason"] for row in ledger.rows("runs")]
    settled = [target for target, result in results.items() if result == "indeterminate" and target not in outcomes]
    # The process may die between a commit and telling of it: one record more than told, never two or fewer.
    if len(found) - intents not in (0, 1):
        complaints.append(f"{intents} intents were acknowledged, {len(found)} are on record")
    for target, result in outcomes.items():
        if results.get(target) != result:
            complaints.append(f"{target} was {result}, on record is {results.get(target)}")
    if any(number != 1 for number in ends.values()) or set(ends) != {target for target, _ in found}:
        complaints.append("not exactly one outcome for every target")
    if len(settled) > 1:
        complaints.append(f"more than one cycle was open: {settled}")
    if runs != ["unclean", "stopped"]:
        complaints.append(f"the runs ended {runs}")
    if status.get("state") != "STOPPED":
        complaints.append(f"the next start is {status.get('state')}")
    if held and not status.get("may_hold_part"):
        complaints.append("a part is in the jaws, and the next start does not know")
    if bool(settled) != bool(status.get("may_hold_part")):
        complaints.append(f"open were {settled}, and the next start says {status.get('may_hold_part')} of the jaws")
    return Verdict(len(said) - 1, len(settled), held, bool(status.get("may_hold_part")), tuple(complaints))


def run(count: int, seed: int, root: Path, *, jobs: int = 1, calibration: Path | None = None) -> Iterator[Verdict]:
    """So many kills at random moments, `jobs` at a time; see `OpenCell.make` for the calibration."""
    prepared = Prepared(OpenCell.make(root, calibration))
    random_ = random.Random(seed)
    moments = [random_.uniform(0.0, SORTED_IN) for _ in range(count)]
    work = [partial(kill_one, prepared, after, root / f"kill{number}") for number, after in enumerate(moments)]
    try:
        for number, verdict in apart(work, jobs):
            yield verdict or Verdict(0, 0, False, False, (f"kill {number}: the process that looks has died",))
    finally:
        prepared.cell.devices.close()


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="kills at a time")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    began = time.perf_counter()
    verdicts: list[Verdict] = []
    with tempfile.TemporaryDirectory() as name, suppress(KeyboardInterrupt):
        for verdict in run(arguments.count, arguments.seed, Path(name), jobs=arguments.jobs):
            verdicts.append(verdict)
            if len(verdicts) % 50 == 0:
                print(json.dumps(_figures(verdicts, began)), flush=True)
    figures = _figures(verdicts, began)
    print(json.dumps(figures))
    return 1 if figures["complaints"] else 0


def _figures(verdicts: Sequence[Verdict], began: float) -> dict[str, Any]:
    complaints = [complaint for verdict in verdicts for complaint in verdict.complaints]
    spent = os.times()
    return {
        "kills": len(verdicts),
        "acknowledged": sum(verdict.acknowledged for verdict in verdicts),
        "open_settled": sum(verdict.open for verdict in verdicts),
        "part_in_the_jaws": sum(verdict.held for verdict in verdicts),
        "complaints": complaints,
        "wall_s": round(time.perf_counter() - began, 1),
        "cpu_s": round(sum(spent[:4]), 1),
    }


if __name__ == "__main__":
    sys.exit(main())

"""Kill -9 at random moments of a simulated sorting process: is every acknowledged record there, once, afterwards?

    python tests/benchmarks/kills.py --count 500

Every kill hits one process that sorts a simulated table, in a folder of its own; it says on a pipe what the ledger
has acknowledged, before it goes on. Afterwards the ledger is opened as the next start does. The exit code is 1 when a
record was lost, doubled or made up, or an open cycle was not settled.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter

from controller.backends import Devices, Level, Mode
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.cycle.rig import Observer
from controller.domain import Outcome, PickPlan
from controller.ledger.sqlite import SqliteLedger
from controller.service.session import RunOptions, Session
from sim_backends.virtual_clock import VirtualClock
from tests.benchmarks.cell_vision import look_at_cell

SEED, PARTS = 7, 8
# A run of so many parts takes longer than this on any machine; kills are spread over it, s after the work begins.
SPREAD = 5.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """What one kill left behind.

    Attributes:
        acknowledged: Records that the process knew to be safe when it died.
        open: Cycles that the next start found open, and settled.
        complaints: Everything that was not as it has to be.
    """

    acknowledged: int
    open: int
    complaints: tuple[str, ...]


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


def _sort(line: Connection, calibration: Path, out: Path) -> None:
    told = _Told(line)
    options = RunOptions(
        Mode.SIM,
        load_cell(shipped("sim.toml")),
        out=out,
        calibration=calibration,
        parts=PARTS,
        seed=SEED,
        level=Level.STATIC,
        watch=told.watch,
    )
    Session(options).run()


def kill_one(after: float, calibration: Path, out: Path) -> Verdict:
    """Let a process sort, kill it `after` s of work, and open its ledger as the next start does."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_sort, args=(theirs, calibration, out))
    process.start()
    theirs.close()
    said: list[tuple[str, str, int]] = []
    deadline: float | None = None
    try:
        while deadline is None or perf_counter() < deadline:
            if ours.poll(60.0 if deadline is None else max(deadline - perf_counter(), 0.0)):
                said.append(ours.recv())
                deadline = deadline or perf_counter() + after
    except EOFError:
        pass  # it has sorted everything before its time
    assert process.pid is not None
    process.kill()
    process.join()
    try:
        while ours.poll(0.0):
            said.append(ours.recv())
    except EOFError:
        pass
    return _judge(said, out / "ledger.db")


def _judge(said: list[tuple[str, str, int]], path: Path) -> Verdict:
    complaints: list[str] = []
    intents = sum(what == "intent" for what, _, _ in said)
    outcomes = {target: what for what, target, _ in said if what not in ("ready", "intent")}
    with SqliteLedger(path, clock=VirtualClock()) as ledger:
        settled = ledger.indeterminate
        complaints += ledger.verify()
        found = {(row["target_id"], row["attempt"]) for row in ledger.rows("intents")}
        ends = Counter(row["target_id"] for row in ledger.rows("outcomes"))
        results = {row["target_id"]: row["result"] for row in ledger.rows("outcomes")}
    # The process may die between a commit and telling of it: one record more than told, never two or fewer.
    if len(found) - intents not in (0, 1):
        complaints.append(f"{intents} intents were acknowledged, {len(found)} are on record")
    for target, result in outcomes.items():
        if results.get(target) != result:
            complaints.append(f"{target} was {result}, on record is {results.get(target)}")
    if any(number != 1 for number in ends.values()) or set(ends) != {target for target, _ in found}:
        complaints.append("not exactly one outcome for every target")
    if wrong := [open_.target_id for open_ in settled if results[open_.target_id] != "indeterminate"]:
        complaints.append(f"open cycles not settled as indeterminate: {wrong}")
    with SqliteLedger(path, clock=VirtualClock()) as ledger:
        if ledger.indeterminate:
            complaints.append("settled twice")
    return Verdict(len(said) - 1, len(settled), tuple(complaints))


def run(count: int, seed: int, calibration: Path, root: Path) -> list[Verdict]:
    """So many kills at random moments."""
    random_ = random.Random(seed)
    return [kill_one(random_.uniform(0.0, SPREAD), calibration, root / f"kill{number}") for number in range(count)]


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    began = perf_counter()
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        os.environ["XDG_STATE_HOME"] = str(root / "state")
        look_at_cell(SEED, PARTS, "static", root)
        verdicts = run(arguments.count, arguments.seed, root / "calibration", root)
    complaints = [complaint for verdict in verdicts for complaint in verdict.complaints]
    figures = {
        "kills": len(verdicts),
        "acknowledged": sum(verdict.acknowledged for verdict in verdicts),
        "open_settled": sum(verdict.open for verdict in verdicts),
        "complaints": complaints,
        "wall_s": round(perf_counter() - began, 1),
    }
    print(json.dumps(figures))
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())

"""The ledger's write-ahead log cut off, or damaged, at random bytes: does it open at an exact committed prefix?

    python -m tests.benchmarks.ledger_cuts --cuts 600

A ledger is caught in the middle of a run, its size noted after every acknowledged record. Every copy of it loses the
end of its log at some byte (every second copy has that byte flipped instead), is opened as the next start does, and
must hold exactly what had been acknowledged by then: no record less, none more, what was open settled as INDETERMINATE.
The exit code is 1 when one does not.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from controller.domain import Result
from controller.ledger import SqliteLedger
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan

TARGETS = 40


@dataclass(frozen=True)
class Recorded:
    """A ledger caught in the middle of a run.

    Attributes:
        folder: Holds the database and its log.
        steps: (size of the log, records) after every acknowledged call; a record is (kind, target).
    """

    folder: Path
    steps: list[tuple[int, list[tuple[str, str]]]]

    def at(self, cut: int) -> list[tuple[str, str]]:
        """What was acknowledged by the time the log had this many bytes."""
        return [step for step in self.steps if step[0] <= cut][-1][1]


def record(folder: Path) -> Recorded:
    """Write a ledger in `folder / "live"`, and keep a copy of it as a killed process would leave it."""
    ledger = SqliteLedger(folder / "live" / "ledger.db", clock=VirtualClock())
    # An empty log at the start, so that its size counts every record.
    ledger._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    records: list[tuple[str, str]] = []
    steps = [(0, list(records))]

    def step(*new: tuple[str, str]) -> None:
        records.extend(new)
        steps.append(((folder / "live" / "ledger.db-wal").stat().st_size, list(records)))

    ledger.begin_run(software_version="1.0", config_hash="abc")
    step()
    for number in range(TARGETS):
        name = f"t{number}"
        ledger.intend(name, plan(name), 1, float(number))
        step(("intent", name))
        if number % 5 != 4:
            ledger.conclude(outcome(name))
            step(("outcome", name))
    shutil.copytree(folder / "live", folder / "caught")
    ledger.close()
    return Recorded(folder / "caught", steps)


def places(recorded: Recorded, number: int, seed: int) -> list[int]:
    """Random bytes of the log, a quarter of them at the very ends of records."""
    size = recorded.steps[-1][0]
    chance = random.Random(seed)
    ends = [chance.choice(recorded.steps)[0] + chance.choice((-1, 0, 1)) for _ in range(number // 4)]
    anywhere = [chance.randrange(size) for _ in range(number - len(ends))]
    return [min(max(cut, 0), size - 1) for cut in ends + anywhere]


def complaints(recorded: Recorded, folder: Path, cut: int, flip: bool) -> list[str]:
    """Open a copy whose log ends (or is damaged) at a byte; what is not as it was acknowledged by then."""
    shutil.copytree(recorded.folder, folder)
    log = folder / "ledger.db-wal"
    data = bytearray(log.read_bytes())
    if flip:
        data[cut] ^= 0x10
    else:
        del data[cut:]
    log.write_bytes(bytes(data))
    (folder / "ledger.db-shm").unlink(missing_ok=True)
    wanted = recorded.at(cut)
    intents = [name for kind, name in wanted if kind == "intent"]
    outcomes = [name for kind, name in wanted if kind == "outcome"]
    left_open = [name for name in intents if name not in outcomes]
    with SqliteLedger(folder / "ledger.db", clock=VirtualClock()) as ledger:
        rows = list(ledger.rows("outcomes"))
        found = {
            "set aside": (ledger.set_aside, None),
            "intents": ([row["target_id"] for row in ledger.rows("intents")], intents),
            "placed": ([row["target_id"] for row in rows if row["result"] == Result.PLACED], outcomes),
            "open": ([one.target_id for one in ledger.indeterminate], left_open),
            "settled": ([row["target_id"] for row in rows if row["result"] == Result.INDETERMINATE], left_open),
            "problems": (ledger.verify(), ()),
        }
    shutil.rmtree(folder)
    where = f"{'flipped' if flip else 'cut'} at byte {cut}"
    return [f"{where}: {name}: {is_}, not {should}" for name, (is_, should) in found.items() if is_ != should]


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cuts", type=int, default=600)
    parser.add_argument("--seed", type=int, default=2)
    arguments = parser.parse_args()
    found: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        recorded = record(Path(name))
        for number, cut in enumerate(places(recorded, arguments.cuts, arguments.seed)):
            found += complaints(recorded, Path(name) / str(number), cut, flip=number % 2 == 1)
    figures = {
        "cuts": arguments.cuts,
        "seed": arguments.seed,
        "log_bytes": recorded.steps[-1][0],
        "records": len(recorded.steps[-1][1]),
        "complaints": found,
    }
    print(json.dumps(figures))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

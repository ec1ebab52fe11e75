"""What the ledger survives: a killed process, a log cut anywhere, a disk that takes no more."""

from __future__ import annotations

import random
import shutil
import signal
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest

from controller.domain import Result
from controller.ledger import SqliteLedger
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan

ROOT = Path(__file__).resolve().parents[3]


def opened(path: Path) -> SqliteLedger:
    return SqliteLedger(path, clock=VirtualClock())


# --- the log cut anywhere -----------------------------------------------------------------------------------


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


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("recorded")
    ledger = opened(folder / "ledger.db")
    # An empty log at the start, so that its size counts every record.
    ledger._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    records: list[tuple[str, str]] = []
    steps = [(0, list(records))]

    def step(*new: tuple[str, str]) -> None:
        records.extend(new)
        steps.append(((folder / "ledger.db-wal").stat().st_size, list(records)))

    ledger.begin_run(software_version="1.0", config_hash="abc")
    step()
    for number in range(40):
        name = f"t{number}"
        ledger.intend(name, plan(name), 1, float(number))
        step(("intent", name))
        if number % 5 != 4:
            ledger.conclude(outcome(name))
            step(("outcome", name))
    shutil.copytree(folder, folder.with_name("cut"))
    ledger.close()
    return Recorded(folder.with_name("cut"), steps)


def check_prefix(recorded: Recorded, folder: Path, cut: int, flip: bool) -> None:
    """Open a copy whose log ends (or is damaged) at a byte: what is there must be what was acknowledged by then."""
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
    with opened(folder / "ledger.db") as ledger:
        assert ledger.set_aside is None
        assert [row["target_id"] for row in ledger.rows("intents")] == intents
        rows = list(ledger.rows("outcomes"))
        assert [row["target_id"] for row in rows if row["result"] == Result.PLACED] == outcomes
        left_open = [name for name in intents if name not in outcomes]
        assert [open_.target_id for open_ in ledger.indeterminate] == left_open
        assert [row["target_id"] for row in rows if row["result"] == Result.INDETERMINATE] == left_open
        assert ledger.verify() == ()
    shutil.rmtree(folder)


def cuts(recorded: Recorded, number: int, seed: int) -> list[int]:
    """Random places in the log, and some at the very ends of records."""
    size = recorded.steps[-1][0]
    chance = random.Random(seed)
    ends = [chance.choice(recorded.steps)[0] + chance.choice((-1, 0, 1)) for _ in range(number // 4)]
    anywhere = [chance.randrange(size) for _ in range(number - len(ends))]
    return [min(max(cut, 0), size - 1) for cut in ends + anywhere]


@pytest.mark.parametrize("flip", [False, True], ids=["cut", "damaged"])
def test_a_damaged_log_leaves_an_exact_prefix(recorded: Recorded, tmp_path: Path, flip: bool) -> None:
    for number, cut in enumerate(cuts(recorded, 12, seed=1)):
        check_prefix(recorded, tmp_path / str(number), cut, flip)


@pytest.mark.study
@pytest.mark.timeout(600)
def test_six_hundred_cuts_leave_exact_prefixes(recorded: Recorded, tmp_path: Path) -> None:
    for number, cut in enumerate(cuts(recorded, 600, seed=2)):
        check_prefix(recorded, tmp_path / str(number), cut, flip=number % 2 == 1)


# --- the process killed ---------------------------------------------------------------------------------------


def start_writer(path: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.unit.ledger.writer", str(path), *options]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def kill_after(path: Path, acknowledged: int) -> list[str]:
    """Let a writer acknowledge some records, kill it where it stands, and return all it had acknowledged."""
    with start_writer(path) as writer:
        assert writer.stdout is not None
        lines = [writer.stdout.readline() for _ in range(acknowledged)]
        writer.kill()
        lines += writer.stdout.readlines()
    # The last line may be cut off in the pipe; it was acknowledged only when it is whole.
    return [line.strip() for line in lines if line.endswith("\n")]


def check_kills(path: Path, kills: int, seed: int) -> None:
    chance = random.Random(seed)
    acknowledged: list[str] = []
    settled = 0
    for _ in range(kills):
        acknowledged += kill_after(path, chance.randint(1, 60))
        with opened(path) as ledger:
            assert ledger.set_aside is None
            assert ledger.unclean_runs == 1
            settled += len(ledger.indeterminate)
            assert len(ledger.indeterminate) <= 1  # the writer has one target at a time
    with opened(path) as ledger:
        intents = Counter(row["target_id"] for row in ledger.rows("intents") if row["attempt"] == 1)
        outcomes = Counter(row["target_id"] for row in ledger.rows("outcomes"))
        for line in acknowledged:
            kind, name = line.split()
            assert (intents if kind == "intent" else outcomes)[name] == 1, f"{line} is not on record once"
        assert set(outcomes.values()) == {1}
        assert outcomes.keys() == intents.keys()
        assert ledger.counts()["indeterminate"] == settled
        assert ledger.verify() == ()


def test_a_killed_process_loses_nothing_acknowledged(tmp_path: Path) -> None:
    check_kills(tmp_path / "ledger.db", kills=3, seed=3)


@pytest.mark.study
@pytest.mark.timeout(600)
def test_two_hundred_kills_lose_nothing_acknowledged(tmp_path: Path) -> None:
    check_kills(tmp_path / "ledger.db", kills=200, seed=4)


# --- the disk that takes no more --------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="the system has no limit of file sizes")
def test_a_disk_that_takes_no_more_is_said_and_nothing_acknowledged_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "ledger.db"
    with start_writer(path, "200000") as writer:
        assert writer.stdout is not None
        *acknowledged, last = [line.strip() for line in writer.stdout]
    assert last.startswith(f"failed: {path}: record the ")
    assert last.endswith(("free some space on that disk", "check the disk: full, failing or removed"))
    with opened(path) as ledger:
        outcomes = [f"outcome {row['target_id']}" for row in ledger.rows("outcomes") if row["result"] == "placed"]
        assert outcomes == [line for line in acknowledged if line.startswith("outcome")]
        assert ledger.verify() == ()

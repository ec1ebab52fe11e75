"""What the ledger survives: a killed process, a log cut anywhere, a disk that takes no more."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from controller.ledger import SqliteLedger
from sim_backends.virtual_clock import VirtualClock
from tests.benchmarks.ledger_cuts import Recorded, complaints, places, record

ROOT = Path(__file__).resolve().parents[3]


def opened(path: Path) -> SqliteLedger:
    return SqliteLedger(path, clock=VirtualClock())


# --- the log cut anywhere -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(tmp_path_factory.mktemp("recorded"))


@pytest.mark.parametrize("flip", [False, True], ids=["cut", "damaged"])
@pytest.mark.safety("SR-41")
def test_a_damaged_log_leaves_an_exact_prefix(recorded: Recorded, tmp_path: Path, flip: bool) -> None:
    for number, cut in enumerate(places(recorded, 12, seed=1)):
        assert complaints(recorded, tmp_path / str(number), cut, flip) == []


def test_a_lost_record_would_be_noticed(recorded: Recorded, tmp_path: Path) -> None:
    """The last record that the steps speak of is taken from the log, while its size is still claimed."""
    (before, _), (size, records) = recorded.steps[-2:]
    claimed = Recorded(recorded.folder, [(before - 1, records)])
    assert size > before
    assert complaints(claimed, tmp_path / "cut", before, flip=False) != []


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


@pytest.mark.safety("SR-40")
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

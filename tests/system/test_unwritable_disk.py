"""A disk that really takes no more, and one that has become read-only, under a cell at work: it holds."""

from __future__ import annotations

import contextlib
import resource
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from controller.backends import Devices, Level, Mode
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.cycle.rig import Observer
from controller.domain import Outcome, PickPlan
from controller.errors import SorterError
from controller.ledger.sqlite import SqliteLedger
from controller.ledger.view import LedgerView
from controller.ports import Clock
from controller.service import session as session_module
from controller.service.session import RunOptions, Session

PARTS, SEED = 2, 7


class Disk(Observer):
    """Is broken from the first attempt on, until the cell has held for it.

    Args:
        ledger: The record's file.
        kind: `full`: no file may grow any more; `read-only`: what SQLite says to every write then.
    """

    def __init__(self, ledger: Path, kind: str) -> None:
        self.told: list[str] = []
        self._kind = kind
        self._ledger: SqliteLedger
        self._log = ledger.with_name(ledger.name + "-wal")
        self._limit = resource.getrlimit(resource.RLIMIT_FSIZE)

    def opened(self, path: Path, *, clock: Clock) -> SqliteLedger:
        self._ledger = SqliteLedger(path, clock=clock)
        return self._ledger

    def watch(self, devices: Devices) -> tuple[Observer, ...]:
        return (self,)

    def attempted(self, plan: PickPlan, attempt: int) -> None:
        self.told.append("attempted")
        if len(self.told) > 1:
            return
        if self._kind == "full":
            # Python ignores the signal that comes with it.
            resource.setrlimit(resource.RLIMIT_FSIZE, (self._log.stat().st_size, self._limit[1]))
            return
        self._ledger._connection.execute("PRAGMA query_only = ON")

    def concluded(self, outcome: Outcome) -> None:
        self.told.append(str(outcome.result))

    def held(self, cause: SorterError, at: float) -> None:
        self.told.append("held")
        self.mend()

    def resumed(self, at: float) -> None:
        self.told.append("resumed")

    def mend(self) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, self._limit)
        with contextlib.suppress(sqlite3.ProgrammingError):  # closed by then
            self._ledger._connection.execute("PRAGMA query_only = OFF")


@pytest.mark.parametrize("kind", ["full", "read-only"])
def test_the_cell_holds_and_no_placement_goes_unrecorded(
    kind: str, calibration: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = tmp_path / "run" / "ledger.db"
    disk = Disk(ledger, kind)
    monkeypatch.setattr(session_module, "SqliteLedger", disk.opened)
    options = RunOptions(
        Mode.SIM,
        load_cell(shipped("sim.toml")),
        out=ledger.parent,
        calibration=calibration,
        parts=PARTS,
        seed=SEED,
        level=Level.STATIC,
        watch=disk.watch,
    )
    try:
        figures = Session(options).run()
    finally:
        disk.mend()
    # The part under way is put down, but counts only when it is on record; nothing new is begun before that.
    assert disk.told == ["attempted", "held", "placed", "resumed", "attempted", "placed"]
    assert [fault["code"] for fault in figures["faults"]] == ["ledger_unwritable"]
    assert figures["correct"] == PARTS
    with LedgerView(ledger) as record:
        assert record.verify() == ()
        assert record.counts()["placed"] == PARTS


def test_on_a_read_only_file_system_nothing_begins(environment: dict[str, str], tmp_path: Path) -> None:
    script = (
        f"mount -t tmpfs none {tmp_path} && mount -o remount,ro {tmp_path} || exit 99;"
        f" exec {sys.executable} -m controller.cli run --sim --level static --parts 1 --out {tmp_path}/run"
    )
    if shutil.which("unshare") is None:
        pytest.skip("needs unshare")
    command = ["unshare", "--map-root-user", "--mount", "sh", "-c", script]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100.0, check=False)
    if done.returncode == 99 or "unshare" in done.stderr:
        pytest.skip("this machine lets nobody mount anything")
    assert done.returncode == 1
    assert "Read-only file system" in done.stderr
    assert "Traceback" not in done.stderr

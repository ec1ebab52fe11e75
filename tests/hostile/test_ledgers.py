"""Ledger files with anything in them: read, verified, exported, reported on and opened for writing without a crash."""

from __future__ import annotations

import sqlite3
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.domain import Result
from controller.errors import LedgerError
from controller.insight.shift import figures
from controller.insight.shift_page import page
from controller.ledger import LedgerView, SqliteLedger
from controller.ledger.selection import TABLES
from sim_backends.virtual_clock import VirtualClock
from tests.hostile.mutations import HOSTILE, spoiled
from tests.unit.ledger.nouns import outcome, plan

NOW = datetime(2026, 3, 10, 12, tzinfo=UTC)


class Files:
    """The bytes of a database and of its log; no dataclass, whose repr would be all of them."""

    def __init__(self, database: bytes, log: bytes) -> None:
        self.database, self.log = database, log


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """A database and its log, as a killed process leaves them."""
    path = tmp_path_factory.mktemp("original") / "ledger.db"
    with SqliteLedger(path, clock=VirtualClock(), wall=lambda: NOW) as ledger:
        ledger.begin_run(software_version="1", config_hash="abc", mode="real")
        ledger.conclude(outcome("t0"))
        ledger._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        for number in range(1, 4):
            ledger.intend(f"t{number}", plan(f"t{number}"), 1, 4.0)
            ledger.conclude(outcome(f"t{number}", Result.DROPPED))
            ledger.note("state", 5.0, doing="held", code="camera_lost", cause="x", remedy="y")
        return Files(path.read_bytes(), path.with_name("ledger.db-wal").read_bytes())


def look_at_everything(path: Path) -> None:
    """What the command line does with a ledger that it only reads."""
    try:
        with LedgerView(path) as view:
            view.verify()
            for table in TABLES:
                list(view.export("jsonl", table))
                list(view.export("csv", table))
            view.counts()
            page(figures(view, {}, NOW))
    except LedgerError:
        pass


@pytest.mark.safety("SR-43")
@HOSTILE
@given(data=st.data())
def test_no_bytes_crash_the_readers(data: st.DataObject, original: Files, tmp_path: Path) -> None:
    path = tmp_path / "ledger.db"
    path.write_bytes(data.draw(spoiled(original.database)) if data.draw(st.booleans()) else original.database)
    path.with_name("ledger.db-wal").write_bytes(data.draw(spoiled(original.log)) if data.draw(st.booleans()) else b"")
    path.with_name("ledger.db-shm").unlink(missing_ok=True)
    look_at_everything(path)


@pytest.mark.safety("SR-43", "SR-40")
@HOSTILE
@given(data=st.data())
def test_no_bytes_keep_the_writer_from_a_sound_record(
    data: st.DataObject, original: Files, tmp_path: Path
) -> None:
    """It opens what is sound, sets aside what is damaged, or refuses; what it opens takes a record that can be read."""
    for old in tmp_path.iterdir():
        old.unlink()
    path = tmp_path / "ledger.db"
    path.write_bytes(data.draw(spoiled(original.database)))
    path.with_name("ledger.db-wal").write_bytes(data.draw(spoiled(original.log)))
    try:
        with SqliteLedger(path, clock=VirtualClock(), wall=lambda: NOW) as ledger:
            ledger.begin_run(software_version="2", config_hash="x")
            ledger.intend("new", plan("new"), 1, 1.0)
            ledger.conclude(outcome("new"))
            assert ledger.counts(ledger.run_id)["placed"] == 1
    except LedgerError:
        return


COLUMNS = {
    "runs": ("started_wall", "started_at_s", "details", "ended_at_s", "end_reason", "mode", "software_version"),
    "outcomes": ("result", "reason", "attempts", "finished_at_s", "wall", "label", "bin", "x_mm"),
    "events": ("at_s", "wall", "kind", "details"),
}
VALUES = st.one_of(
    st.none(), st.integers(-(2**63), 2**63 - 1), st.floats(), st.text(max_size=30), st.binary(max_size=30),
    st.sampled_from(['{"doing": 7}', "[1]", '{"doing": "held", "code": null}', "[" * 3000, "9999-99-99", "0001-01-01"]),
)  # fmt: skip


@pytest.mark.safety("SR-43")
@HOSTILE
@given(changes=st.lists(st.tuples(st.sampled_from(sorted(COLUMNS)), st.integers(0, 9), VALUES), min_size=1, max_size=5))
def test_no_values_crash_the_readers(
    changes: list[tuple[str, int, object]], original: Files, tmp_path: Path
) -> None:
    """A ledger that SQLite takes for sound, with values that this program never writes."""
    path = tmp_path / "ledger.db"
    path.write_bytes(original.database)
    path.with_name("ledger.db-wal").write_bytes(original.log)
    path.with_name("ledger.db-shm").unlink(missing_ok=True)
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("PRAGMA ignore_check_constraints = ON")
    for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
        connection.execute(f"DROP TRIGGER {name}")
    for table, column, value in changes:
        name = COLUMNS[table][column % len(COLUMNS[table])]
        try:
            connection.execute(f"UPDATE {table} SET {name} = ?", (value,))
        except sqlite3.IntegrityError:
            continue  # NOT NULL holds even here
    connection.close()
    look_at_everything(path)

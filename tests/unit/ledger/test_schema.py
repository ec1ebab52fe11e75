from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from controller.errors import LedgerError
from controller.ledger import LedgerView, SqliteLedger, opening, schema, view
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan


def opened(path: Path) -> SqliteLedger:
    return SqliteLedger(path, clock=VirtualClock())


def with_migrations(monkeypatch: pytest.MonkeyPatch, *steps: tuple[str, ...]) -> None:
    """Let the program know further schemas."""
    migrations = (*schema.MIGRATIONS, *steps)
    monkeypatch.setattr(schema, "MIGRATIONS", migrations)
    for module in (schema, opening, view):
        monkeypatch.setattr(module, "SCHEMA", len(migrations))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with opened(tmp_path / "ledger.db") as ledger:
        ledger.intend("t1", plan("t1"), 1, 4.0)
        ledger.conclude(outcome("t1"))
    return tmp_path / "ledger.db"


def test_an_older_ledger_is_brought_forward_with_its_records(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_migrations(monkeypatch, ("ALTER TABLE outcomes ADD COLUMN weight_g REAL",), ("CREATE TABLE shifts (name)",))
    with opened(path) as ledger:
        (row,) = ledger.rows("outcomes")
        assert (row["target_id"], row["weight_g"]) == ("t1", None)
        assert schema.version_of(ledger._connection) == schema.SCHEMA


def test_the_older_form_is_kept_beside_it(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    older = schema.SCHEMA
    with_migrations(monkeypatch, ("DELETE FROM runs WHERE 0", "DROP TABLE days"))
    opened(path).close()
    monkeypatch.undo()
    with LedgerView(path.with_name(f"ledger.db.schema{older}")) as copy:
        assert copy.counts()["placed"] == 1
        assert list(copy.rows("days")) == []


def test_a_failing_step_leaves_the_ledger_as_it_was(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_migrations(monkeypatch, ("ALTER TABLE outcomes ADD COLUMN weight_g REAL", "INSERT INTO nowhere VALUES (1)"))
    with pytest.raises(LedgerError, match="no such table: nowhere"):
        opened(path)
    monkeypatch.undo()
    with opened(path) as ledger:
        (row,) = ledger.rows("outcomes")
        assert "weight_g" not in row
        assert ledger.verify() == ()


def test_a_view_reads_an_older_ledger_and_leaves_it_alone(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_migrations(monkeypatch, ("ALTER TABLE outcomes ADD COLUMN weight_g REAL",))
    before = path.read_bytes()
    with LedgerView(path) as older:
        assert [row["weight_g"] for row in older.rows("outcomes")] == [None]
    assert path.read_bytes() == before


def test_a_new_ledger_has_the_present_schema_and_mark(path: Path) -> None:
    connection = sqlite3.connect(path)
    assert schema.version_of(connection) == schema.SCHEMA
    assert not schema.is_foreign(connection)
    connection.close()


def test_a_released_schema_never_changes() -> None:
    """A change needs a further migration: ledgers of this form are in the world."""
    connection = sqlite3.connect(":memory:", isolation_level=None)
    for statement in schema.MIGRATIONS[0]:
        connection.execute(statement)
    made = connection.execute(
        "SELECT sql FROM sqlite_master WHERE sql IS NOT NULL AND name NOT LIKE 'sqlite_%' ORDER BY name"
    )
    released = (Path(__file__).resolve().parents[2] / "data" / "ledger_schema_1.sql").read_text(encoding="ascii")
    assert [" ".join(sql.split()) + ";" for (sql,) in made] == released.splitlines()
    connection.close()

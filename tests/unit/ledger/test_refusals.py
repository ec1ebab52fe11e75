"""Files, folders and disks a ledger cannot be kept in: said, and nothing of others is touched."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

import pytest

from controller.errors import LedgerError
from controller.ledger import LedgerView, SqliteLedger
from controller.ledger.schema import SCHEMA
from tests.unit.ledger.nouns import opened, outcome, plan


def test_a_newer_schema_is_refused_and_left_alone(path: Path) -> None:
    opened(path).close()
    with sqlite3.connect(path) as connection:
        connection.execute(f"PRAGMA user_version = {SCHEMA + 1}")
    connection.close()
    before = path.read_bytes()
    for reader in (lambda: opened(path), lambda: LedgerView(path)):
        with pytest.raises(LedgerError, match="newer version"):
            reader()
    assert path.read_bytes() == before


def test_a_database_of_something_else_is_refused_and_left_alone(path: Path) -> None:
    path.parent.mkdir()
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE songs (title TEXT)")
    connection.close()
    before = path.read_bytes()
    for reader in (lambda: opened(path), lambda: LedgerView(path)):
        with pytest.raises(LedgerError, match="not a ledger"):
            reader()
    assert path.read_bytes() == before


@pytest.mark.parametrize("damage", ["text", "page", "schema", "version"])
def test_a_damaged_ledger_is_set_aside_and_a_new_one_begun(path: Path, damage: str) -> None:
    with opened(path) as ledger:
        for number in range(30):
            ledger.note("tick", float(number), text="x" * 1000)
    if damage == "text":
        path.write_text("this is not a database\n" * 400, encoding="ascii")
    elif damage == "schema":
        # SQLite quotes the place in its message, which then is no text either.
        path.write_bytes(path.read_bytes().replace(b"CREATE TABLE runs", b"CREATE TABL\x80 runs"))
    elif damage == "version":
        with sqlite3.connect(path) as connection:
            connection.execute("PRAGMA user_version = -7")
        connection.close()
    else:
        data = bytearray(path.read_bytes())
        data[4096 * 3 : 4096 * 5] = b"\xa5" * 8192
        path.write_bytes(bytes(data))
    damaged = path.read_bytes()
    with pytest.raises(LedgerError), LedgerView(path) as view:
        assert view.verify() == ()
    with opened(path) as again:
        assert again.set_aside is not None
        assert again.set_aside.read_bytes() == damaged
        (event,) = again.rows("events")
        assert (event["kind"], event["details"]) == ("ledger_damaged", {"set_aside": str(again.set_aside)})
        again.intend("t1", plan("t1"), 1, 4.0)
        again.conclude(outcome("t1"))
        assert again.verify() == ()


def test_a_sound_ledger_is_not_set_aside(path: Path) -> None:
    opened(path).close()
    with opened(path) as again:
        assert again.set_aside is None


def test_a_full_disk_is_said_and_nothing_half_written_stays(ledger: SqliteLedger) -> None:
    ask = ledger._connection.execute
    pages = ask("PRAGMA page_count").fetchone()[0]
    ask(f"PRAGMA max_page_count = {pages}")
    def fill() -> None:
        for number in range(1000):
            ledger.note("tick", float(number), text="x" * 1000)

    with pytest.raises(LedgerError, match=r"full.*free some space"):
        fill()
    written = len(list(ledger.rows("events")))
    ask("PRAGMA max_page_count = 100000")
    ledger.intend("t1", plan("t1"), 1, 4.0)
    ledger.conclude(outcome("t1"))
    assert len(list(ledger.rows("events"))) == written
    assert ledger.verify() == ()


def test_a_ledger_that_became_read_only_is_said(ledger: SqliteLedger) -> None:
    ledger._connection.execute("PRAGMA query_only = ON")
    with pytest.raises(LedgerError, match=r"readonly.*writable"):
        ledger.intend("t1", plan("t1"), 1, 4.0)


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="ascii")
    with pytest.raises(LedgerError, match="folder that can be written"):
        opened(tmp_path / "file" / "ledger.db")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_in_a_read_only_folder_it_can_be_read_but_not_written(path: Path) -> None:
    with opened(path) as ledger:
        ledger.conclude(outcome("t1"))
    path.chmod(0o444)
    path.parent.chmod(0o555)
    try:
        with LedgerView(path) as view:
            assert view.counts()["placed"] == 1
        with pytest.raises(LedgerError, match=r"readonly.*make the folder and the file writable"):
            opened(path)
    finally:
        path.parent.chmod(0o755)


def test_a_folder_in_the_place_of_the_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(LedgerError, match="unable to open"):
        opened(tmp_path)

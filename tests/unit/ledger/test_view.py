"""Reading a ledger: checks, exports, and readers beside the writer."""

from __future__ import annotations

import csv
import json
import sqlite3
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from controller.domain import Outcome, Result
from controller.errors import LedgerError
from controller.ledger import LedgerView, SqliteLedger
from tests.unit.ledger.nouns import opened, outcome, plan, target


@pytest.mark.safety("SR-40")
def test_verify_finds_an_attempt_that_is_not_on_record(ledger: SqliteLedger) -> None:
    ledger.intend("t1", plan("t1"), 1, 4.0)
    ledger.conclude(outcome("t1", attempts=2))
    ledger.conclude(outcome("t2", attempts=1))
    ledger.conclude(outcome("t3", Result.SKIPPED, attempts=0))
    assert ledger.verify() == (
        "target t1 of run 1: 1 attempts on record, but its outcome says 2",
        "target t2 of run 1: 0 attempts on record, but its outcome says 1",
    )


def test_verify_finds_a_wrong_count_and_an_unknown_run(ledger: SqliteLedger) -> None:
    ledger.intend("t1", plan("t1"), 1, 4.0)
    ledger.intend("t1", plan("t1"), 2, 5.0)
    ledger.conclude(outcome("t1", attempts=1))
    ledger._connection.execute("PRAGMA foreign_keys = OFF")
    ledger._connection.execute("INSERT INTO events (run_id, at_s, wall, kind, details) VALUES (9, 0, '', 'x', '{}')")
    problems = ledger.verify()
    assert problems == (
        "events 1 names an unknown run",
        "target t1 of run 1: 2 attempts on record, but its outcome says 1",
    )


def test_export_gives_back_every_record(ledger: SqliteLedger) -> None:
    ledger.conclude(outcome("t1"))
    ledger.conclude(outcome("t2", Result.REJECTED))
    lines = [json.loads(line) for line in ledger.export("jsonl")]
    assert lines == list(ledger.rows("outcomes"))
    header, *rows = [line.split(",") for line in ledger.export("csv")]
    assert [dict(zip(header, row, strict=True))["result"] for row in rows] == ["placed", "rejected"]


def test_export_quotes_what_csv_needs_quoted(ledger: SqliteLedger) -> None:
    ledger.note("fault", 1.0, text='a "b", c')
    (line,) = list(ledger.export("csv", "events"))[1:]
    assert line.endswith('"{""text"": ""a \\""b\\"", c""}"')


def test_no_name_is_a_formula_in_a_spreadsheet(ledger: SqliteLedger) -> None:
    final = outcome("t1")
    for number, reason in enumerate(("=1+1", "-2", "@sum", "in left")):
        ledger.conclude(Outcome(target(f"t{number}"), final.plan, final.result, reason, 0, -4.5, 8.5))
    rows = list(csv.DictReader(ledger.export("csv")))
    assert [row["reason"] for row in rows] == ["'=1+1", "'-2", "'@sum", "in left"]
    assert {row["started_at_s"] for row in rows} == {"-4.5"}
    assert next(ledger.rows("outcomes"))["reason"] == "=1+1"


def test_a_view_of_a_missing_or_damaged_ledger_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LedgerError, match="no such ledger"):
        LedgerView(tmp_path / "none.db")
    (tmp_path / "text.db").write_text("not a database at all, but a text\n" * 100, encoding="ascii")
    with pytest.raises(LedgerError, match="not a database"):
        LedgerView(tmp_path / "text.db")


def test_one_may_stop_reading_in_the_middle(path: Path) -> None:
    with opened(path) as ledger:
        ledger.conclude(outcome("t1"))
        ledger.conclude(outcome("t2"))
    with LedgerView(path) as view:
        lines = view.export("csv")
        next(lines)
        next(lines)
    assert isinstance(lines, Generator)
    lines.close()


def test_a_view_settles_nothing(path: Path) -> None:
    with opened(path) as ledger:
        ledger.intend("t1", plan("t1"), 1, 4.0)
    with LedgerView(path) as view:
        assert view.counts()["open"] == 1
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            view._connection.execute("INSERT INTO events (at_s, wall, kind, details) VALUES (0, '', 'x', '{}')")


def test_threads_do_not_mix_their_records(ledger: SqliteLedger, path: Path) -> None:
    def work(name: str) -> None:
        for number in range(20):
            ledger.intend(f"{name}{number}", plan(f"{name}{number}"), 1, 4.0)
            ledger.note("tick", 4.0, name=name)
            ledger.conclude(outcome(f"{name}{number}"))

    with ThreadPoolExecutor(3) as pool:
        for done in [pool.submit(work, name) for name in "abc"]:
            done.result()
    with LedgerView(path) as view:
        assert view.counts()["placed"] == 60
        assert len(list(view.rows("events"))) == 60
        assert view.verify() == ()


def test_a_reader_sees_whole_records_only_and_never_stops_the_writer(ledger: SqliteLedger, path: Path) -> None:
    with LedgerView(path) as view:
        reading = view.rows("runs")
        next(reading)  # a read in progress
        for number in range(3):
            ledger.intend(f"t{number}", plan(f"t{number}"), 1, 4.0)
            ledger.conclude(outcome(f"t{number}"))
        reading.close()
        assert view.counts()["placed"] == 3

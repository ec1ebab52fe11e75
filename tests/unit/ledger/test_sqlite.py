from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import pytest

from controller.domain import Outcome, Result
from controller.errors import LedgerError
from controller.ledger import LedgerView, SqliteLedger
from controller.ledger.schema import SCHEMA
from controller.ports import Ledger
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan, target

WALL = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


def opened(path: Path, *, begin: bool = True) -> SqliteLedger:
    ledger = SqliteLedger(path, clock=VirtualClock(100.0), wall=lambda: WALL)
    if begin:
        ledger.begin_run(software_version="1.2", config_hash="abc", calibration_id="cal-1", mode="sim", arm="a", seed=7)
    return ledger


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cell" / "ledger.db"


@pytest.fixture
def ledger(path: Path) -> Iterator[SqliteLedger]:
    with opened(path) as ledger:
        yield ledger


def test_it_is_the_port(ledger: SqliteLedger) -> None:
    assert isinstance(ledger, Ledger)


def test_an_intent_keeps_what_was_seen_and_planned(ledger: SqliteLedger) -> None:
    ledger.intend("t1", plan("t1"), 1, 4.0)
    (row,) = ledger.rows("intents")
    assert row == {
        "intent_id": 1,
        "run_id": 1,
        "target_id": "t1",
        "attempt": 1,
        "at_s": 4.0,
        "wall": "2026-01-02T03:04:05.000+00:00",
        "frame_id": 17,
        "frame_source": "camera",
        "captured_at_s": 3.25,
        "calibration_id": "cal-1",
        "shape": "hexagon",
        "label": "nut",
        "score": 0.75,
        "colour": "red",
        "texture": None,
        "x_mm": 12.5,
        "y_mm": -40.25,
        "yaw_deg": pytest.approx(30.0, rel=1e-12),
        "long_mm": 46.0,
        "short_mm": 39.0,
        "height_mm": 22.0,
        "sigma_mm": 0.3,
        "bin": "left",
        "grasp_x_mm": 12.0,
        "grasp_y_mm": -41.0,
        "grasp_height_mm": 11.0,
        "grasp_direction_deg": pytest.approx(60.0, rel=1e-12),
        "grasp_width_mm": 39.5,
        "grasp_opening_mm": 52.0,
        "grasp_clearance_mm": 4.5,
    }


def test_an_outcome_keeps_result_reason_and_times(ledger: SqliteLedger) -> None:
    ledger.intend("t1", plan("t1"), 1, 4.0)
    ledger.conclude(outcome("t1", Result.DROPPED))
    (row,) = ledger.rows("outcomes")
    wanted = {"result": "dropped", "reason": "seen in the bin", "attempts": 1, "started_at_s": 4.0, "bin": "left"}
    assert {key: row[key] for key in wanted} == wanted
    assert row["finished_at_s"] == 8.5


def test_a_target_without_a_plan_or_a_direction_is_concluded(ledger: SqliteLedger) -> None:
    ledger.conclude(Outcome(target("t1", yaw=None), None, Result.SKIPPED, "out of reach", 0, 1.0, 1.0))
    (row,) = ledger.rows("outcomes")
    assert (row["yaw_deg"], row["bin"], row["grasp_x_mm"], row["attempts"]) == (None, None, None, 0)


def test_a_record_is_there_for_another_reader_when_the_call_returns(ledger: SqliteLedger, path: Path) -> None:
    ledger.intend("t1", plan("t1"), 1, 4.0)
    with LedgerView(path) as view:
        assert view.counts()["open"] == 1
    ledger.conclude(outcome("t1"))
    with LedgerView(path) as view:
        assert (view.counts()["open"], view.counts()["placed"]) == (0, 1)


@pytest.mark.safety("SR-40")
def test_commits_reach_the_disk_before_they_return(ledger: SqliteLedger) -> None:
    ask = ledger._connection.execute
    assert ask("PRAGMA journal_mode").fetchone() == ("wal",)
    assert ask("PRAGMA synchronous").fetchone() == (2,)  # FULL


@pytest.mark.safety("SR-41")
def test_a_second_outcome_is_refused_and_the_first_stands(ledger: SqliteLedger) -> None:
    ledger.intend("t1", plan("t1"), 1, 4.0)
    ledger.conclude(outcome("t1", Result.PLACED))
    with pytest.raises(ValueError, match="outcome of t1"):
        ledger.conclude(outcome("t1", Result.DROPPED))
    assert [row["result"] for row in ledger.rows("outcomes")] == ["placed"]
    assert ledger.verify() == ()


def test_an_intent_after_the_outcome_is_refused(ledger: SqliteLedger) -> None:
    ledger.conclude(outcome("t1"))
    with pytest.raises(ValueError, match="already has an outcome"):
        ledger.intend("t1", plan("t1"), 2, 9.0)


def test_the_same_attempt_twice_is_refused_a_further_one_is_not(ledger: SqliteLedger) -> None:
    ledger.intend("t1", plan("t1"), 1, 4.0)
    with pytest.raises(ValueError, match="UNIQUE"):
        ledger.intend("t1", plan("t1"), 1, 5.0)
    ledger.intend("t1", plan("t1"), 2, 6.0)
    assert ledger.counts()["targets"] == 1


def test_a_target_without_a_name_is_refused(ledger: SqliteLedger) -> None:
    with pytest.raises(ValueError, match="CHECK"):
        ledger.conclude(outcome(""))


@pytest.mark.parametrize("table", ["intents", "outcomes", "events"])
@pytest.mark.parametrize("change", ["UPDATE {} SET wall = ''", "DELETE FROM {}"])
def test_records_cannot_be_changed_or_taken_away(ledger: SqliteLedger, table: str, change: str) -> None:
    ledger.intend("t1", plan("t1"), 1, 4.0)
    ledger.conclude(outcome("t1"))
    ledger.note("start", 1.0)
    with pytest.raises(sqlite3.IntegrityError, match="only grows"):
        ledger._connection.execute(change.format(table))


def test_a_record_without_a_run_gets_one(path: Path) -> None:
    with opened(path, begin=False) as ledger:
        ledger.note("probe", 1.0)
        ledger.intend("t1", plan("t1"), 1, 4.0)
        assert [row["run_id"] for row in ledger.rows("intents")] == [1]
        assert [row["software_version"] for row in ledger.rows("runs")] == [""]
        assert [row["run_id"] for row in ledger.rows("events")] == [None]


def test_closing_ends_the_run(path: Path) -> None:
    opened(path).close()
    with opened(path, begin=False) as again:
        assert [row["end_reason"] for row in again.rows("runs")] == ["closed"]
        assert again.unclean_runs == 0


def test_closing_on_a_full_disk_is_quiet(path: Path) -> None:
    ledger = opened(path)
    ledger._connection.execute("PRAGMA query_only = ON")
    ledger.close()
    with opened(path, begin=False) as again:
        assert again.unclean_runs == 1


def test_the_same_name_in_another_run_is_another_target(ledger: SqliteLedger) -> None:
    ledger.conclude(outcome("t1"))
    ledger.end_run("done")
    second = ledger.begin_run(software_version="1.2", config_hash="abc")
    ledger.conclude(outcome("t1", Result.DROPPED))
    assert (ledger.counts()["targets"], ledger.counts(second)["targets"]) == (2, 1)
    assert (ledger.counts(second)["placed"], ledger.counts(second)["dropped"]) == (0, 1)


def test_a_run_says_what_ran_and_how_it_ended(ledger: SqliteLedger) -> None:
    ledger.begin_run(software_version="1.3", config_hash="def", recipe="precise")
    ledger.end_run("stopped")
    first, second = ledger.rows("runs")
    assert (first["seed"], first["config_hash"], first["end_reason"]) == (7, "abc", "changed")
    assert (second["details"], second["end_reason"]) == ({"recipe": "precise"}, "stopped")
    assert second["started_at_s"] == 100.0


def test_events_keep_their_details(ledger: SqliteLedger) -> None:
    ledger.note("fault", 5.0, code="camera_lost", where=Path("x"))
    (row,) = ledger.rows("events")
    assert (row["kind"], row["at_s"], row["details"]) == ("fault", 5.0, {"code": "camera_lost", "where": "x"})


@pytest.mark.safety("SR-41")
def test_what_a_run_left_open_is_settled_once(path: Path) -> None:
    ledger = opened(path)
    ledger.intend("t1", plan("t1"), 1, 4.0)
    ledger.conclude(outcome("t1"))
    ledger.intend("t2", plan("t2"), 1, 9.0)
    ledger.intend("t2", plan("t2"), 2, 11.0)
    ledger._connection.close()  # what a killed process leaves to SQLite
    with opened(path, begin=False) as again:
        (open_,) = again.indeterminate
        assert (open_.run_id, open_.target_id, open_.label, open_.bin, open_.attempts) == (1, "t2", "nut", "left", 2)
        assert again.unclean_runs == 1
        row = list(again.rows("outcomes"))[-1]
        assert (row["result"], row["started_at_s"], row["finished_at_s"]) == ("indeterminate", 9.0, 11.0)
        assert again.counts() == again.counts(1)
        assert (again.counts()["indeterminate"], again.counts()["open"], again.counts()["targets"]) == (1, 0, 2)
        assert again.verify() == ()
    with opened(path, begin=False) as third:
        assert (third.indeterminate, third.unclean_runs) == ((), 0)
        assert third.counts()["indeterminate"] == 1


def test_a_run_that_ended_is_not_unclean(path: Path) -> None:
    with opened(path) as ledger:
        ledger.end_run("done")
    with opened(path, begin=False) as again:
        assert again.unclean_runs == 0


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

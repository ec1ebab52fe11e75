from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from controller.domain import Outcome, Result
from controller.ledger import LedgerView, SqliteLedger
from controller.ports import Ledger
from tests.unit.ledger.nouns import opened, outcome, plan, target


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

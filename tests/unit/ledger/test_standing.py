"""What a cell that is started again asks its ledger: what lies in the bins, in the jaws, and how it ended before."""

from __future__ import annotations

import itertools
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from controller.domain import Result
from controller.ledger.sqlite import SqliteLedger
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ledger.db"


def opened(path: Path, day: int = 1) -> SqliteLedger:
    """A ledger with a run begun, on a clock that moves with every record."""
    seconds = itertools.count()
    ledger = SqliteLedger(
        path, clock=VirtualClock(), wall=lambda: datetime(2026, 1, day, tzinfo=UTC) + timedelta(seconds=next(seconds))
    )
    ledger.begin_run(software_version="1", config_hash="a")
    return ledger


def test_bins_hold_what_was_put_into_them_since_they_were_emptied(path: Path) -> None:
    with opened(path) as ledger:
        assert ledger.in_bins() == {}
        for number, result in enumerate([Result.PLACED, Result.REJECTED, Result.DROPPED, Result.GRASP_MISSED]):
            ledger.conclude(outcome(f"t{number}", result))
        assert ledger.in_bins() == {"left": 2}
        ledger.note("emptied", 10.0, bin="right")
        assert ledger.in_bins() == {"left": 2}
    with opened(path, 2) as ledger:
        ledger.note("emptied", 1.0, bin="left")
        assert ledger.in_bins() == {}
        ledger.conclude(outcome("t9"))
        assert ledger.in_bins() == {"left": 1}
        ledger.note("emptied", 10.0)
        assert ledger.in_bins() == {}


@pytest.mark.safety("SR-33")
def test_a_date_that_was_set_back_changes_nothing_of_what_came_first(path: Path) -> None:
    with opened(path, 2) as ledger:
        ledger.conclude(outcome("t1"))
        ledger.note("emptied", 10.0)
        ledger.note("operator", 10.0, command="reset", uid=0)
    with opened(path, 1) as ledger:
        ledger.conclude(outcome("t2", Result.ABORTED))
        assert ledger.may_hold_part
        ledger.conclude(outcome("t3"))
        assert ledger.in_bins() == {"left": 1}


@pytest.mark.parametrize(
    ("result", "may"), [(Result.PLACED, False), (Result.INDETERMINATE, True), (Result.ABORTED, True)]
)
def test_the_jaws_may_hold_what_nobody_knows_the_end_of(path: Path, result: Result, may: bool) -> None:
    with opened(path) as ledger:
        assert not ledger.may_hold_part
        ledger.conclude(outcome("t1", result))
        assert ledger.may_hold_part is may
        ledger.note("operator", 10.0, command="stop", uid=0)
        assert ledger.may_hold_part is may
        ledger.note("operator", 10.0, command="reset", uid=0)
        assert not ledger.may_hold_part


def test_the_jaws_may_hold_what_a_kill_left_open(path: Path) -> None:
    ledger = opened(path)
    ledger.intend("t1", plan("t1"), 1, 4.0)
    ledger._connection.close()
    with opened(path, 2) as again:
        assert again.may_hold_part
        again.conclude(outcome("t1"))
        assert not again.may_hold_part


@pytest.mark.safety("SR-07")
def test_runs_cut_off_are_counted_in_a_row(path: Path) -> None:
    for day, cut_off in enumerate([0, 1, 2, 3], 1):
        ledger = opened(path, day)
        assert ledger.unclean_in_a_row == cut_off
        ledger._connection.close()
    with opened(path, 5) as ledger:
        assert ledger.unclean_in_a_row == 4
        ledger.end_run("stopped")
    with opened(path, 6) as ledger:
        assert ledger.unclean_in_a_row == 0

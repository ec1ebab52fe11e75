from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from controller.domain import Result
from controller.ledger import SqliteLedger
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan

NOON = datetime(2026, 3, 10, 12, tzinfo=UTC)


class Calendar:
    """The date, as the test says."""

    def __init__(self) -> None:
        self.now = NOON

    def __call__(self) -> datetime:
        return self.now


@pytest.fixture
def calendar() -> Calendar:
    return Calendar()


@pytest.fixture
def ledger(tmp_path: Path, calendar: Calendar) -> Iterator[SqliteLedger]:
    """Ten days with three targets and one event each, and a target that was left open on the first day."""
    with SqliteLedger(tmp_path / "ledger.db", clock=VirtualClock(), wall=calendar) as ledger:
        ledger.begin_run(software_version="1", config_hash="x", mode="real")
        ledger.intend("open", plan("open"), 1, 1.0)
        for day in range(10):
            calendar.now = NOON + timedelta(days=day)
            for number, result in enumerate((Result.PLACED, Result.PLACED, Result.DROPPED)):
                name = f"{day}-{number}"
                ledger.intend(name, plan(name), 1, 1.0)
                ledger.conclude(outcome(name, result, attempts=1))
            ledger.note("tick", 1.0, text="x" * 4000)
        yield ledger


def test_old_records_become_counts_of_their_day(ledger: SqliteLedger, calendar: Calendar) -> None:
    calendar.now = NOON + timedelta(days=10)
    assert ledger.prune(keep=timedelta(days=8)) == 6
    assert {row["target_id"] for row in ledger.rows("outcomes")} == {f"{d}-{n}" for d in range(2, 10) for n in range(3)}
    assert len(list(ledger.rows("events"))) == 8
    assert list(ledger.rows("days")) == [
        {"day": day, "mode": "real", "label": "nut", "bin": "left", "result": result, "targets": n, "attempts": n}
        for day in ("2026-03-10", "2026-03-11")
        for result, n in (("dropped", 1), ("placed", 2))
    ]
    assert ledger.verify() == ()


def test_nothing_is_counted_twice(ledger: SqliteLedger, calendar: Calendar) -> None:
    calendar.now = NOON + timedelta(days=9, hours=6)
    for keep in (timedelta(days=5), timedelta(days=5), timedelta(days=2), timedelta(0)):
        ledger.prune(keep=keep)
        single = sum(1 for _ in ledger.rows("outcomes"))
        counted = sum(row["targets"] for row in ledger.rows("days") if isinstance(row["targets"], int))
        assert single + counted == 30


def test_an_open_target_stays(ledger: SqliteLedger, calendar: Calendar) -> None:
    calendar.now = NOON + timedelta(days=1000)
    ledger.prune()
    assert [row["target_id"] for row in ledger.rows("intents")] == ["open"]
    assert ledger.counts()["open"] == 1
    ledger.conclude(outcome("open"))
    assert ledger.verify() == ()


def test_the_oldest_days_go_until_the_rest_fits(ledger: SqliteLedger, calendar: Calendar, tmp_path: Path) -> None:
    size = ledger._connection.execute("PRAGMA page_count").fetchone()[0] * 4096
    assert ledger.prune(most_bytes=size - 4 * 4096) > 0
    left = [str(row["target_id"]) for row in ledger.rows("outcomes")]
    assert left
    assert left == [f"{d}-{n}" for d in range(10 - len(left) // 3, 10) for n in range(3)]
    # The pages are handed back, so that the file itself fits.
    ledger.close()
    assert (tmp_path / "ledger.db").stat().st_size <= size - 4 * 4096


def test_todays_records_stay_however_large(ledger: SqliteLedger) -> None:
    ledger.prune(most_bytes=0)
    assert {row["target_id"] for row in ledger.rows("outcomes")} == {"9-0", "9-1", "9-2"}


def test_the_guard_is_up_again_afterwards(ledger: SqliteLedger) -> None:
    ledger.prune(keep=timedelta(days=3))
    with pytest.raises(Exception, match="only grows"):
        ledger._connection.execute("DELETE FROM outcomes")

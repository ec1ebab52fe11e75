"""What the cell did, as events: few, in order, and none lost to a disk that was full for a while."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from controller.cycle.machine import State
from controller.domain import Outcome, PickPlan
from controller.errors import CameraLost, FrameStale, LedgerError, MotionTimeout
from controller.ledger import SqliteLedger
from controller.service.alarms import AlarmLog
from controller.service.chronicle import Calendar, Chronicle, Housekeeper, tell_what_was_found
from sim_backends.virtual_clock import VirtualClock
from tests.unit.ledger.nouns import outcome, plan

LOST = CameraLost("camera", "read", "unplugged", "plug it in")


@dataclass
class Events:
    """A ledger that keeps events, unless its disk is full."""

    events: list[tuple[str, float, dict[str, Any]]] = field(default_factory=list)
    full: bool = False

    def note(self, kind: str, at: float, **details: object) -> None:
        if self.full:
            raise LedgerError("ledger: full")
        self.events.append((kind, at, details))

    def intend(self, target_id: str, plan: PickPlan, attempt: int, at: float) -> None:
        raise NotImplementedError

    def conclude(self, outcome: Outcome) -> None:
        raise NotImplementedError

    def doings(self) -> list[tuple[str, float, str]]:
        return [(details["doing"], at, details.get("code", "")) for kind, at, details in self.events if kind == "state"]


@pytest.fixture
def ledger() -> Events:
    return Events()


@pytest.fixture
def chronicle(ledger: Events) -> Chronicle:
    return Chronicle(ledger, VirtualClock())


def enter(chronicle: Chronicle, at: float, *states: State) -> None:
    for state in states:
        chronicle.entered(state, at)


LOOK: Sequence[State] = (State.CAPTURE, State.DETECT, State.LOCALIZE)


def test_an_empty_table_is_one_event_however_often_it_is_looked_at(chronicle: Chronicle, ledger: Events) -> None:
    enter(chronicle, 1.0, State.HOMING, *LOOK, State.IDLE)
    for _ in range(50):
        enter(chronicle, 2.0, *LOOK, State.IDLE)
    chronicle.attempted(plan(), 1)
    enter(chronicle, 3.0, State.PLACE, State.STOPPED)
    assert [doing for doing, _, _ in ledger.doings()] == ["sorting", "waiting", "sorting", "stopped"]


def test_a_hold_lasts_until_its_cause_is_over(chronicle: Chronicle, ledger: Events) -> None:
    enter(chronicle, 1.0, State.HOMING, State.CAPTURE)
    chronicle.held(LOST, 2.0)
    for at in (2.0, 3.0, 5.0):  # tries that fail
        enter(chronicle, at, State.HELD, State.CAPTURE)
    chronicle.held(FrameStale("camera", "capture", "no frame"), 6.0)
    enter(chronicle, 6.0, State.HELD, State.CAPTURE)
    chronicle.resumed(9.0)
    enter(chronicle, 9.0, State.DETECT)
    assert ledger.doings() == [
        ("sorting", 1.0, ""),
        ("held", 2.0, "camera_lost"),
        ("held", 6.0, "camera_stalled"),
        ("sorting", 9.0, ""),
    ]


def test_a_pause_is_a_hold_of_its_own(chronicle: Chronicle, ledger: Events) -> None:
    enter(chronicle, 1.0, State.HOMING, State.CAPTURE, State.HELD)
    enter(chronicle, 4.0, State.CAPTURE, State.DETECT)
    assert ledger.doings() == [("sorting", 1.0, ""), ("paused", 1.0, ""), ("sorting", 4.0, "")]


def test_a_pause_in_mid_move_is_told_by_whoever_asked_for_it(chronicle: Chronicle, ledger: Events) -> None:
    enter(chronicle, 1.0, State.HOMING, State.CAPTURE, State.PICK)
    chronicle.commanded("pause", 1000)
    enter(chronicle, 3.0, State.PLACE)
    chronicle.commanded("resume", 1000)
    enter(chronicle, 4.0, State.CAPTURE)
    assert [doing for doing, _, _ in ledger.doings()] == ["sorting", "paused", "sorting"]


def test_a_fault_lasts_until_it_is_reset(chronicle: Chronicle, ledger: Events) -> None:
    enter(chronicle, 1.0, State.HOMING)
    chronicle.faulted(MotionTimeout("arm", "follow", "stuck"), 2.0)
    enter(chronicle, 2.0, State.FAULT)
    chronicle.cleared()
    chronicle.commanded("reset", 1000)
    kinds = [(kind, details.get("doing", details.get("command"))) for kind, _, details in ledger.events]
    assert kinds == [("state", "sorting"), ("state", "fault"), ("state", "stopped"), ("operator", "reset")]
    told = ledger.events[1][2]
    assert (told["code"], told["cause"]) == ("motion_timeout", "arm: follow: stuck")
    assert "controller reset" in told["remedy"]  # the catalogue's, where the error has none of its own


def test_what_a_full_disk_refuses_is_written_later_in_order(chronicle: Chronicle, ledger: Events) -> None:
    enter(chronicle, 1.0, State.HOMING)
    ledger.full = True
    chronicle.held(LedgerError("ledger: full"), 2.0)
    assert len(ledger.events) == 1
    ledger.full = False
    chronicle.resumed(8.0)
    assert ledger.doings() == [("sorting", 1.0, ""), ("held", 2.0, "ledger_unwritable"), ("sorting", 8.0, "")]


def test_old_records_go_once_a_day(tmp_path: Path) -> None:
    now = datetime(2026, 3, 10, 12, tzinfo=UTC)
    clock = VirtualClock()
    with SqliteLedger(tmp_path / "ledger.db", clock=clock, wall=lambda: now) as ledger:
        ledger.conclude(outcome("old"))
        housekeeper = Housekeeper(ledger, clock, timedelta(days=1), 1 << 30)
        now += timedelta(days=3)
        housekeeper.entered(State.CAPTURE, clock.now() + 3600.0)
        assert ledger.counts()["placed"] == 1  # a day has not passed by the cell's clock
        housekeeper.entered(State.CAPTURE, clock.now() + 86400.0)
        assert ledger.counts()["placed"] == 0
        assert [row["targets"] for row in ledger.rows("days")] == [1]


@pytest.mark.safety("SR-41")
def test_a_part_under_way_when_the_power_went_is_asked_for_until_somebody_has_seen_it(tmp_path: Path) -> None:
    ledger = SqliteLedger(tmp_path / "ledger.db", clock=VirtualClock())
    ledger.intend("t1", plan("t1"), 1, 1.0)
    ledger._connection.close()
    alarms = AlarmLog()
    with SqliteLedger(tmp_path / "ledger.db", clock=VirtualClock()) as again:
        tell_what_was_found(again, alarms)
    (alarm,) = alarms.open()
    assert (alarm.code, "t1 (nut, for left)" in alarm.cause, alarm.active) == ("power_lost", True, False)
    alarms.acknowledge()
    assert alarms.open() == ()


def test_a_damaged_record_is_an_alarm_that_names_where_it_was_kept(tmp_path: Path) -> None:
    (tmp_path / "ledger.db").write_text("no database\n" * 500, encoding="ascii")
    alarms = AlarmLog()
    with SqliteLedger(tmp_path / "ledger.db", clock=VirtualClock()) as ledger:
        tell_what_was_found(ledger, alarms)
        (alarm,) = alarms.open()
        assert alarm.code == "ledger_damaged"
        assert str(ledger.set_aside) in alarm.cause


def test_a_sound_record_raises_no_alarm(tmp_path: Path) -> None:
    alarms = AlarmLog()
    with SqliteLedger(tmp_path / "ledger.db", clock=VirtualClock()) as ledger:
        tell_what_was_found(ledger, alarms)
    assert alarms.history() == ()


@pytest.mark.safety("SR-33")
def test_a_date_that_jumps_goes_on_record_once(ledger: Events) -> None:
    wall, clock = datetime(2026, 3, 10, tzinfo=UTC), VirtualClock()
    calendar = Calendar(ledger, lambda: wall, clock.now)
    for step, jump in enumerate((0.0, 0.4, 3600.0, 0.0, -7200.0, 0.0)):
        clock.sleep(10.0)
        wall += timedelta(seconds=10.0 + jump)
        calendar.entered(State.CAPTURE, float(step))
    assert ledger.events == [("clock_jumped", 2.0, {"by_s": 3600.0}), ("clock_jumped", 4.0, {"by_s": -7200.0})]
    ledger.full = True
    wall += timedelta(seconds=60.0)
    calendar.entered(State.CAPTURE, 9.0)

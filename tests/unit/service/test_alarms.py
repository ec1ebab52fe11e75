"""Alarms are kept until they are over and were seen; the first one is marked. PackML names cover every state."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from controller.cycle.machine import State
from controller.service.alarms import AlarmLog
from controller.service.packml import PackML, Pending, packml


class Wall:
    """A date that moves a second at each look."""

    def __init__(self) -> None:
        self.at = datetime(2026, 11, 22, tzinfo=UTC)

    def __call__(self) -> datetime:
        self.at += timedelta(seconds=1)
        return self.at


def test_the_first_alarm_is_marked_and_those_after_it_are_not() -> None:
    log = AlarmLog()
    assert log.raise_("bus_lost", "no answer").first_out
    assert not log.raise_("watchdog", "servos stopped").first_out
    log.clear()
    assert log.raise_("camera_lost", "gone").first_out


def test_an_alarm_that_is_still_active_is_not_raised_twice() -> None:
    log = AlarmLog()
    first = log.raise_("bin_full", "squares")
    assert log.raise_("bin_full", "squares") is first
    log.clear("bin_full")
    assert log.raise_("bin_full", "squares").number == 2


def test_seen_and_over_are_two_things() -> None:
    log = AlarmLog(wall=Wall())
    log.raise_("a", "")
    log.raise_("b", "")
    assert log.acknowledge(1) == 1
    assert log.acknowledge(1) == 0
    log.clear("b")
    seen, over = log.history()
    assert (seen.active, seen.open) == (True, True)
    assert (over.active, over.open) == (False, True)
    log.clear("a")
    assert [alarm.code for alarm in log.open()] == ["b"]
    assert log.acknowledge() == 1
    assert log.open() == ()
    assert over.raised_at < log.history()[1].cleared_at < log.history()[1].acknowledged_at  # type: ignore[operator]


def test_the_history_is_bounded_and_forgets_what_matters_least() -> None:
    log = AlarmLog(capacity=3)
    log.raise_("active", "")
    log.raise_("unseen", "")
    log.clear("unseen")
    log.raise_("seen", "")
    log.clear("seen")
    log.acknowledge(3)
    log.raise_("d", "")
    assert [alarm.code for alarm in log.history()] == ["active", "unseen", "d"]
    log.raise_("e", "")
    assert [alarm.code for alarm in log.history()] == ["active", "d", "e"]
    log.raise_("f", "")
    # Nothing that is active is ever forgotten.
    assert [alarm.code for alarm in log.history()] == ["active", "d", "e", "f"]


@pytest.mark.parametrize("state", [None, *State])
@pytest.mark.parametrize("pending", [None, *Pending])
def test_every_state_has_a_name_whatever_is_pending(state: State | None, pending: Pending | None) -> None:
    assert isinstance(packml(state, pending), PackML)


def test_the_names_say_what_is_going_on() -> None:
    assert packml(None) is PackML.RESETTING
    assert packml(State.HOMING) is PackML.STARTING
    assert packml(State.IDLE) is PackML.SUSPENDED
    assert packml(State.PICK, Pending.STOP) is PackML.STOPPING
    assert packml(State.PICK, Pending.PAUSE) is PackML.HOLDING
    assert packml(State.HELD, Pending.PAUSE) is PackML.HELD
    assert packml(State.STOPPED, Pending.STOP) is PackML.STOPPED
    assert packml(State.FAULT, Pending.STOP) is PackML.ABORTED
    assert packml(State.PLACE, Pending.ABORT) is PackML.ABORTING
    assert packml(State.FAULT, Pending.ABORT) is PackML.ABORTED

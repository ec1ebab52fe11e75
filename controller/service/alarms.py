"""Alarms: what went wrong, why, what to do, which came first; kept until they are over and were seen.

Acknowledging says "I have seen it" and changes nothing else. Only the end of the cause, or the operator's reset
of a latched fault, clears an alarm. Terms are those of ISA-18.2.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime

HISTORY = 200
"""Alarms kept, the present ones included."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """One alarm.

    Attributes:
        number: Counts up from 1 in a process.
        code: Name of the fault, e.g. `camera_lost`.
        cause: One line for people.
        remedy: What to do about it.
        first_out: It was the first when nothing else was wrong; those after it may be its consequences.
        raised_at: Date and time.
        cleared_at: When its cause was over or reset, or None.
        acknowledged_at: When somebody said that he has seen it, or None.
    """

    number: int
    code: str
    cause: str
    remedy: str
    first_out: bool
    raised_at: datetime
    cleared_at: datetime | None = None
    acknowledged_at: datetime | None = None

    @property
    def active(self) -> bool:
        """Its cause is still there."""
        return self.cleared_at is None

    @property
    def open(self) -> bool:
        """It wants attention: its cause is there, or nobody has seen it."""
        return self.active or self.acknowledged_at is None

    def to_json(self) -> dict[str, object]:
        """The alarm as the control socket shows it; dates as ISO 8601."""

        def date(at: datetime | None) -> str | None:
            return None if at is None else at.isoformat(timespec="milliseconds")

        return {
            "number": self.number,
            "code": self.code,
            "cause": self.cause,
            "remedy": self.remedy,
            "first_out": self.first_out,
            "active": self.active,
            "raised_at": date(self.raised_at),
            "cleared_at": date(self.cleared_at),
            "acknowledged_at": date(self.acknowledged_at),
        }


class AlarmLog:
    """The present alarms and a bounded history; safe to use from several threads.

    Args:
        capacity: Alarms kept; the oldest that want no attention go first.
        wall: Date and time.
    """

    def __init__(self, capacity: int = HISTORY, wall: Callable[[], datetime] = lambda: datetime.now(UTC)) -> None:
        self._capacity = capacity
        self._wall = wall
        self._lock = threading.Lock()
        self._alarms: list[Alarm] = []
        self._number = 0

    def raise_(self, code: str, cause: str, remedy: str = "") -> Alarm:
        """Raise an alarm; one with this code that is still active is returned instead of a second."""
        with self._lock:
            active = [alarm for alarm in self._alarms if alarm.active]
            for alarm in active:
                if alarm.code == code:
                    return alarm
            self._number += 1
            raised = Alarm(self._number, code, cause, remedy, not active, self._wall())
            self._alarms.append(raised)
            self._forget()
            return raised

    def clear(self, code: str | None = None) -> None:
        """The cause is over, or was reset; of all alarms when no code is given. Nothing is acknowledged by it."""
        with self._lock:
            now = self._wall()
            self._alarms = [
                replace(alarm, cleared_at=now) if alarm.active and code in (None, alarm.code) else alarm
                for alarm in self._alarms
            ]

    def acknowledge(self, number: int | None = None) -> int:
        """Say that an alarm, or every alarm, was seen. Nothing is cleared by it.

        Returns:
            How many were newly acknowledged.
        """
        with self._lock:
            now = self._wall()
            seen = [a for a in self._alarms if a.acknowledged_at is None and number in (None, a.number)]
            numbers = {alarm.number for alarm in seen}
            self._alarms = [
                replace(alarm, acknowledged_at=now) if alarm.number in numbers else alarm for alarm in self._alarms
            ]
            return len(seen)

    def open(self) -> tuple[Alarm, ...]:
        """Alarms that want attention, oldest first."""
        return tuple(alarm for alarm in self.history() if alarm.open)

    def history(self) -> tuple[Alarm, ...]:
        """All that are kept, oldest first."""
        with self._lock:
            return tuple(self._alarms)

    def _forget(self) -> None:
        """Keep to the capacity: first goes what is over and seen, then what is over; never what is active."""
        too_many = len(self._alarms) - self._capacity
        over = sorted((a for a in self._alarms if not a.active), key=lambda alarm: (alarm.open, alarm.number))
        for alarm in over[: max(too_many, 0)]:
            self._alarms.remove(alarm)

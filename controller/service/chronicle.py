"""What the cell did and when, in the ledger: states, holds, faults and operators' commands, for reports to come.

One event is written when what the cell does changes, in words of its own: a table that stays empty for a night, or a
camera that stays away, is one event however often the cycle looks. What the disk does not take at once is kept, and
written with its own time as soon as the disk takes records again.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import Any

from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.domain import PickPlan
from controller.errors import LedgerError, SorterError
from controller.ledger.events import EASED, OPERATOR, STATE, WARNING, Doing
from controller.ledger.sqlite import SqliteLedger
from controller.ports import Clock, Ledger
from controller.service.alarms import AlarmLog
from controller.service.faults import CATALOGUE, fault_code, remedy

_log = logging.getLogger(__name__)

_DAY = 86400.0  # s
_JUMP = 1.0
"""s. A time server steps the date for an eighth of one and more; reports tell times to the second."""
_MOST_KEPT = 1000
"""Events kept while nothing can be written; the oldest go first."""


class Chronicle(Observer):
    """Writes events of the kinds in `controller.ledger.events`.

    Args:
        ledger: Takes the events.
        clock: The cell's.
    """

    def __init__(self, ledger: Ledger, clock: Clock) -> None:
        self._ledger = ledger
        self._clock = clock
        self._lock = threading.Lock()
        self._kept: deque[tuple[str, float, dict[str, Any]]] = deque(maxlen=_MOST_KEPT)
        self._doing = Doing.STOPPED
        self._cause: SorterError | None = None
        self._paused = False

    def commanded(self, command: str, uid: int) -> None:
        """An operator's command was carried out; from any thread.

        Args:
            command: As the control socket calls it.
            uid: User who gave it.
        """
        self._write(OPERATOR, self._clock.now(), command=command, uid=uid)
        if command == "pause" and self._cause is None:
            self._paused = True
            self._change(Doing.PAUSED, self._clock.now())
        elif command == "resume":
            self._paused = False
            if self._doing is Doing.PAUSED:
                self._change(Doing.SORTING, self._clock.now())

    def cleared(self) -> None:
        """The latched fault was reset; from any thread."""
        self._change(Doing.STOPPED, self._clock.now())

    def entered(self, state: State, at: float) -> None:
        """Note a state that means another way to spend the time."""
        if state is State.STOPPED:
            self._cause, self._paused = None, False
            self._change(Doing.STOPPED, at)
        elif self._cause is not None or self._paused or state is State.FAULT:
            return  # told by `held`, `resumed`, `faulted` with the reason, and by the operator
        elif state is State.HELD:
            self._change(Doing.PAUSED, at)
        elif state is State.IDLE:
            self._change(Doing.WAITING, at)
        elif state is State.HOMING or self._doing is Doing.PAUSED:
            self._change(Doing.SORTING, at)

    def attempted(self, plan: PickPlan, attempt: int) -> None:
        """There is something to pick."""
        if not self._paused:
            self._change(Doing.SORTING, self._clock.now())

    def held(self, cause: SorterError, at: float) -> None:
        """Note what the cell holds for."""
        self._cause = cause
        self._change(Doing.HELD, at, cause)

    def resumed(self, at: float) -> None:
        """Note that it is over."""
        self._cause = None
        self._change(Doing.SORTING, at)

    def faulted(self, error: SorterError, at: float) -> None:
        """Note the fault that has latched."""
        self._cause, self._paused = None, False
        self._change(Doing.FAULT, at, error)

    def warned(self, code: str, cause: str, at: float) -> None:
        """Note what is not in order although the cell goes on."""
        self._write(WARNING, at, code=code, cause=cause, remedy=CATALOGUE[code].remedy)

    def eased(self, code: str, at: float) -> None:
        """Note that it is over."""
        self._write(EASED, at, code=code)

    def _change(self, doing: Doing, at: float, cause: SorterError | None = None) -> None:
        if cause is not None:
            self._doing = doing
            told = {"code": fault_code(cause), "cause": cause.cause, "remedy": remedy(cause)}
            self._write(STATE, at, doing=str(doing), **told)
        elif doing is not self._doing:
            self._doing = doing
            self._write(STATE, at, doing=str(doing))

    def _write(self, kind: str, at: float, **details: Any) -> None:
        with self._lock:
            self._kept.append((kind, at, details))
            try:
                while self._kept:
                    kind, at, details = self._kept[0]
                    self._ledger.note(kind, at, **details)
                    self._kept.popleft()
            except LedgerError:
                pass  # the cell holds for it before it moves anything; the rest is written with the next event


class Housekeeper(Observer):
    """Takes old records away once a day, between two states of the cycle.

    Args:
        ledger: The ledger.
        clock: The cell's.
        keep: How long single records are kept.
        most_bytes: How much room they may take.
    """

    def __init__(self, ledger: SqliteLedger, clock: Clock, keep: timedelta, most_bytes: int) -> None:
        self._ledger = ledger
        self._keep = keep
        self._most_bytes = most_bytes
        self._next = clock.now()
        self.entered(State.STOPPED, self._next)

    def entered(self, state: State, at: float) -> None:
        """Clean up if a day has passed."""
        if at >= self._next:
            self._next = at + _DAY
            # A disk that takes no more holds the cell at the next intent, not here.
            with suppress(LedgerError):
                gone = self._ledger.prune(self._keep, self._most_bytes)
                if gone:
                    _log.info("single records of %d targets are now counts by day", gone)


class Calendar(Observer):
    """Puts on record that the computer's date has jumped: dates before and after it do not compare.

    Args:
        ledger: Takes the event.
        wall: Date and time.
        monotonic: s of a clock that nobody sets.
    """

    def __init__(
        self,
        ledger: Ledger,
        wall: Callable[[], datetime] = lambda: datetime.now(UTC),
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._ledger, self._wall, self._monotonic = ledger, wall, monotonic
        self._ahead = wall().timestamp() - monotonic()

    def entered(self, state: State, at: float) -> None:
        """Compare the two clocks."""
        before, self._ahead = self._ahead, self._wall().timestamp() - self._monotonic()
        by = self._ahead - before
        if abs(by) >= _JUMP:
            _log.warning("the computer's date has jumped by %.1f s", by)
            # A disk that takes no more holds the cell at the next intent, not here.
            with suppress(LedgerError):
                self._ledger.note("clock_jumped", at, by_s=round(by, 1))


def tell_what_was_found(ledger: SqliteLedger, alarms: AlarmLog) -> None:
    """Raise alarms for what opening the record has brought to light. They are over, and stay open until seen."""
    if ledger.set_aside is not None:
        cause = f"the record was damaged and a new one begun; the old one is {ledger.set_aside}"
        alarms.raise_("ledger_damaged", cause, CATALOGUE["ledger_damaged"].remedy)
        alarms.clear("ledger_damaged")
    if ledger.indeterminate:
        parts = ", ".join(f"{one.target_id} ({one.label}, for {one.bin})" for one in ledger.indeterminate)
        cause = f"cut off in a pick; the gripper, the table or the bin may have {parts}"
        alarms.raise_("power_lost", cause, CATALOGUE["power_lost"].remedy)
        alarms.clear("power_lost")

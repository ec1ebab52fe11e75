"""A cell that is operated from outside: started, paused, stopped and reset, as often as somebody asks.

The main thread waits here for a start, sorts, and waits again; operators talk to the same object through the
control socket's threads, the service manager through a signal. Nothing but a start, asked for while the cell is
STOPPED, ever begins to move it.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from controller import __version__
from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.domain import Outcome, PickPlan, Result
from controller.errors import DeviceError, SorterError
from controller.service.alarms import Alarm, AlarmLog
from controller.service.controls import Refused, Status
from controller.service.faults import CATALOGUE, fault_code, remedy
from controller.service.packml import PackML, Pending, packml

_BEAT = 1.0  # s between two signs of life while waiting for a start

_REASONS = {
    None: "devices and calibration are being made ready",
    State.STOPPED: "waiting for start",
    State.HOMING: "the arm goes where it is out of the camera's sight",
    State.IDLE: "nothing to pick; the next look comes by itself",
    State.HELD: "somebody has paused",
}


class Work(Protocol):
    """What sorts; `controller.cycle.sorter.Sorter` does."""

    @property
    def fault(self) -> SorterError | None:
        """The first fault, or None."""
        ...

    def run(self) -> None:
        """Sort until stopped or faulted; blocks."""
        ...

    def request_stop(self) -> None:
        """Slow down along the path, park, torque off; from any thread, at once."""
        ...

    def request_pause(self) -> None:
        """Hold on the path of the move under way, else before the next."""
        ...

    @property
    def holds(self) -> bool:
        """A pause is in force and the arm stands; from any thread."""
        ...

    def resume(self) -> None:
        """Go on after a pause."""
        ...


@dataclass(frozen=True, slots=True)
class CellFacts:
    """What a cell says of itself besides its state; see `Status`."""

    mode: str
    config: str
    config_digest: str
    calibration_id: str


class Operation(Observer):
    """The control socket's `Controls`, and an observer of the cycle.

    Args:
        facts: What does not change with the state; `reload` may give it a new value.
        reload: Reads the configuration again and says what has changed.
        emptied: Told that a bin, or (None) every bin, was emptied.
        view_clear: Told that nothing is over the table, whatever the next frame shows.
        cleared: Told that a fault was reset, before anything follows from it.
        recover: Opens the devices again after a fault of theirs was reset; called in the waiting thread, moves
            nothing, may raise any SorterError. None: nothing can be opened again.
        say: Told the state as one line whenever it changes, e.g. the service manager.
        alarms: Where faults are kept.
        now: Monotonic seconds.
    """

    def __init__(
        self,
        facts: CellFacts,
        reload: Callable[[], tuple[str, ...]],
        *,
        emptied: Callable[[str | None], None] = lambda name: None,
        view_clear: Callable[[], None] = lambda: None,
        cleared: Callable[[], None] = lambda: None,
        recover: Callable[[], None] | None = None,
        say: Callable[[str], None] = lambda line: None,
        alarms: AlarmLog | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.facts = facts
        self.alarm_log = alarms or AlarmLog()
        self._reload = reload
        self._emptied = emptied
        self._view_clear = view_clear
        self._cleared = cleared
        self._recover = recover
        self._recovery_due = False
        self._say = say
        self._said = ""
        self._telling = threading.Lock()
        self._now = now
        self._began = self._since = now()
        # Re-entrant: a signal's handler may call `end` in the thread that holds it.
        self._changed = threading.Condition()
        self._state: State | None = None
        self._pending: Pending | None = None
        self._latched: SorterError | None = None
        self._held: SorterError | None = None
        self._work: Work | None = None
        self._started = self._ended = self._may_hold = False
        self._counts: Counter[str] = Counter()

    # --- the main thread ------------------------------------------------------------------------------

    def ready(self, *, fault: SorterError | None = None, may_hold_part: bool = False) -> None:
        """Everything is prepared: STOPPED, or FAULT when something must be looked at first.

        Args:
            fault: What must be reset before the first start, e.g. too many unclean starts, a device that is missing.
            may_hold_part: An earlier run was cut off with a part under way.
        """
        self._may_hold = may_hold_part
        if fault is not None:
            self.faulted(fault, 0.0)
        self._enter(State.STOPPED if fault is None else State.FAULT)

    def wait_for_start(self, beat: Callable[[], None]) -> bool:
        """Wait until somebody starts the cell; False when it is to end instead.

        What a reset asks for is done here meanwhile.

        Args:
            beat: Called at least once a second, for the supervisor.
        """
        while True:
            with self._changed:
                while not self._started and not self._ended and not self._recovery_due:
                    beat()
                    self._changed.wait(_BEAT)
                if self._started or self._ended:
                    return not self._ended
                self._recovery_due = False
            beat()
            self._open_again()

    def sort(self, work: Work) -> None:
        """Sort until stopped or faulted; to be called once for every start. Moves metal."""
        with self._changed:
            cancelled = self._ended or self._pending is not None
            self._work = None if cancelled else work
        try:
            if not cancelled:
                work.run()
        finally:
            with self._changed:
                self._work, self._started, self._pending = None, False, None
                self._held = None
                self._latched = self._latched or work.fault
            self._enter(State.STOPPED if self._latched is None else State.FAULT)

    def end(self) -> None:
        """Stop, and let `wait_for_start` say that it is over; from any thread or a signal's handler."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self.stop()

    # --- controls -------------------------------------------------------------------------------------

    def status(self) -> Status:
        """What the cell is doing."""
        # A signal's handler waits for what is changed here, maybe in a thread that holds the log's own lock.
        alarms = self.alarm_log.open()
        with self._changed:
            cause = self._latched or self._held
            paused = self._pending is Pending.PAUSE
            reason = str(cause) if cause is not None else _REASONS.get(State.HELD if paused else self._state, "sorting")
            return Status(
                packml=self._packml,
                state=self._state,
                reason=reason,
                since_s=self._now() - self._since,
                uptime_s=self._now() - self._began,
                mode=self.facts.mode,
                pid=os.getpid(),
                version=__version__,
                config=self.facts.config,
                config_digest=self.facts.config_digest,
                calibration_id=self.facts.calibration_id,
                counts=dict(self._counts),
                may_hold_part=self._may_hold,
                alarms=alarms,
            )

    @property
    def line(self) -> str:
        """State, count and latched fault in one line."""
        with self._changed:
            line = f"{self._packml}: {self._counts['placed']} placed"
            return line if self._latched is None else f"{line}; {self._latched}"

    def alarms(self) -> tuple[Alarm, ...]:
        """Every alarm that is kept, oldest first."""
        return self.alarm_log.history()

    def start(self, *, view_clear: bool = False) -> None:
        """Sort, from STOPPED.

        Args:
            view_clear: Somebody has looked: what reaches over the table now is to stay there.

        Raises:
            Refused: It is not ready, at work already, ending, or a fault is latched.
        """
        with self._changed:
            if self._latched is not None:
                raise Refused(f"a fault is latched: {self._latched.cause}", "look at the cell, then controller reset")
            if self._state is not State.STOPPED or self._started or self._ended:
                raise Refused(f"not possible in {self._packml}", "start from STOPPED")
            if view_clear:
                self._view_clear()
            self._started = True
            self._changed.notify_all()

    def pause(self) -> None:
        """Hold on the path of the move under way, else before the next; HOLDING until the arm stands, then HELD.

        Raises:
            Refused: Nothing is being sorted.
        """
        with self._changed:
            work = self._working()
            self._pending = Pending.PAUSE
        work.request_pause()
        self._tell()

    def resume(self) -> None:
        """Go on after a pause, or when what the cell holds for was put right.

        Raises:
            Refused: It was not paused and does not hold.
        """
        with self._changed:
            work = self._working()
            if self._pending is not Pending.PAUSE and self._held is None:
                raise Refused("nobody has paused", "controller status says what the cell waits for")
            self._pending = None
        work.resume()
        self._tell()

    def stop(self) -> None:
        """Slow down along the path, park, torque off; returns at once, harmless when stopped."""
        with self._changed:
            work = self._work
            if self._started and self._latched is None:
                self._pending = Pending.STOP
        if work is not None:
            work.request_stop()

    def reset(self) -> None:
        """Clear a latched fault. Moves nothing.

        After a fault of a device the devices are opened again first; the fault is back when they cannot be.

        Raises:
            Refused: No fault is latched, or the arm is still being brought to rest after it.
        """
        with self._changed:
            if self._started:
                raise Refused("the cell is not at rest yet", "wait, or stop it")
            if self._latched is None:
                raise Refused("no fault is latched", "nothing needs to be reset")
            self._recovery_due = self._recover is not None and isinstance(self._latched, DeviceError)
            self._latched = None
            self._may_hold = False
            self._cleared()
            self._changed.notify_all()
        self.alarm_log.clear()
        self._enter(None if self._recovery_due else State.STOPPED)

    def acknowledge(self, number: int | None) -> int:
        """Note that one alarm, or all, were seen; how many were new."""
        return self.alarm_log.acknowledge(number)

    def reload(self) -> tuple[str, ...]:
        """Read the configuration again, for the next cycle; what has changed."""
        return self._reload()

    def emptied(self, name: str | None) -> None:
        """A bin, or (None) every bin, was emptied.

        Raises:
            InputError: There is no such bin.
        """
        self._emptied(name)
        self.alarm_log.clear("bin_full")

    # --- observer -------------------------------------------------------------------------------------

    def entered(self, state: State, at: float) -> None:
        """The cycle entered a state. At rest it is only when `sort` is over: the arm may still be parking."""
        if state not in (State.STOPPED, State.FAULT):
            self._enter(state)

    def attempted(self, plan: PickPlan, attempt: int) -> None:
        """A part may be between the jaws from now on."""
        self._may_hold = True

    def concluded(self, outcome: Outcome) -> None:
        """Count a target."""
        with self._changed:
            self._counts[str(outcome.result)] += 1
        self._may_hold = outcome.result in (Result.INDETERMINATE, Result.ABORTED)

    def held(self, cause: SorterError, at: float) -> None:
        """Raise the alarm of what the cell holds for."""
        with self._changed:
            before, self._held = self._held, cause
        if before is not None and fault_code(before) != fault_code(cause):
            self.alarm_log.clear(fault_code(before))
        self.alarm_log.raise_(fault_code(cause), cause.cause, remedy(cause))

    def resumed(self, at: float) -> None:
        """The alarm of what the cell held for is over."""
        with self._changed:
            cause, self._held = self._held, None
        if cause is not None:
            self.alarm_log.clear(fault_code(cause))

    def faulted(self, error: SorterError, at: float) -> None:
        """Latch the first fault, and raise its alarm."""
        with self._changed:
            self._latched = self._latched or error
            self._pending = Pending.ABORT if self._started else None
            at_rest = self._state is not None and not self._started
        self.alarm_log.raise_(fault_code(error), error.cause, remedy(error))
        if at_rest:
            self._enter(State.FAULT)

    def warned(self, code: str, cause: str, at: float) -> None:
        """Raise the alarm of what is not in order; the cell goes on."""
        self.alarm_log.raise_(code, cause, CATALOGUE[code].remedy)

    def eased(self, code: str, at: float) -> None:
        """Its alarm is over."""
        self.alarm_log.clear(code)

    # --- inside ---------------------------------------------------------------------------------------

    @property
    def _packml(self) -> PackML:
        held = self._pending is Pending.PAUSE and self._work is not None and self._work.holds
        return packml(self._state, Pending.PAUSED if held else self._pending)

    def _working(self) -> Work:
        if self._work is None or self._pending in (Pending.STOP, Pending.ABORT):
            raise Refused(f"not possible in {self._packml}", "the cell must be at work")
        return self._work

    def _open_again(self) -> None:
        assert self._recover is not None
        try:
            self._recover()
        except SorterError as error:
            self.faulted(error, 0.0)
            self._enter(State.FAULT)
        else:
            self._enter(State.STOPPED)

    def _tell(self) -> None:
        """Say the state when it is another than was said last: a cycle has many that are one to the outside."""
        with self._telling:
            line = self.line
            if line != self._said:
                self._said = line
                self._say(line)

    def _enter(self, state: State | None) -> None:
        with self._changed:
            self._state, self._since = state, self._now()
        self._tell()

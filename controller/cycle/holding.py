"""Holding: the cell stands still for a cause that may pass, tries again at growing intervals, and goes on.

What holds the cell is not a fault yet: the camera is away or shows nothing usable, the record cannot be written,
the jaws do not let go. Torque stays on, and nothing moves.
"""

from __future__ import annotations

import math

from controller.cycle.looking import Looker
from controller.cycle.outcomes import Outcomes
from controller.cycle.requests import Requests
from controller.cycle.rig import Rig
from controller.errors import CameraError, Intruder, LedgerError, PartHeld, SorterError

FIRST_PAUSE = 0.5
"""s before the first new try; doubled after every one that fails."""

LONGEST_PAUSE = 10.0
"""s between tries in the end: a camera plugged in again is found while its user still looks."""

PATIENCE = 60.0
"""s that a run which nobody operates holds before it gives up; an operated cell holds for as long as it takes."""

SLICE = 0.05
"""s between looks at whether somebody has asked for a stop, or to go on."""

GLANCE = 0.25
"""s between looks at whether what was over the table is gone."""

RELEASES = 3
"""How often the jaws are opened over a bin before a part is taken to stick to them."""


class Hold:
    """One hold, from the first failure until what failed has worked again.

    Args:
        cause: What failed.
        now: s of the cell's clock.

    Attributes:
        cause: What failed last.
        intruder: What was over the table when it was looked at last, or None: nothing, or that is not why it holds.
        since: When it began, s of the cell's clock.
        next_try: When to try again, s of the cell's clock.
        clear_since: Since when nothing of it is to be seen any more, s of the cell's clock; infinite while it is.
    """

    def __init__(self, cause: SorterError, now: float) -> None:
        self.cause = cause
        self.intruder: Intruder | None = None
        self.since = now
        self.next_try = now
        self.clear_since = math.inf
        self._pause = FIRST_PAUSE

    def is_for(self, cause: SorterError) -> bool:
        """Whether it is the same that has failed, not yet another thing."""
        return (type(cause), getattr(cause, "code", "")) == (type(self.cause), getattr(self.cause, "code", ""))

    def failed(self, cause: SorterError, now: float) -> None:
        """A try has failed: the next comes later."""
        self.cause = cause
        self.clear_since = math.inf
        if isinstance(cause, Intruder):
            self.intruder = cause
            self.next_try = now + GLANCE
            return
        self.next_try = now + self._pause
        self._pause = min(2.0 * self._pause, LONGEST_PAUSE)

    def clear(self, intruder: Intruder, now: float) -> None:
        """The camera shows that what was over the table is not there now."""
        self.cause = intruder
        self.clear_since = min(self.clear_since, now)

    @property
    def too_long(self) -> bool:
        """Nobody waits any longer where nobody operates the cell."""
        return self.next_try - self.since > PATIENCE


class Holding:
    """Holds the cell of a rig, and says when it goes on.

    Args:
        rig: The cell.
        requests: What is asked for from outside.
        outcomes: What could not be put on record is written when it can be.
        operated: Somebody looks after the cell: it holds for as long as it takes.
    """

    def __init__(self, rig: Rig, requests: Requests, outcomes: Outcomes, *, operated: bool) -> None:
        self._rig, self._requests, self._outcomes = rig, requests, outcomes
        self._operated = operated
        self._hold: Hold | None = None

    def adopt(self, rig: Rig) -> None:
        """Take over a rig with the same devices and observers."""
        self._rig = rig

    def failed(self, cause: SorterError) -> None:
        """Hold, or go on holding, for a cause that may pass.

        Raises:
            SorterError: The cause itself, when nobody operates the cell and it has lasted too long.
        """
        now = self._rig.clock.now()
        known = self._hold is not None and self._hold.is_for(cause)
        self._hold = self._hold or Hold(cause, now)
        self._hold.failed(cause, now)
        self._requests.must_be_told()
        if not known:
            for observer in self._rig.observers:
                observer.held(cause, now)
        self._check_patience(self._hold)

    def step(self, looker: Looker) -> str:
        """Wait a little, or try again; the trigger of what follows, "held_on" while nothing does.

        Args:
            looker: Looks whether the view is clear.

        Raises:
            SorterError: The cause, still there or for too long; or what failed in trying.
        """
        hold, rig = self._hold, self._rig
        if hold is not None and isinstance(hold.cause, PartHeld):
            # Nothing opens the jaws again before somebody who has looked says so.
            return "rehomed" if self._may_go_on() else self._wait_on(hold, SLICE)
        if self._requests.paused or (hold is not None and rig.clock.now() < hold.next_try):
            rig.clock.sleep(SLICE)
            return "held_on"
        if hold is not None and isinstance(hold.cause, CameraError):
            rig.camera.close()
            rig.camera.open()
        if hold is not None and hold.intruder is not None:
            # What was seen may still be there, though the camera has been away since.
            return self._wait_for_clear_view(hold, hold.intruder, looker)
        if hold is not None and isinstance(hold.cause, LedgerError):
            self._outcomes.write()
            rig.ledger.note("resumed", rig.clock.now(), held_s=rig.clock.now() - hold.since)
        return "resumed"

    def overcome(self, kind: type[SorterError]) -> None:
        """What the cell held for works again."""
        if self._hold is not None and isinstance(self._hold.cause, kind):
            self._hold = None
            for observer in self._rig.observers:
                observer.resumed(self._rig.clock.now())

    def _wait_for_clear_view(self, hold: Hold, intruder: Intruder, looker: Looker) -> str:
        """Nothing moves before the table is clear, and somebody says so or the configuration allows to go on."""
        clock, patience = self._rig.clock, self._rig.config.cycle.resume_when_clear_s
        looker.check(looker.capture(clock.now()))
        hold.clear(intruder, clock.now())
        if self._may_go_on() or (patience > 0.0 and clock.now() - hold.clear_since >= patience):
            self.overcome(Intruder)
            return "resumed"
        return self._wait_on(hold, GLANCE)

    def _may_go_on(self) -> bool:
        if not self._requests.may_go_on:
            return False
        self._requests.must_be_told()
        return True

    def _wait_on(self, hold: Hold, seconds: float) -> str:
        hold.next_try = self._rig.clock.now()
        self._check_patience(hold)
        self._rig.clock.sleep(seconds)
        return "held_on"

    def _check_patience(self, hold: Hold) -> None:
        if not self._operated and hold.too_long:
            raise hold.cause

"""Holding: the cell stands still for a cause that may pass, tries again at growing intervals, and goes on.

What holds the cell is not a fault yet: the camera is away or shows nothing usable, the record cannot be written,
the jaws do not let go. Torque stays on, and nothing moves.
"""

from __future__ import annotations

import math

from controller.errors import Intruder, SorterError

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
        since: When it began, s of the cell's clock.
        next_try: When to try again, s of the cell's clock.
        clear_since: Since when nothing of it is to be seen any more, s of the cell's clock; infinite while it is.
    """

    def __init__(self, cause: SorterError, now: float) -> None:
        self.cause = cause
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
            self.next_try = now + GLANCE
            return
        self.next_try = now + self._pause
        self._pause = min(2.0 * self._pause, LONGEST_PAUSE)

    def clear(self, now: float) -> None:
        """Nothing of the cause is to be seen now."""
        self.clear_since = min(self.clear_since, now)

    @property
    def too_long(self) -> bool:
        """Nobody waits any longer where nobody operates the cell."""
        return self.next_try - self.since > PATIENCE

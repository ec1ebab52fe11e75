"""The clock of a real cell: it only reads the time, nobody can wind it."""

from __future__ import annotations

import time


class MonotonicClock:
    """Seconds of the system's monotonic clock, which no change of date or time zone moves."""

    def now(self) -> float:
        """Seconds since an arbitrary start, on Linux that of V4L2's buffer time stamps (CLOCK_MONOTONIC)."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Block for `seconds`; returns at once for zero or less."""
        if seconds > 0.0:
            time.sleep(seconds)

    def charge(self, seconds: float) -> None:
        """Do nothing: computing has already taken its real time."""

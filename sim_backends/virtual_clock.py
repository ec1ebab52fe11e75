"""A clock that only its users advance: replays and tests take no real time and come out the same twice."""

from __future__ import annotations

import threading


class VirtualClock:
    """Time passes by `sleep` and `charge`, and by nothing else. Safe to use from several threads.

    Args:
        start: First reading, s.
    """

    def __init__(self, start: float = 0.0) -> None:
        self._now = start
        self._lock = threading.Lock()

    def now(self) -> float:
        """Seconds slept and charged since the start."""
        with self._lock:
            return self._now

    def sleep(self, seconds: float) -> None:
        """Advance by `seconds` at once; zero or less leaves the time as it is."""
        if seconds > 0.0:
            with self._lock:
                self._now += seconds

    def charge(self, seconds: float) -> None:
        """Advance by the time a computation is taken to need, s."""
        self.sleep(seconds)

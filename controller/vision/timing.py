"""A stopwatch for the stages of one detection."""

from __future__ import annotations

import time


class Stopwatch:
    """Milliseconds spent in each named stage since the last lap."""

    def __init__(self) -> None:
        self._start = self._last = time.perf_counter()
        self._laps: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        """Book the time since the last lap to `stage`."""
        now = time.perf_counter()
        self._laps[stage] = self._laps.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now

    def result(self) -> dict[str, float]:
        """All stages, and `total`."""
        return {"total": 1e3 * (time.perf_counter() - self._start), **self._laps}

"""A thread that does one job after another, and says so when it has no room for more."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

_log = logging.getLogger(__name__)


class Worker:
    """Does jobs in a thread of its own, in the order they came.

    Args:
        name: Of the thread.
        waiting: How many jobs may wait for the one that is being done.
    """

    def __init__(self, name: str, waiting: int) -> None:
        self._room = waiting
        self._jobs: deque[tuple[Callable[[], None], Callable[[], None]]] = deque()
        self._busy = False
        self._ended = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def offer(self, job: Callable[[], None], then: Callable[[], None]) -> bool:
        """Hand a job over; False when there is no room, or the worker has ended.

        Args:
            job: Done in the worker's thread.
            then: Called there after it, when there is room for the next.
        """
        with self._changed:
            if self._ended or len(self._jobs) + self._busy > self._room:
                return False
            self._jobs.append((job, then))
            self._changed.notify()
            return True

    def close(self, patience: float) -> None:
        """Begin no further job, and wait up to `patience` s for the end of the present one."""
        with self._changed:
            self._ended = True
            self._jobs.clear()
            self._changed.notify()
        self._thread.join(patience)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._ended)
                if self._ended:
                    return
                job, then = self._jobs.popleft()
                self._busy = True
            try:
                job()
            except Exception:  # a mistake in one job must not keep the next from being done
                _log.exception("%s: a job failed", self._thread.name)
            with self._changed:
                self._busy = False
            then()

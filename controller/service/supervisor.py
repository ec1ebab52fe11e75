"""The supervisor: it tells the service manager that all is well only while every loop moves.

A process that still runs proves nothing. Each loop counts its progress here; once a loop stands still, or the
whole process does, the reassurance stops, and the service manager ends the process and starts it again (STOPPED).
Real time, in simulation too: it is the computer that is watched, not the cell.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
import traceback
from collections.abc import Callable
from types import TracebackType

from controller.ports import Clock

_log = logging.getLogger(__name__)

STANDALONE_PERIOD = 5.0
"""s between looks at the loops when no service manager asks: hung loops are still logged, with their stacks."""


class Loop:
    """One loop's counter of progress; the loop alone calls it.

    Args:
        name: For messages.
        patience: s that one step of the loop may take; 0 for no more than the time between two looks.
    """

    def __init__(self, name: str, patience: float = 0.0) -> None:
        self.name = name
        self.patience = patience
        self.count = 0
        self.waiting = False
        self.thread = 0

    def progress(self) -> None:
        """A step was made."""
        self.count += 1
        self.waiting = False
        self.thread = threading.get_ident()

    def idle(self) -> None:
        """Nothing to do until further notice: standing still is no fault until the next `progress`."""
        self.waiting = True


class Supervisor:
    """Watches loops and reassures the service manager, from a thread of its own; a context manager.

    Args:
        pet: Says to the service manager that all is well.
        watchdog: s within which the manager wants to hear that; None when it does not watch. Twice within it the
            loops are looked at (sd_watchdog_enabled(3) advises half of the interval).
        on_hang: Told the names of the loops that stand still, once each time they change.
        now: Monotonic seconds.
    """

    def __init__(
        self,
        pet: Callable[[], None],
        watchdog: float | None,
        *,
        on_hang: Callable[[tuple[str, ...]], None] = lambda names: None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.period = STANDALONE_PERIOD if watchdog is None else watchdog / 2.0
        self._pet = pet
        self._on_hang = on_hang
        self._now = now
        self._lock = threading.Lock()
        self._loops: dict[Loop, tuple[int, float]] = {}
        self._hung: tuple[str, ...] = ()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def register(self, name: str, patience: float = 0.0) -> Loop:
        """Watch a loop from now on.

        Args:
            name: For messages.
            patience: s that one step may take, e.g. the longest wait for a frame.
        """
        loop = Loop(name, patience)
        with self._lock:
            # One less than its count: it counts as moved at the next look, whenever that comes.
            self._loops[loop] = (loop.count - 1, self._now())
        return loop

    def forget(self, loop: Loop) -> None:
        """Watch a loop no longer; harmless when it is not watched."""
        with self._lock:
            self._loops.pop(loop, None)

    def check(self) -> tuple[str, ...]:
        """Look at every loop once; reassure the manager when all have moved since the last look.

        Returns:
            Names of the loops that stand still.
        """
        now = self._now()
        hung: list[Loop] = []
        with self._lock:
            for loop, (seen, moved_at) in self._loops.items():
                count = loop.count
                if count != seen or loop.waiting:
                    self._loops[loop] = (count, now)
                elif now - moved_at > loop.patience:
                    hung.append(loop)
        names = tuple(loop.name for loop in hung)
        if names != self._hung:
            self._hung = names
            for loop in hung:
                _log.error("the loop %s stands still\n%s", loop.name, _stack(loop.thread))
            self._on_hang(names)
        if not names:
            self._pet()
        return names

    def start(self) -> None:
        """Begin to watch."""
        self._thread = threading.Thread(target=self._watch, name="supervisor", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Watch no longer; harmless when not started."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def __enter__(self) -> Supervisor:
        """Begin to watch."""
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Watch no longer."""
        self.close()

    def _watch(self) -> None:
        while not self._ended.wait(self.period):
            self.check()


class WatchedClock:
    """A clock whose every sleep is a loop's progress: a long move is made of many, a hung one of none.

    Args:
        clock: The cell's clock.
        loop: The loop that sleeps on it.
    """

    def __init__(self, clock: Clock, loop: Loop) -> None:
        self._clock = clock
        self._loop = loop

    def now(self) -> float:
        """Seconds since an arbitrary start; never goes back."""
        return self._clock.now()

    def sleep(self, seconds: float) -> None:
        """Return not before `seconds` have passed on this clock."""
        self._loop.progress()
        self._clock.sleep(seconds)

    def charge(self, seconds: float) -> None:
        """Account for computing that took real time."""
        self._loop.progress()
        self._clock.charge(seconds)


def _stack(thread: int) -> str:
    """Where a thread is now, for the log."""
    frame = sys._current_frames().get(thread)
    return "".join(traceback.format_stack(frame)) if frame is not None else "its thread has ended or never ran"

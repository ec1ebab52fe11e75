"""Watches the table while the arm is over it: what reaches over it meanwhile stops the arm on its path.

Between two looks the camera still runs. What it shows on the way costs the cycle no time: it is compared where it
comes from, and the arm is told to stand by whoever sees the hand first.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from controller.cycle.guard import Guard, Hidden
from controller.cycle.requests import Interrupted, Requests
from controller.domain import Frame
from controller.errors import Intruder
from controller.ports import Camera, GlanceSource


class Sentry:
    """Stops the arm of a cell for what its camera shows on the way.

    Args:
        camera: The cell's; one that gives no glances is not watched through.
        guard: Knows what a hand over the table looks like.
        requests: Tells the arm.
    """

    def __init__(self, camera: Camera, guard: Guard, requests: Requests) -> None:
        self._camera, self._guard, self._requests = camera, guard, requests
        self._lock = threading.Lock()
        self._on_duty = False
        self._alarms: list[Intruder] = []

    @contextmanager
    def on_duty(self, hidden: Hidden) -> Iterator[None]:
        """Watch for as long as this lasts.

        Args:
            hidden: Tells what the arm hides meanwhile.

        Raises:
            Intruder: Something reaches over the table. The arm stands where that was seen, and may be moved again.
        """
        if not isinstance(self._camera, GlanceSource):
            yield
            return
        self._on_duty, self._alarms = True, []
        self._camera.glance(lambda glance: self._look(glance, hidden))
        try:
            yield
        except Interrupted:
            if not self._alarms:
                raise
        finally:
            self._camera.glance(None)
            with self._lock:
                self._on_duty = False
        if self._alarms:
            self._requests.end_halt()
            raise self._alarms[0]

    def _look(self, glance: Frame, hidden: Hidden) -> None:
        """Judge a glance, in the thread of the camera."""
        try:
            self._guard.check_glance(glance, hidden)
        except Intruder as alarm:
            with self._lock:
                if self._on_duty:
                    self._alarms.append(alarm)
                    self._requests.halt()

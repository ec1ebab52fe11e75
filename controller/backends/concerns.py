"""What camera and servo bus say is not in order and no reason to stop yet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from controller.ports import Camera
from controller.vision.watch import WatchedCamera

if TYPE_CHECKING:
    from drivers.arm.replies import BusStatistics

_ENOUGH_ANSWERS, _MOST_FAILED = 500, 0.01
"""Answers of servos from which a share is told, and the share that failed from which somebody should look: a sound
line loses one of ten thousand.
"""


class Concerns:
    """What camera and servo bus say is not in order, asked once a look."""

    def __init__(self, camera: Camera, bus: BusStatistics) -> None:
        self._camera = camera
        self._bus = bus
        self._answered = self._failed = 0
        self._share = 0.0

    def __call__(self) -> Mapping[str, str]:
        """Causes in words by code of the fault catalogue."""
        found = dict(self._camera.concerns) if isinstance(self._camera, WatchedCamera) else {}
        answered, failed = self._bus.replies, self._bus.timeouts
        total = answered + failed - self._answered - self._failed
        if total >= _ENOUGH_ANSWERS:
            self._share = (failed - self._failed) / total
            self._answered, self._failed = answered, failed
        if self._share > _MOST_FAILED:
            found["bus_noisy"] = f"{self._share:.1%} of the servos' answers were lost or damaged"
        return found

"""What camera and servo bus say is not in order and no reason to stop yet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from controller.ports import Camera
from controller.vision.watch import MOST_TORN, WatchedCamera

if TYPE_CHECKING:
    from drivers.arm.replies import BusStatistics

_ENOUGH_ANSWERS, _MOST_FAILED = 500, 0.01
"""Answers of servos from which a share is told, and the share that failed from which somebody should look: a sound
line loses one of ten thousand.
"""
_ENOUGH_FRAMES = 100
"""Frames of the driver from which a share is told; as many as the pictures that are judged by what they show."""


class DecodedFrames(Protocol):
    """What a driver counts of the frames it was to decode."""

    good_frames: int
    bad_frames: int


class _Share:
    """The share of what fails, told anew from every so many."""

    def __init__(self, enough: int) -> None:
        self._enough = enough
        self._good = self._bad = 0
        self._share = 0.0

    def of(self, good: int, bad: int) -> float:
        """The share, by the counts so far."""
        total = good + bad - self._good - self._bad
        if total >= self._enough:
            self._share = (bad - self._bad) / total
            self._good, self._bad = good, bad
        return self._share


class Concerns:
    """What camera and servo bus say, asked once a look.

    Args:
        camera: The cell's.
        bus: What its servo bus counts.
        frames: What its camera's driver counts; None: nothing.
    """

    def __init__(self, camera: Camera, bus: BusStatistics, frames: DecodedFrames | None = None) -> None:
        self._camera, self._bus, self._frames = camera, bus, frames
        self._failed, self._damaged = _Share(_ENOUGH_ANSWERS), _Share(_ENOUGH_FRAMES)

    def __call__(self) -> Mapping[str, str]:
        """Causes in words by code of the fault catalogue."""
        found = dict(self._camera.concerns) if isinstance(self._camera, WatchedCamera) else {}
        if self._frames is not None:
            damaged = self._damaged.of(self._frames.good_frames, self._frames.bad_frames)
            if damaged > MOST_TORN:
                found.setdefault("pictures_damaged", f"{damaged:.0%} of the camera's frames cannot be decoded")
        failed = self._failed.of(self._bus.replies, self._bus.timeouts)
        if failed > _MOST_FAILED:
            found["bus_noisy"] = f"{failed:.1%} of the servos' answers were lost or damaged"
        return found

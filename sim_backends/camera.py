"""The simulated camera behind the `Camera` port: exposes on its own beat, delivers late, sees the true world."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from controller.domain import Frame
from controller.errors import CameraLost, FrameStale
from controller.ports import GLANCE_PERIOD
from sim_backends.painter import Image
from sim_backends.world import TICK, Snapshot, World

PERIOD = 1.0 / 30.0  # s between exposures
EXPOSURE = 0.008  # s
_NAME = "simulated camera"
_KEPT = 12
"""Exposures that are kept: the latency of the slowest camera, several times."""
_NO_TIME = 1e-9
"""What rounding leaves of a deadline that has passed, s: waiting for it would let no time pass."""


class SimulatedCamera:
    """Runs freely, as cameras do: it exposes on its own beat whether or not anybody wants a frame, and paints
    those that are asked for. Waiting for a frame lets the world move on.

    Args:
        world: Owner of time and motion; gets this camera on its tick.
        paint: Makes the picture of a snapshot.
        sketch: Makes a glance of it.
        latency: From the end of the exposure to the delivery of the frame, s.
    """

    def __init__(
        self,
        world: World,
        paint: Callable[[Snapshot], Image],
        sketch: Callable[[Snapshot], Image],
        latency: float,
    ) -> None:
        self._world = world
        self._paint, self._sketch = paint, sketch
        self._latency = latency
        self._open = False
        self._count = 0
        self._next = 0.0
        self._given = -1.0
        self._exposed: deque[Snapshot] = deque(maxlen=_KEPT)
        self._listener: Callable[[Frame], None] | None = None
        self._glanced = self._shown = -1.0

    def open(self) -> None:
        """Make frames available."""
        self._open = True
        self._next = self._world.now()
        self._world.on_tick = self._tick

    def close(self) -> None:
        """Release the camera; harmless when it is not open."""
        self._open = False
        self._exposed.clear()
        self._world.on_tick = None

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        """The newest frame whose exposure began at or after `after`; lets simulated time pass until there is one.

        Raises:
            CameraLost: It is not open.
            FrameStale: None is delivered within `timeout` s of simulated time.
        """
        if not self._open:
            raise CameraLost(_NAME, "capture", "it is not open")
        deadline = self._world.now() + timeout
        while (shot := self._delivered(after)) is None:
            missing = deadline - self._world.now()
            if missing < _NO_TIME:
                raise FrameStale(_NAME, "capture", f"no frame within {timeout:g} s")
            self._world.advance(min(TICK, missing))
        self._given = shot.at
        image = self._paint(shot)
        image.flags.writeable = False
        self._count += 1
        return Frame(self._count, shot.at + EXPOSURE / 2.0, image, _NAME)

    def glance(self, listener: Callable[[Frame], None] | None) -> None:
        """Have glances told as they are delivered from now on, within the world's time; None: no longer."""
        self._listener = listener

    def _delivered(self, after: float) -> Snapshot | None:
        """The newest exposure begun at or after `after` that has arrived and was not given out before."""
        shot = self._arrived()
        fresh = shot is not None and shot.at - EXPOSURE / 2.0 >= after - 1e-9 and shot.at > self._given
        return shot if fresh else None

    def _arrived(self) -> Snapshot | None:
        """The newest exposure that has arrived."""
        latest = self._world.now() - EXPOSURE / 2.0 - self._latency + 1e-9
        return next((shot for shot in reversed(self._exposed) if shot.at <= latest), None)

    def _tick(self) -> None:
        """The middle of an exposure, when one is due: the world as it is now."""
        now = self._world.now()
        if now + 1e-9 >= self._next:
            self._next += PERIOD
            self._exposed.append(self._world.snapshot())
            self._world.remember()
        if self._listener is not None and now >= self._glanced + GLANCE_PERIOD - 1e-9:
            self._show(self._listener)

    def _show(self, listener: Callable[[Frame], None]) -> None:
        """Tell the newest exposure that has arrived, unless it was told before."""
        shot = self._arrived()
        if shot is not None and shot.at > self._shown:
            self._glanced, self._shown = self._world.now(), shot.at
            listener(Frame(self._count, shot.at + EXPOSURE / 2.0, self._sketch(shot), _NAME))

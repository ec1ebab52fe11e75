"""The simulated camera behind the `Camera` port: exposes on its own beat, delivers late, sees the true world."""

from __future__ import annotations

import math
from collections.abc import Callable

from controller.domain import Frame
from controller.errors import CameraLost, FrameStale
from sim_backends.painter import Image
from sim_backends.world import Snapshot, World
from sim_backends.world_model import STEP

PERIOD = 1.0 / 30.0  # s between exposures
EXPOSURE = 0.008  # s
_NAME = "simulated camera"


class SimulatedCamera:
    """Paints the world as it was in the middle of an exposure; waiting for a frame lets the world move on.

    Args:
        world: Owner of time and motion.
        paint: Makes the picture of a snapshot.
        latency: From the end of the exposure to the delivery of the frame, s.
    """

    def __init__(self, world: World, paint: Callable[[Snapshot], Image], latency: float) -> None:
        self._world = world
        self._paint = paint
        self._latency = latency
        self._open = False
        self._count = 0

    def open(self) -> None:
        """Make frames available."""
        self._open = True

    def close(self) -> None:
        """Release the camera; harmless when it is not open."""
        self._open = False

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        """The first frame whose exposure begins at or after `after` and not before now; advances simulated time.

        Raises:
            CameraLost: It is not open.
            FrameStale: The frame would not arrive within `timeout` s of simulated time.
        """
        if not self._open:
            raise CameraLost(_NAME, "capture", "it is not open")
        world, now = self._world, self._world.now()
        begin = math.ceil(max(after, now) / PERIOD - 1e-9) * PERIOD
        if begin + EXPOSURE + self._latency > now + timeout:
            world.advance(timeout)
            raise FrameStale(_NAME, "capture", f"no frame within {timeout:g} s")
        self._advance_to(begin + EXPOSURE / 2.0)
        snapshot = world.snapshot()
        world.remember()
        self._advance_to(begin + EXPOSURE)
        ended = world.now()
        self._advance_to(ended + self._latency)
        image = self._paint(snapshot)
        image.flags.writeable = False
        self._count += 1
        return Frame(self._count, ended, image, _NAME)

    def _advance_to(self, at: float) -> None:
        """The world moves in whole steps: not before `at`, and less than a step after it."""
        missing = at - self._world.now()
        if missing > 0.0:
            self._world.advance(math.ceil(missing / STEP - 1e-9) * STEP)

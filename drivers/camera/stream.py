"""One opened camera: format agreed, settings locked, every frame with the time it was taken. No threads here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.errors import CameraError, CameraLost
from controller.ports import Clock
from drivers.camera.capture import Capture
from drivers.camera.settings import lock

# s for exposure, white balance and focus to settle before they are locked; low light slows the frames down.
SETTLE = 1.5
# A time stamp further from now than this is of another clock (the date, say), not of a late frame.
_SAME_CLOCK = 10.0
# The device's rate may be an odd fraction (29.97); less than this part of the wanted rate is another rate.
_RATE = 0.9
# Taking a frame that had to be waited for lasts longer than this part of a period.
_WAITED = 0.1
_MJPG = float(cv2.VideoWriter.fourcc(*"MJPG"))


@dataclass(frozen=True, slots=True)
class Exposure:
    """The bounds of one exposure, s of the cell's clock.

    Attributes:
        began: It began at this time or later.
        ended: When the frame was complete.
    """

    began: float
    ended: float


class Stream:
    """A capture made ready. Not thread-safe: OpenCV's capture is not.

    Args:
        capture: Freshly opened; released by `close`, and here when making it ready fails.
        device: For messages.
        clock: The cell's clock.
        size: Wanted (width, height), px.
        fps: Wanted rate, 1/s.
        settings: Wanted settings by name.

    Attributes:
        settings_in_force: What the device says of every setting it has.
        refused: What was asked for and is not in force.
        fps: Rate the device says it runs at.
        bad_frames: Frames dropped because they were damaged, of another size or out of order.

    Raises:
        CameraLost: It gives no frames.
        CameraError: It gives frames of another size.
    """

    def __init__(
        self,
        capture: Capture,
        device: str,
        clock: Clock,
        *,
        size: tuple[int, int],
        fps: float,
        settings: Mapping[str, float],
    ) -> None:
        self._capture = capture
        self._device = device
        self._clock = clock
        self._size = size
        self._stamped: bool | None = None
        self._last_ended = -np.inf
        self.bad_frames = 0
        try:
            self.fps = self._agree(fps)
            self._settle(settings)
        except BaseException:
            capture.release()
            raise

    def close(self) -> None:
        """Let go of the device."""
        self._capture.release()

    def grab(self) -> Exposure | None:
        """Take the next frame without decoding it; blocks for it. None when its time cannot be told.

        Raises:
            CameraLost: The device gives no more frames.
        """
        asked = self._clock.now()
        if not self._capture.grab():
            raise CameraLost(self._device, "grab", "no frame came", "check the cable and the USB hub")
        ended = self._ended(asked, self._clock.now())
        if ended is None:
            self.bad_frames += 1
            return None
        self._last_ended = ended
        return Exposure(ended - self._longest_shot, ended)

    def image(self) -> NDArray[np.uint8] | None:
        """The frame taken last, shape (H, W, 3), dtype uint8, BGR, read-only; None when it is damaged."""
        image = self._decode()
        if image is None or image.dtype != np.uint8 or image.shape != (self._size[1], self._size[0], 3):
            self.bad_frames += 1
            return None
        image.setflags(write=False)
        return np.asarray(image)

    def _decode(self) -> Any:
        """What the device gave last, whatever it is; None when it cannot be decoded."""
        try:
            ok, image = self._capture.retrieve()
        except cv2.error:
            return None
        return image if ok else None

    # --- making it ready ------------------------------------------------------------------------------

    def _agree(self, fps: float) -> float:
        """Agree on size and rate; compressed frames only where plain ones are too slow."""
        got = self._ask(fps)
        if 0.0 < got < _RATE * fps:
            self._capture.set(cv2.CAP_PROP_FOURCC, _MJPG)
            got = self._ask(fps)
        return got if got > 0.0 else fps

    def _ask(self, fps: float) -> float:
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._size[0])
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size[1])
        self._capture.set(cv2.CAP_PROP_FPS, fps)
        return self._capture.get(cv2.CAP_PROP_FPS)

    def _settle(self, settings: Mapping[str, float]) -> None:
        """Let what is automatic settle, lock it, and see the first frame of the wanted size."""
        period = 1.0 / self.fps
        # What a time stamp can mean, start or end of the frame, and the exposure before it: two periods at most,
        # or one and the exposure where that is known to be longer.
        self._longest_shot = 2.0 * period
        began = self._clock.now()
        for _ in range(max(1, round(SETTLE * self.fps))):
            if not self._capture.grab():
                raise CameraLost(
                    self._device, "open", "it opens but gives no frames", "unplug it and plug it in again"
                )
            if self._clock.now() - began >= SETTLE:
                break
        image = self._decode()
        if image is None:
            raise CameraLost(self._device, "open", "its frames cannot be decoded", "check the cable and the USB hub")
        width, height = image.shape[1], image.shape[0]
        if (width, height) != self._size:
            raise CameraError(
                self._device,
                "open",
                f"it gives {width}x{height} pixels, not {self._size[0]}x{self._size[1]}",
                "configure a size the camera has; `v4l2-ctl --list-formats-ext` lists them",
            )
        self.settings_in_force, self.refused = lock(self._capture, settings)
        exposure = self.settings_in_force.get("exposure", 0.0) * 1e-4
        self._longest_shot = period + max(period, exposure)

    # --- time -----------------------------------------------------------------------------------------

    def _ended(self, asked: float, now: float) -> float | None:
        """When the frame just read was complete; None when its stamp cannot be."""
        stamp = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        if self._stamped is None:
            # V4L2 stamps buffers with CLOCK_MONOTONIC, as the cell's clock; some drivers do not stamp at all.
            self._stamped = stamp > 0.0 and abs(now - stamp) < _SAME_CLOCK
        if self._stamped:
            return stamp if self._last_ended < stamp <= now + 1.0 / self.fps else None
        if now - asked >= _WAITED / self.fps or not np.isfinite(self._last_ended):
            return now
        # It lay ready: nobody knows for how long, but it came after the one before.
        return min(now, self._last_ended + 1.0 / self.fps)


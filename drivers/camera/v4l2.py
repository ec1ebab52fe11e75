"""A USB camera on Linux: always the newest frame, never an old one, and back by itself after a loss.

A thread takes every frame off the device as it comes, so that none grows old in a queue, but decodes only the
one that is asked for: a cell that waits costs next to nothing.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Frame
from controller.errors import CameraError, CameraLost, FrameStale
from controller.ports import GLANCE_PERIOD, GLANCE_SCALE, Clock
from drivers.camera.capture import Capture, open_capture
from drivers.camera.settings import Refused, check_names
from drivers.camera.stream import Stream

# s: first and longest pause before a lost camera is opened again.
_BACK_OFF = (0.5, 10.0)
# s: how often a pause looks whether the camera shall be closed.
_SLICE = 0.05
# s: OpenCV's wait for a frame is one second, so that the reader has ended well before this.
_JOIN = 5.0


@dataclass(slots=True)
class _Request:
    """Someone waits for a frame whose exposure began at `after` or later."""

    after: float
    frame: Frame | None = None


class V4l2Camera:
    """A video device read by a thread of its own.

    Args:
        device: Path of the video device, best a link below /dev/v4l/by-id.
        clock: The cell's clock; on a real cell the system's monotonic one, which V4L2 stamps frames with.
        size: (width, height), px.
        fps: Frames per second.
        settings: Settings by their names in V4L2; what is automatic and not set is locked where it has settled.
        frame_age_limit: A frame older than this is never given out, s.
        capture: Opens the device; a test hands in its own.

    Attributes:
        settings_in_force: What the device says of every setting it has, since it was opened last.
        refused_settings: What was asked for and is not in force.
        good_frames: Frames decoded.
        bad_frames: Frames dropped because they were damaged, of another size or out of order.
        reopened: How often it came back after a loss.

    Raises:
        ConfigError: A setting has no such name.
    """

    def __init__(
        self,
        device: str,
        clock: Clock,
        *,
        size: tuple[int, int] = (1280, 720),
        fps: float = 30.0,
        settings: Mapping[str, float] | None = None,
        frame_age_limit: float = 0.5,
        capture: Callable[[str], Capture] = open_capture,
    ) -> None:
        self._device = device
        self._clock = clock
        self._size = size
        self._fps = fps
        self._settings = dict(settings or {})
        check_names(self._settings)
        self._age_limit = frame_age_limit
        self._open_capture = capture
        self._changed = threading.Condition()
        self._reader: threading.Thread | None = None
        self._closing = threading.Event()
        self._request: _Request | None = None
        self._listener: Callable[[Frame], None] | None = None
        self._glanced = -math.inf
        self._lost: CameraError | None = None
        self._newest = -math.inf
        self._one_at_a_time = threading.Lock()
        self._frames = 0
        self.reopened = 0
        self.good_frames = 0
        self.bad_frames = 0
        self.settings_in_force: dict[str, float] = {}
        self.refused_settings: tuple[Refused, ...] = ()

    def open(self) -> None:
        """Open the device, agree on the format, lock its settings and begin to read; takes some seconds.

        Raises:
            CameraLost: There is no such device, or it gives no frames.
            CameraError: It gives frames of another size.
        """
        if self._reader is not None:
            return
        stream = self._start()
        self._closing = threading.Event()
        self._lost = None
        self._newest = -math.inf
        self._reader = threading.Thread(
            target=self._run, args=(stream, self._closing), name=f"camera {self._device}", daemon=True
        )
        self._reader.start()

    def close(self) -> None:
        """Stop reading and release the device; harmless when not open. Waits for a frame on its way."""
        reader, self._reader = self._reader, None
        if reader is not None:
            self._closing.set()
            with self._changed:
                self._changed.notify_all()
            reader.join(_JOIN)

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        """The newest frame whose exposure began at or after `after` (s of the cell's clock); blocks for it.

        Raises:
            FrameStale: Frames come, but none young enough within `timeout` s; or none comes at all.
            CameraLost: The device is gone and has not come back within `timeout` s, or is not open.
        """
        closing = self._closing
        if self._reader is None:
            raise CameraLost(self._device, "capture", "the camera is not open", "open it first")
        deadline = self._clock.now() + timeout
        request = _Request(after)
        with self._one_at_a_time, self._changed:
            self._request = request
            while request.frame is None and (left := deadline - self._clock.now()) > 0.0 and not closing.is_set():
                self._changed.wait(left)
            self._request = None
            lost, newest = self._lost, self._newest
        if request.frame is not None:
            return request.frame
        if lost is not None:
            raise CameraLost(
                self._device, "capture", f"gone, and not back within {timeout:g} s ({lost.cause})", lost.remedy
            ) from lost
        last = f"the newest ended at {newest:.3f} s" if math.isfinite(newest) else "none came at all"
        raise FrameStale(
            self._device,
            "capture",
            f"no frame begun after {after:.3f} s within {timeout:g} s; {last}",
            "check the cable, the USB hub and the load of the computer",
        )

    def glance(self, listener: Callable[[Frame], None] | None) -> None:
        """Have glances told by the reading thread as frames come from now on; None: no longer."""
        self._listener = listener

    # --- the reader's thread --------------------------------------------------------------------------

    def _start(self) -> Stream:
        stream = Stream(
            self._open_capture(self._device),
            self._device,
            self._clock,
            size=self._size,
            fps=self._fps,
            settings=self._settings,
        )
        self.settings_in_force, self.refused_settings = stream.settings_in_force, stream.refused
        return stream

    def _run(self, stream: Stream | None, closing: threading.Event) -> None:
        pause = _BACK_OFF[0]
        while not closing.is_set():
            try:
                if stream is None:
                    stream = self._start()
                    self.reopened += 1
                self._take(stream)
                pause = _BACK_OFF[0]
            except CameraError as error:
                if stream is not None:
                    stream.close()
                    stream = None
                with self._changed:
                    self._lost = error
                    self._changed.notify_all()
                until = self._clock.now() + pause
                while not closing.is_set() and self._clock.now() < until:
                    self._clock.sleep(_SLICE)
                pause = min(2.0 * pause, _BACK_OFF[1])
        if stream is not None:
            stream.close()

    def _take(self, stream: Stream) -> None:
        """Take the next frame off the device, and decode it if it is the one that is waited for."""
        bad = stream.bad_frames
        exposure = stream.grab()
        request, listener, image = self._request, self._listener, None
        # After a stall of this program the device's queue holds old frames.
        if exposure is not None and self._clock.now() - exposure.ended <= self._age_limit:
            if request is not None and (request.frame is not None or exposure.began < request.after):
                request = None
            due = listener is not None and exposure.ended >= self._glanced + GLANCE_PERIOD
            image = stream.image() if due or request is not None else None
            if due and listener is not None and image is not None:
                self._glanced = exposure.ended
                listener(Frame(self._frames, exposure.ended, _small(image), self._device))
        with self._changed:
            self.good_frames += image is not None
            self.bad_frames += stream.bad_frames - bad
            self._lost = None
            if exposure is not None:
                self._newest = exposure.ended
                if image is not None and request is not None:
                    self._frames += 1
                    request.frame = Frame(self._frames, exposure.ended, image, self._device)
            self._changed.notify_all()


def _small(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    scale = 1.0 / GLANCE_SCALE
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)

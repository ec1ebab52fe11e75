"""Looks at every picture before anybody trusts it: a dead picture must hold the cell, not empty its table.

A black or frozen frame looks like an empty table or like one where nothing has changed; both would be believed.
What a device can tell about itself (loss, stall, age) is the driver's affair; here only the content counts.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Frame
from controller.errors import FrameStale, PictureUnusable
from controller.ports import GLANCE_SCALE, Camera, Clock, GlanceSource
from controller.vision.landmarks import MOVED, Landmarks
from controller.vision.scenery import Mask, Scenery, drift, trouble

_log = logging.getLogger(__name__)

# Of 255: a lit table is brighter than this at its brightest hundredth, the noise of a covered lens is not.
DARK = 32
# Of 255: a pixel all of whose channels reach this has lost its colour and its edges.
CLIPPED = 254
# A picture of which more than this part is clipped has lost its outlines with it.
MOST_CLIPPED = 0.5
# Rows that an incomplete JPEG leaves at least, one block high, in the middle grey of missing coefficients.
TORN_ROWS = 16
_GREY = (124, 132)
# A cable that damages more than this part of the latest pictures, and more than two, will soon damage all.
MOST_TORN = 0.05
_LATEST = 100
# Every so manieth pixel in both directions is enough to judge by, and a sixteenth of the work.
_STEP = 4


class WatchedCamera:
    """A camera whose pictures are judged before they are given out; itself a camera.

    Args:
        camera: The camera.
        clock: The cell's clock.

    Attributes:
        torn: Pictures passed over because a part was missing.
        scenery: What must look the same in every picture; None: nothing is known yet.
        landmarks: Markers that must stay where they are in the picture; None: there are none.
        concerns: What is not yet a reason to hold, by code of the fault catalogue: its cause in words.
    """

    def __init__(self, camera: Camera, clock: Clock) -> None:
        self._camera = camera
        self._clock = clock
        self._last: NDArray[np.uint8] | None = None
        self._still: Mask | None = None
        self._learnt: Callable[[NDArray[np.uint8]], None] = lambda image: None
        self._latest: deque[bool] = deque(maxlen=_LATEST)
        self.torn = 0
        self.scenery: Scenery | None = None
        self.landmarks: Landmarks | None = None
        self.concerns: Mapping[str, str] = {}

    def watch_scenery(
        self,
        still: Mask,
        reference: NDArray[np.uint8] | None = None,
        learnt: Callable[[NDArray[np.uint8]], None] = lambda image: None,
    ) -> None:
        """Compare every picture's scenery with a reference from now on.

        A scenery that gives nothing to hold on to is logged, and not watched.

        Args:
            still: ndarray of shape (H, W), dtype uint8: non-zero where nothing is supposed to change.
            reference: Picture taken when all was well; None: the next sound one.
            learnt: Told the picture that has become the reference.
        """
        self._still, self._learnt, self.scenery = still, learnt, None
        if reference is not None:
            self._learn(reference)

    def open(self) -> None:
        """Open the camera. The last picture is still known: a frozen one does not become new by opening again."""
        self._camera.open()

    def close(self) -> None:
        """Close the camera."""
        self._camera.close()

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        """The newest frame whose exposure began at or after `after` and that shows something.

        Raises:
            PictureUnusable: It is black, overexposed or frozen, no whole one came within `timeout` s, or its scenery
                says that the camera was moved, the light has changed or the lens is soft.
            FrameStale, CameraLost: As the camera says.
        """
        deadline = self._clock.now() + timeout
        torn_before = self.torn
        while True:
            try:
                frame = self._camera.capture(after, max(0.0, deadline - self._clock.now()))
            except FrameStale as error:
                if self.torn == torn_before:
                    raise
                cause = "the lower part of every picture is missing"
                raise PictureUnusable(error.device, "look", "torn", cause, "check the cable and the USB hub") from error
            torn = is_torn(frame.image)
            self._latest.append(torn)
            if not torn:
                self._judge(frame)
                return frame
            self.torn += 1
            after = frame.captured_at

    def glance(self, listener: Callable[[Frame], None] | None) -> None:
        """Have glances told that lack no part; none come from a camera that gives none."""
        if isinstance(self._camera, GlanceSource):
            self._camera.glance(None if listener is None else lambda frame: self._pass_on(frame, listener))

    def _pass_on(self, glance: Frame, listener: Callable[[Frame], None]) -> None:
        if not is_torn(glance.image, TORN_ROWS // GLANCE_SCALE):
            listener(glance)

    def _judge(self, frame: Frame) -> None:
        # A copy, so that the frame itself is not kept alive.
        sample = np.ascontiguousarray(frame.image[::_STEP, ::_STEP])
        if is_black(sample):
            raise PictureUnusable(
                frame.source, "look", "black", "the picture is black", "check the light and the lens cap"
            )
        if is_clipped(sample):
            raise PictureUnusable(
                frame.source,
                "look",
                "overexposed",
                "most of the picture is overexposed",
                "shade the light or lower the exposure",
            )
        # The noise of a sensor never repeats: one picture equal to the bit is no coincidence but a frozen stream.
        frozen = self._last is not None and np.array_equal(sample, self._last)
        self._last = sample
        if frozen:
            raise PictureUnusable(
                frame.source,
                "look",
                "frozen",
                "the camera is frozen: the picture equals the last one to the bit",
                "unplug it and plug it in again",
            )
        concerns: dict[str, str] = {}
        damaged = sum(self._latest)
        if damaged > max(2, MOST_TORN * len(self._latest)):
            concerns["pictures_damaged"] = f"{damaged} of the latest {len(self._latest)} pictures lack their lower part"
        if self.landmarks is not None:
            off = self.landmarks.displacement(frame.image)
            if off is not None and off > MOVED:
                cause = f"the camera was moved: the corner markers are {off:.1f} px off"
                raise PictureUnusable(frame.source, "look", "moved", cause, "recalibrate: controller calibrate table")
        if self.scenery is not None:
            change = self.scenery.compare(frame.image)
            if (found := trouble(change)) is not None:
                raise PictureUnusable(frame.source, "look", *found)
            if (words := drift(change)) is not None:
                concerns["light_drifting"] = words
        elif self._still is not None:
            self._learn(frame.image)
        self.concerns = concerns

    def _learn(self, image: NDArray[np.uint8]) -> None:
        assert self._still is not None
        try:
            self.scenery = Scenery(image, self._still)
        except ValueError as error:
            _log.warning("nobody will notice a move of the camera: %s", error)
            self._still = None
        else:
            self._learnt(image)


def is_black(sample: NDArray[np.uint8]) -> bool:
    """Not even a hundredth of a picture, shape (H, W, 3), is lit in any channel."""
    return _part(sample, 0, DARK - 1) > 0.99


def is_clipped(sample: NDArray[np.uint8]) -> bool:
    """Most pixels of a picture, shape (H, W, 3), have every channel at its end."""
    return _part(sample, CLIPPED, 255) > MOST_CLIPPED


def _part(sample: NDArray[np.uint8], low: int, high: int) -> float:
    """The part of the pixels whose channels all lie in [low, high]."""
    inside = cv2.inRange(sample, np.full(3, low), np.full(3, high))
    return cv2.countNonZero(inside) / inside.size


def is_torn(image: NDArray[np.uint8], rows: int = TORN_ROWS) -> bool:
    """The last rows of a picture, shape (H, W, 3), are one flat middle grey, as decoders fill what is missing."""
    bottom = image[-rows:, ::_STEP]
    low, high = int(bottom.min()), int(bottom.max())
    return low == high and _GREY[0] <= low <= _GREY[1]

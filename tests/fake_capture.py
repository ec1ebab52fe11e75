"""A scripted stand-in for cv2.VideoCapture that behaves as the real one was measured to.

Lost devices answer False at once and for ever, a stalled one after the select timeout, set() says yes to what
it does not do. It stamps frames with the cell's clock and takes the clock's time for each.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import cv2
import numpy as np

from controller.errors import CameraLost
from controller.ports import Clock

Step = Callable[["FakeCapture"], bool]
SELECT_TIMEOUT = 1.0

# A webcam's usual controls, automatic as after plugging in: property -> value.
WEBCAM: Mapping[int, float] = {
    cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
    cv2.CAP_PROP_EXPOSURE: 157.0,
    cv2.CAP_PROP_AUTO_WB: 1.0,
    cv2.CAP_PROP_WB_TEMPERATURE: 4600.0,
    cv2.CAP_PROP_AUTOFOCUS: 1.0,
    cv2.CAP_PROP_FOCUS: 30.0,
    cv2.CAP_PROP_GAIN: 64.0,
    cv2.CAP_PROP_BRIGHTNESS: 128.0,
}


def frame(capture: FakeCapture) -> bool:
    """A good frame after one period."""
    capture.clock.sleep(capture.period)
    capture.stamp = capture.clock.now()
    return True


def lost(_capture: FakeCapture) -> bool:
    """Unplugged: False at once."""
    return False


def stall(capture: FakeCapture) -> bool:
    """No frame until the select timeout."""
    capture.clock.sleep(SELECT_TIMEOUT)
    return False


class FakeCapture:
    """One opened device.

    Args:
        clock: The cell's clock.
        size: What it gives, whatever is asked for; None: what is asked for.
        rate: Frames per second by pixel format, "" for the first one.
        controls: Property -> value; what is not in it the device does not have.
        fixed: Properties that set() claims to change but does not.
        script: What the next frames do; afterwards every frame is good.
        stamps: The driver stamps frames.
        pace: Real pause before every frame; a virtual clock would let the reader run away otherwise.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        size: tuple[int, int] | None = None,
        rate: Mapping[str, float] | None = None,
        controls: Mapping[int, float] = WEBCAM,
        fixed: Iterable[int] = (),
        script: Iterable[Step] = (),
        stamps: bool = True,
        pace: Callable[[], object] = lambda: None,
    ) -> None:
        self.clock = clock
        self._given = size
        self._asked = [640.0, 480.0]
        self._rate = dict(rate or {"": 30.0})
        self._format = ""
        self.controls = dict(controls)
        self._fixed = frozenset(fixed)
        self.script = list(script)
        self._stamps = stamps
        self._pace = pace
        self.stamp = 0.0
        self.value = 0
        self.released = False
        self.decoded = 0
        self.reader: int | None = None

    @property
    def period(self) -> float:
        return 1.0 / self._rate[self._format]

    def grab(self) -> bool:
        assert not self.released, "a released capture was used"
        self._one_thread()
        self._pace()
        self.value = (self.value + 1) % 256
        return (self.script.pop(0) if self.script else frame)(self)

    def retrieve(self) -> tuple[bool, Any]:
        assert not self.released, "a released capture was used"
        self.decoded += 1
        width, height = self._given or (int(self._asked[0]), int(self._asked[1]))
        return True, np.full((height, width, 3), self.value, np.uint8)

    def get(self, propId: int) -> float:
        known: dict[int, float] = {
            cv2.CAP_PROP_POS_MSEC: 1000.0 * self.stamp if self._stamps else 0.0,
            cv2.CAP_PROP_FPS: self._rate[self._format],
            **self.controls,
        }
        return known.get(propId, -1.0)

    def set(self, propId: int, value: float) -> bool:
        if propId in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            self._asked[propId - cv2.CAP_PROP_FRAME_WIDTH] = value
        elif propId == cv2.CAP_PROP_FOURCC:
            name = int(value).to_bytes(4, "little").decode("ascii")
            if name not in self._rate:
                return False
            self._format = name
        elif propId not in self.controls:
            return propId == cv2.CAP_PROP_FPS
        elif propId not in self._fixed:
            self.controls[propId] = float(round(value))
        return True

    def release(self) -> None:
        self.released = True

    def _one_thread(self) -> None:
        """OpenCV's capture may be handed from the opener to the reader, never shared."""
        me = threading.get_ident()
        if self.reader != me:
            self.changes = getattr(self, "changes", 0) + 1
            assert self.changes <= 2, "the capture is read from several threads"
            self.reader = me


class Plug:
    """Where captures come from: gives out the devices plugged in, one after the other.

    Args:
        devices: A capture to give out, or None where opening fails because there is none.
    """

    def __init__(self, *devices: FakeCapture | None) -> None:
        self._devices = list(devices)
        self.opened: list[str] = []

    def __call__(self, device: str) -> FakeCapture:
        self.opened.append(device)
        capture = self._devices.pop(0) if self._devices else None
        if capture is None:
            raise CameraLost(device, "open", "there is no such device", "plug the camera in")
        return capture

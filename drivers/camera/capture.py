"""The one place that opens OpenCV's V4L2 capture, and what the driver needs of it."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any, Protocol

import cv2

from controller.errors import CameraLost

# s. OpenCV waits 10 s for a frame by default and reads this once, at the first wait of the process; whole seconds.
_SELECT_TIMEOUT = "1"
_SEE_LIST = "`controller camera list` shows what is plugged in"


class Capture(Protocol):
    """What the driver uses of cv2.VideoCapture; a test hands in its own."""

    def grab(self) -> bool:
        """Block for the next frame and take it; False when there is none."""
        ...

    def retrieve(self) -> tuple[bool, Any]:
        """The image of the frame taken last; (False, None) when it cannot be decoded."""
        ...

    def get(self, propId: int) -> float:
        """A property, -1 or 0 when the device has it not."""
        ...

    def set(self, propId: int, value: float) -> bool:
        """Ask for a property; the answer is not to be trusted."""
        ...

    def release(self) -> None:
        """Let go of the device."""
        ...


def open_capture(device: str) -> Capture:
    """Open a video device through OpenCV's V4L2 backend.

    Args:
        device: Path of the device or of a link to it. The link is followed anew each time: after a replug it
            may lead to another node.

    Raises:
        CameraLost: There is no such device, it may not be used, or it does not answer.
    """
    if not sys.platform.startswith("linux"):
        raise CameraLost(device, "open", "cameras are read through V4L2, which only Linux has", "use --sim or --replay")
    if not Path(device).exists():
        raise CameraLost(device, "open", "there is no such device", f"plug the camera in; {_SEE_LIST}")
    if not os.access(device, os.R_OK | os.W_OK):
        raise CameraLost(device, "open", "no permission", "add the user to the group `video` and log in again")
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", _SELECT_TIMEOUT)
    capture = cv2.VideoCapture(os.path.realpath(device), cv2.CAP_V4L2)
    if not capture.isOpened():
        capture.release()
        raise CameraLost(
            device, "open", "it does not answer as a camera", f"end other programs that use it; {_SEE_LIST}"
        )
    return capture

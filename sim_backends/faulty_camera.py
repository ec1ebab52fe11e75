"""A camera that fails by script: every fault of a camera, without unplugging one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Frame
from controller.errors import CameraError, CameraLost, FrameStale
from controller.ports import Camera, Clock, GlanceSource

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class CameraFault:
    """What goes wrong, and when.

    Attributes:
        kind: `lost` (gone: no frame, and opening fails), `stalled` (no frame comes), `failed` (frames of another
            size come, which no driver lets through), `frozen` (the last picture comes again and again), `ragged`
            (three of four pictures are torn), or a name of `PICTURE_FAULTS`.
        begins: s of the cell's clock.
        ends: s of the cell's clock.
    """

    kind: str
    begins: float
    ends: float


def _torn(image: Image) -> Image:
    out = image.copy()
    out[len(out) // 2 :] = 128
    return out


def _moved(image: Image) -> Image:
    matrix = np.array([[1.0, 0.0, 9.0], [0.0, 1.0, -5.0]])
    size = image.shape[1], image.shape[0]
    moved = cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return moved.astype(np.uint8, copy=False)


def _covered(image: Image) -> Image:
    """A checked cloth hangs before the camera."""
    out, (height, width) = image.copy(), image.shape[:2]
    rows, columns = np.indices((3 * height // 4, width)) // 40
    out[: 3 * height // 4] = np.where(((rows + columns) % 2)[..., None], (60, 60, 70), (170, 190, 210))
    return out


def _reached_over(image: Image) -> Image:
    """A bare arm reaches in from ahead, to the middle of the table."""
    out, (height, width) = image.copy(), image.shape[:2]
    left, right = round(0.46 * width), round(0.54 * width)
    cv2.rectangle(out, (left, 0), (right, height // 2), (118, 148, 205), -1)
    cv2.circle(out, ((left + right) // 2, height // 2), (right - left) // 2, (118, 148, 205), -1)
    return out


def _strange(image: Image) -> Image:
    """Something crooked lies to the arm's left, of a shape that nobody has a name for."""
    out, (height, width) = image.copy(), image.shape[:2]
    corners = np.array([[0, 0], [6, 0], [6, 2], [2, 2], [2, 4], [5, 4], [5, 6], [0, 6]], np.float64)
    place = np.rint(corners * 0.011 * width + (0.34 * width, 0.5 * height)).astype(np.int32)
    cv2.fillPoly(out, [place], (60, 60, 70), cv2.LINE_AA)
    return out


PICTURE_FAULTS: Mapping[str, Callable[[Image], Image]] = {
    "black": np.zeros_like,
    "overexposed": lambda image: cv2.convertScaleAbs(image, alpha=10.0).astype(np.uint8, copy=False),
    "dimmed": lambda image: cv2.convertScaleAbs(image, alpha=0.5).astype(np.uint8, copy=False),
    "dimming": lambda image: cv2.convertScaleAbs(image, alpha=0.8).astype(np.uint8, copy=False),
    "blurred": lambda image: cv2.GaussianBlur(image, (0, 0), 6.0).astype(np.uint8, copy=False),
    "torn": _torn,
    "moved": _moved,
    "covered": _covered,
    "reached_over": _reached_over,
    "strange": _strange,
}
_KINDS = frozenset({"lost", "stalled", "failed", "frozen", "ragged", *PICTURE_FAULTS})


class FaultyCamera:
    """A camera that works but for its faults; the first that is due counts.

    Args:
        camera: The sound camera.
        clock: The cell's clock.
        faults: The script.

    Raises:
        ValueError: There is no such fault.
    """

    def __init__(self, camera: Camera, clock: Clock, faults: Iterable[CameraFault]) -> None:
        self._camera = camera
        self._clock = clock
        self._faults: list[CameraFault] = []
        self._shown: Image | None = None
        for fault in faults:
            self.strike(fault)

    def strike(self, fault: CameraFault) -> None:
        """Add a fault to the script.

        Raises:
            ValueError: There is no such fault.
        """
        if fault.kind not in _KINDS:
            raise ValueError(f"no camera fault {fault.kind!r}; there are {', '.join(sorted(_KINDS))}")
        self._faults.append(fault)

    def heal(self) -> None:
        """Nothing is wrong any more, nor will be."""
        self._faults.clear()

    def open(self) -> None:
        """Open the camera, unless it is gone."""
        self._refuse_if_lost("open")
        self._camera.open()

    def close(self) -> None:
        """Close the camera."""
        self._camera.close()

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        """A frame of the camera, spoiled by the fault that is due when it would be exposed."""
        self._refuse_if_lost("capture")
        began = self._clock.now()
        if self._due("stalled", max(after, began)):
            self._clock.sleep(timeout)
            raise FrameStale("faulty camera", "capture", f"no frame within {timeout:g} s")
        if self._due("failed", max(after, began)):
            raise CameraError("faulty camera", "capture", "it gives frames of 640 x 480, not of the calibrated size")
        frame = self._camera.capture(after, timeout)
        self._refuse_if_lost("capture")
        if self._due("frozen", frame.captured_at) and self._shown is not None:
            frame = dataclasses.replace(frame, image=self._shown)
        frame = self._spoiled(frame)
        frame.image.setflags(write=False)
        self._shown = frame.image
        return frame

    def glance(self, listener: Callable[[Frame], None] | None) -> None:
        """Glances of the camera, spoiled as its frames are; none while none would come or the last comes again."""
        if isinstance(self._camera, GlanceSource):
            self._camera.glance(None if listener is None else lambda frame: self._pass_on(frame, listener))

    def _pass_on(self, glance: Frame, listener: Callable[[Frame], None]) -> None:
        if not any(self._due(kind, glance.captured_at) for kind in ("lost", "stalled", "failed", "frozen")):
            listener(self._spoiled(glance))

    def _spoiled(self, frame: Frame) -> Frame:
        """The frame with what is wrong with its picture when it was exposed."""
        image = frame.image
        for kind, spoil in PICTURE_FAULTS.items():
            if self._due(kind, frame.captured_at):
                image = spoil(image)
        if self._due("ragged", frame.captured_at) and frame.frame_id % 4:
            image = _torn(image)
        return dataclasses.replace(frame, image=image)

    def _due(self, kind: str, at: float) -> bool:
        return any(fault.kind == kind and fault.begins <= at < fault.ends for fault in self._faults)

    def _refuse_if_lost(self, operation: str) -> None:
        if self._due("lost", self._clock.now()):
            raise CameraLost("faulty camera", operation, "the camera is gone", "plug it in")

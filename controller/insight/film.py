"""A film of a simulated run: the cell as a bystander sees it, beside what its camera showed last and what was found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.backends import Devices
from controller.cycle.machine import State
from controller.cycle.rig import Look, Observer
from controller.domain import Outcome, Result
from controller.errors import InputError
from controller.insight.report import annotated

Image = NDArray[np.uint8]

_BAR_PX = 28
_DARK = (32, 28, 26)
_WHITE = (250, 250, 250)


class Film(Observer):
    """Writes an MP4 while a run goes on; give `watch` to the session. A context manager that closes the file.

    Args:
        path: The file, written anew.
        fps: Frames a second of simulated time; the film plays as fast as the cell works.

    Raises:
        InputError: The file cannot be written.
    """

    def __init__(self, path: Path, fps: float = 10.0) -> None:
        self._path = path
        self._period = 1.0 / fps
        self._due = self._period
        self._time = 0.0
        self._writer: cv2.VideoWriter | None = None
        self._miniature: Callable[[], Image] | None = None
        self._overlay: Image | None = None
        self._state = State.STOPPED
        self._count: Counter[Result] = Counter()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"")
        except OSError as error:
            raise InputError(f"{path} cannot be written ({error.strerror})", "name another file") from error

    def __enter__(self) -> Self:
        """Nothing is open yet: the first frame decides the size."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        if self._writer is not None:
            self._writer.release()

    def watch(self, devices: Devices) -> Sequence[Observer]:
        """Film these devices from now on.

        Raises:
            InputError: They are not simulated in this process.
        """
        if devices.miniature is None or devices.on_step is None:
            raise InputError("there is no film of this cell", "use --video with --sim, without --real-time")
        self._miniature = devices.miniature
        devices.on_step(self._step)
        return (self,)

    # --- told by the run ------------------------------------------------------------------------------

    def entered(self, state: State, at: float) -> None:
        """Show the state."""
        self._state = state

    def looked(self, look: Look) -> None:
        """Show the picture, with what was found, until the next one."""
        self._overlay = annotated(look)

    def concluded(self, outcome: Outcome) -> None:
        """Count."""
        self._count[outcome.result] += 1

    # --- frames ---------------------------------------------------------------------------------------

    def _step(self, seconds: float) -> None:
        self._time += seconds
        if self._time + 1e-9 >= self._due:
            self._due += self._period
            self._write()

    def _write(self) -> None:
        assert self._miniature is not None
        left = self._miniature()
        height, width = left.shape[:2]
        right = np.full_like(left, 60)
        if self._overlay is not None:
            if self._overlay.shape != left.shape:
                self._overlay = _fitted(self._overlay, (width, height))
            right = self._overlay
        bar = np.empty((_BAR_PX, 2 * width, 3), np.uint8)
        bar[:] = _DARK
        counts = ", ".join(f"{count} {result}" for result, count in self._count.items())
        text = f"{self._time:6.1f} s   {self._state.value:<9} {counts}"
        cv2.putText(bar, text, (10, _BAR_PX - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _WHITE, 1, cv2.LINE_AA)
        frame = np.vstack([np.hstack([left, right]), bar])
        if self._writer is None:
            size = frame.shape[1], frame.shape[0]
            self._writer = cv2.VideoWriter(str(self._path), cv2.VideoWriter.fourcc(*"mp4v"), 1.0 / self._period, size)
            if not self._writer.isOpened():
                raise InputError(f"{self._path} cannot be written as a film", "name a file that ends in .mp4")
        self._writer.write(frame)


def _fitted(picture: Image, size: tuple[int, int]) -> Image:
    """A picture scaled into a frame of `size` (width, height), dark around it."""
    width, height = size
    scale = min(width / picture.shape[1], height / picture.shape[0])
    inside = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    small = cv2.resize(picture, inside, interpolation=cv2.INTER_AREA)
    frame = np.empty((height, width, 3), np.uint8)
    frame[:] = _DARK
    x, y = (width - inside[0]) // 2, (height - inside[1]) // 2
    frame[y : y + inside[1], x : x + inside[0]] = small
    return frame

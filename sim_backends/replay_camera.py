"""A camera that shows pictures from files: recorded tables sorted again without a camera, and tests."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Frame
from controller.errors import CameraEnded, CameraLost, FrameStale, InputError
from controller.ports import Clock

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")


class ReplayCamera:
    """Shows each picture once, in order, as if it had been exposed when it was asked for; then it has ended.

    Closing and opening it again, as after a loss, goes on with the next picture: time does not run back.

    Args:
        source: A folder (its pictures in natural order: 2 before 10), one picture, or pictures in order.
        clock: The cell's clock; every frame takes one `period` of it.
        period: Time from the start of an exposure to the finished frame, s.
    """

    def __init__(self, source: Path | Sequence[Path], clock: Clock, period: float = 1 / 30) -> None:
        self._source = source
        self._clock = clock
        self._period = period
        self._paths: tuple[Path, ...] = ()
        self._next = 0
        self._size: tuple[int, int] | None = None
        self._open = False

    @property
    def remaining(self) -> int:
        """Pictures not shown yet."""
        return len(self._paths) - self._next

    def open(self) -> None:
        """Find the pictures and check that each file begins like one.

        Raises:
            InputError: There is no picture, or a file is missing or not a picture.
        """
        if not self._paths:
            self._paths = pictures_of(self._source)
        self._open = True

    def close(self) -> None:
        """Show no more; harmless when not open."""
        self._open = False

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        """The next picture, exposed at `after` or now, whichever is later.

        Raises:
            FrameStale: That exposure would not be finished within `timeout` s; the picture is kept for later.
            CameraEnded: All pictures were shown.
            CameraLost: The camera is not open.
            InputError: The file is damaged, or its size differs from that of the pictures before it.
        """
        if not self._open:
            raise CameraLost("replay", "capture", "the camera is not open", "open it first")
        if not self.remaining:
            raise CameraEnded("replay", "capture", f"the pictures have ended after {len(self._paths)}")
        now = self._clock.now()
        captured_at = max(now, after) + self._period
        if captured_at > now + timeout:
            self._clock.sleep(timeout)
            raise FrameStale("replay", "capture", f"no frame begun after {after:.3f} s within {timeout:g} s")
        path = self._paths[self._next]
        image = read_picture(path)
        size = (image.shape[1], image.shape[0])
        if self._size is not None and size != self._size:
            raise InputError(
                f"{path}: {size[0]}x{size[1]} pixels, but the pictures before it have {self._size[0]}x{self._size[1]}",
                "replay pictures of one camera at one resolution: one calibration and one recipe serve them all",
            )
        self._size = size
        self._next += 1
        self._clock.sleep(captured_at - now)
        return Frame(self._next, captured_at, image, str(path))


def pictures_of(source: Path | Sequence[Path]) -> tuple[Path, ...]:
    """The picture files meant by `source`: the pictures of a folder in natural order, or the files themselves.

    Raises:
        InputError: There is none, or one is missing or does not begin like a picture.
    """
    if isinstance(source, Path) and not source.is_file():
        paths = _pictures_in(source)
    else:
        paths = (source,) if isinstance(source, Path) else tuple(source)
    if not paths:
        raise InputError("no pictures to replay", "name at least one")
    for path in paths:
        if not path.is_file():
            raise InputError(f"{path}: no such file", "check the name")
        if not cv2.haveImageReader(str(path)):
            raise _not_a_picture(path)
    return paths


def read_picture(path: Path) -> NDArray[np.uint8]:
    """The picture as ndarray of shape (H, W, 3), dtype uint8, BGR, read-only.

    Raises:
        InputError: The file cannot be read, is not a picture, or is damaged.
    """
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}", "check the name and the permissions") from error
    # Decoding from memory, because reading by name fills the missing part of a cut JPEG with grey.
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
        raise _not_a_picture(path)
    image.setflags(write=False)
    return np.asarray(image, np.uint8)


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sort key of a file name by which `part2` comes before `part10`."""
    pieces = re.split(r"(\d+)", path.name.lower())
    return tuple((0, int(p), "") if p.isdecimal() else (1, 0, p) for p in pieces if p)


def _pictures_in(folder: Path) -> tuple[Path, ...]:
    try:
        files = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    except FileNotFoundError:
        raise InputError(f"{folder}: no such file or folder", "check the name") from None
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror or error}", "check the name and the permissions") from error
    if not files:
        raise InputError(f"{folder}: no pictures in this folder", f"put some there ({' '.join(SUFFIXES)})")
    return tuple(sorted(files, key=lambda p: (natural_key(p), p.name)))


def _not_a_picture(path: Path) -> InputError:
    return InputError(f"{path}: not a picture that can be read, or cut short", "remove it or save it again")

"""Reading pictures from files, so that a damaged one is refused and never half seen."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.errors import InputError

Image = NDArray[np.uint8]

MAX_PIXELS = 200_000_000
"""Above this the memory of a small computer is at risk; the largest industrial sensors have 150 MP."""

_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"


def read_image(path: str | Path) -> Image:
    """The picture in a file: ndarray of shape (H, W, 3), dtype uint8, BGR.

    Gray becomes three equal channels, 16 bit is scaled by 1/257, transparent parts lie on white.

    Raises:
        InputError: The file is missing, empty, cut short, no picture, or too large.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except IsADirectoryError:
        raise InputError(f"{path} is a folder", "name the pictures in it") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror})", "check the path and its permissions") from error
    if not data:
        raise InputError(f"{path} is empty (0 bytes)", "copy or record the picture again")
    _refuse_truncated(path, data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"{path} cannot be decoded ({error.err})", "convert it to a plain PNG or JPEG") from error
    if image is None:
        raise InputError(f"{path} is not a picture that can be decoded", "use PNG, JPEG, BMP, TIFF or WebP")
    if image.shape[0] * image.shape[1] > MAX_PIXELS:
        raise InputError(f"{path} has {image.shape[0] * image.shape[1] / 1e6:.0f} MP", "scale it below 200 MP")
    return to_bgr(np.asarray(image), str(path))


def to_bgr(image: NDArray[np.generic], name: str = "the picture") -> Image:
    """Any decoded picture as BGR, dtype uint8, shape (H, W, 3).

    Raises:
        InputError: The type or number of channels is none a camera delivers.
    """
    if image.dtype == np.bool_:
        image = image.astype(np.uint8) * np.uint8(255)
    elif image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif image.dtype != np.uint8:
        raise InputError(f"{name} holds {image.dtype} values", "save it with 8 or 16 bit a channel")
    if image.ndim == 2:
        image = image[:, :, None]
    channels = image.shape[2] if image.ndim == 3 else 0
    if channels == 1:
        return np.asarray(np.repeat(image, 3, axis=2), np.uint8)
    if channels == 2:
        return _on_white(np.repeat(image[:, :, :1], 3, axis=2), image[:, :, 1:])
    if channels == 3:
        return np.ascontiguousarray(image, np.uint8)
    if channels == 4:
        return _on_white(image[:, :, :3], image[:, :, 3:])
    raise InputError(f"{name} has {channels} channels", "save it as gray or colour")


def _on_white(colour: NDArray[np.generic], alpha: NDArray[np.generic]) -> Image:
    """Colour laid on white with an alpha channel of shape (H, W, 1)."""
    if alpha.min() == 255:
        return np.ascontiguousarray(colour, np.uint8)
    share = alpha.astype(np.float32) / 255.0
    return np.asarray(np.rint(colour.astype(np.float32) * share + 255.0 * (1.0 - share)), np.uint8)


def _refuse_truncated(path: Path, data: bytes) -> None:
    """Raise when a JPEG or PNG lacks its end: decoders fill the rest with gray and say nothing."""
    whole = True
    if data.startswith(_JPEG_START):
        # Cameras pad files after the end marker; a thumbnail's own end marker lies before the last scan begins.
        whole = data.rfind(_JPEG_END) > data.rfind(b"\xff\xda")
    elif data.startswith(_PNG_START):
        whole = _PNG_END in data[-64:] or _PNG_END in data
    if not whole:
        raise InputError(f"{path} is cut short: its end is missing", "copy or record the picture again")

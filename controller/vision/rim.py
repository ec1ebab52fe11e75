"""Watches the strip between the work area and the edge of the picture: whatever reaches over the table crosses it.

Parts lie inside the work area, so a hand cannot be told from them there; but a hand has an arm, and that comes from
outside. The strip is compared with how it looked when nothing reached over it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.ports import GLANCE_SCALE

_TINT = 0.15  # least difference between the channels' ratios to the reference: shadows keep the colour
_DARK, _BRIGHT = 0.5, 1.4  # beyond: no shadow of a lamp in a lit room, no change of light between two looks
_OFFSET = 8.0  # of 255, so that ratios of dark pixels mean something
_REACH = 3  # pixels of the coarse picture that a crossing may miss at either end
_SPARSE = 7  # every so manieth pixel of the strip tells the light of the room
_LEAST = 12  # pixels of the coarse picture: narrower than a finger is nothing


class Rim:
    """The strip, as it looks with nothing over it.

    Attributes:
        pixels: ndarray of shape (S, 2): centres of its pixels, px of the full picture.

    Args:
        clear: ndarray of shape (h, w, 3), dtype float32, see `coarse`: a picture with nothing over the table.
        strip: ndarray of shape (H, W), dtype uint8: non-zero where nothing is supposed to change.
        inside: ndarray of shape (H, W), dtype uint8: non-zero in the work area with its margin.
    """

    def __init__(self, clear: NDArray[np.float32], strip: NDArray[np.uint8], inside: NDArray[np.uint8]) -> None:
        size = clear.shape[1], clear.shape[0]
        self._strip = np.flatnonzero(cv2.resize(strip, size, interpolation=cv2.INTER_AREA) == 255)
        rows, columns = np.divmod(self._strip, size[0])
        self.pixels = (np.column_stack([columns, rows]) + 0.5) * GLANCE_SCALE - 0.5
        self.learn(clear)
        around = np.ones((2 * _REACH + 1, 2 * _REACH + 1), np.uint8)
        self._inner = cv2.dilate((cv2.resize(inside, size, interpolation=cv2.INTER_AREA) > 0).astype(np.uint8), around)
        self._outer = np.zeros(size[::-1], np.uint8)
        self._outer[:_REACH], self._outer[-_REACH:], self._outer[:, :_REACH], self._outer[:, -_REACH:] = 1, 1, 1, 1

    def learn(self, clear: NDArray[np.float32]) -> None:
        """Compare with another picture with nothing over the table from now on, (h, w, 3)."""
        self._before = clear.reshape(-1, 3)[self._strip] + _OFFSET

    def crossed(
        self, small: NDArray[np.uint8] | NDArray[np.float32], known: NDArray[np.bool_] | None = None
    ) -> bool:
        """Whether something reaches from the edge of a picture, (h, w, 3), into the work area; see `coarse`.

        Args:
            small: The picture.
            known: ndarray of shape (S,): where in the strip what shows is accounted for.
        """
        ratio = (small.reshape(-1, 3)[self._strip] + _OFFSET) / self._before
        # The room's light may have changed as a whole.
        ratio /= np.median(ratio[::_SPARSE], axis=0)
        blue, green, red = ratio.T
        tint = np.maximum(np.maximum(blue, green), red) - np.minimum(np.minimum(blue, green), red)
        mean = (blue + green + red) / 3.0
        changed = (tint > _TINT) | (mean < _DARK) | (mean > _BRIGHT)
        if known is not None:
            changed &= ~known
        if changed.sum() < _LEAST:
            return False
        where = np.zeros(self._outer.shape, np.uint8)
        where.flat[self._strip[changed]] = 1
        count, labels, stats, _ = cv2.connectedComponentsWithStats(where, connectivity=8)
        for label in range(1, count):
            if stats[label, cv2.CC_STAT_AREA] < _LEAST:
                continue
            mine = labels == label
            if (mine & (self._inner > 0)).any() and (mine & (self._outer > 0)).any():
                return True
        return False


def coarse(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A picture, (H, W, 3), averaged down by `GLANCE_SCALE`: arms are wide, and noise and grain average out."""
    small = cv2.resize(image, None, fx=1.0 / GLANCE_SCALE, fy=1.0 / GLANCE_SCALE, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)

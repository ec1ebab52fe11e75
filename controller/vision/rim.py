"""Watches the strip between the work area and the edge of the picture: whatever reaches over the table crosses it.

Parts lie inside the work area, so a hand cannot be told from them there; but a hand has an arm, and that comes from
outside. The strip is compared with how it looked when the work began.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_SCALE = 8  # the strip is looked at this much coarser: arms are wide, and noise and grain average out
_TINT = 0.15  # least difference between the channels' ratios to the reference: shadows keep the colour
_DARK, _BRIGHT = 0.5, 1.4  # beyond: no shadow of a lamp in a lit room, no change of light between two looks
_OFFSET = 8.0  # of 255, so that ratios of dark pixels mean something
_REACH = 3  # pixels of the coarse picture that a crossing may miss at either end
_LEAST = 12  # pixels of the coarse picture: narrower than a finger is nothing


class Rim:
    """The strip, as it looked at first.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8, BGR: the first picture.
        strip: ndarray of shape (H, W), dtype uint8: non-zero where nothing is supposed to change.
        inside: ndarray of shape (H, W), dtype uint8: non-zero in the work area with its margin.
    """

    def __init__(self, image: NDArray[np.uint8], strip: NDArray[np.uint8], inside: NDArray[np.uint8]) -> None:
        self._reference = _coarse(image)
        size = self._reference.shape[1], self._reference.shape[0]
        self._strip = cv2.resize(strip, size, interpolation=cv2.INTER_AREA) == 255
        around = np.ones((2 * _REACH + 1, 2 * _REACH + 1), np.uint8)
        self._inner = cv2.dilate((cv2.resize(inside, size, interpolation=cv2.INTER_AREA) > 0).astype(np.uint8), around)
        self._outer = np.zeros(size[::-1], np.uint8)
        self._outer[:_REACH], self._outer[-_REACH:], self._outer[:, :_REACH], self._outer[:, -_REACH:] = 1, 1, 1, 1

    def crossed(self, image: NDArray[np.uint8]) -> bool:
        """Whether something reaches from the edge of a picture, (H, W, 3), into the work area."""
        ratio = (_coarse(image) + _OFFSET) / (self._reference + _OFFSET)
        # The room's light may have changed as a whole.
        ratio /= np.median(ratio[self._strip], axis=0)
        low, high, mean = ratio.min(axis=2), ratio.max(axis=2), ratio.mean(axis=2)
        changed = self._strip & ((high - low > _TINT) | (mean < _DARK) | (mean > _BRIGHT))
        count, labels, stats, _ = cv2.connectedComponentsWithStats(changed.astype(np.uint8), connectivity=8)
        for label in range(1, count):
            if stats[label, cv2.CC_STAT_AREA] < _LEAST:
                continue
            mine = labels == label
            if (mine & (self._inner > 0)).any() and (mine & (self._outer > 0)).any():
                return True
        return False


def _coarse(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    small = cv2.resize(image, None, fx=1.0 / _SCALE, fy=1.0 / _SCALE, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)

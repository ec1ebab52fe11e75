"""Holes in parts: where the table shows through."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Mask = NDArray[np.uint8]

_ALIKE, _NEARER, _LEAST_STEP = 0.1, 0.3, 10.0
"""The table within a hole is like the table around the part: to a tenth of its brightness, or to 0.3 of the step
from table to part where the outline of a hole was found; never better than noise allows (codes)."""
_SMALLEST, _LARGEST = 0.03, 0.65
"""Share of the part: what is smaller is a speck, what is larger leaves no part."""
_TOGETHER = 0.7
"""Share of what looks like the table that hangs together: stripes or dots of the table's colour are many."""
_FILLED = 128


def like_table(
    shown: Image, material: NDArray[np.bool_], table: NDArray[np.float32], flagged: Sequence[bool]
) -> NDArray[np.float32]:
    """Lowest and highest codes (N, 2, 3) on each part that are like the table's.

    Args:
        shown: ndarray of shape (N, h, w, 3), dtype uint8, BGR: the parts.
        material: ndarray of shape (N, h, w), dtype bool: within each, away from its edges.
        table: ndarray of shape (N, 3): BGR codes of the table around each.
        flagged: Of each whether the outline of a hole was found in it.
    """
    step = np.maximum(_ALIKE * table.max(axis=1, initial=0.0), _LEAST_STEP)
    for k in np.flatnonzero(flagged).tolist():
        # Found by its outline: what is nearer to the table than to the part shows, however uneven the light.
        # Codes of 16 bits: numpy sorts them ten times as fast as those of 8.
        codes = np.sort(np.compress(material[k].ravel(), shown[k].reshape(-1, 3), axis=0).astype(np.uint16), axis=0)
        if len(codes):
            step[k] = max(step[k], _NEARER * float(np.abs(codes[len(codes) // 2] - table[k]).max()))
    return np.stack([np.floor(table - step[:, None]), np.ceil(table + step[:, None])], axis=1)


def may_show_table(
    shown: Image, material: NDArray[np.bool_], alike: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Which parts (N,) are worth a closer look for holes: by far most have nothing of the table's colour on them.

    Args:
        shown: ndarray of shape (N, h, w, 3), dtype uint8, BGR: the parts.
        material: ndarray of shape (N, h, w), dtype bool: within each, away from its edges.
        alike: Lowest and highest codes (N, 2, 3) that are like the table's.
    """
    low, high = np.clip(alike, 0, 255).astype(np.uint8).transpose(1, 2, 0)[..., None, None]
    # Every second pixel tells.
    thin = np.ascontiguousarray(shown[:, ::2, ::2].transpose(3, 0, 1, 2))
    within = (thin >= low) & (thin <= high)
    inside = material[:, ::2, ::2]
    return np.asarray(counts(within[0] & within[1] & within[2] & inside) > 0.5 * _SMALLEST * counts(inside))


def blob_like_table(picture: Image, material: Mask, alike: NDArray[np.float32]) -> Mask | None:
    """Where the table shows through a part; None where it does not.

    Args:
        picture: ndarray of shape (h, w, 3), dtype uint8, BGR: the part.
        material: ndarray of shape (h, w), dtype uint8: 255 within the part, away from its edges, else 0.
        alike: Lowest and highest codes (2, 3) that are like the table's.

    Returns:
        ndarray of shape (h, w), dtype uint8: 255 where it shows, else 0.
    """
    low, high = alike.tolist()
    like = cv2.bitwise_and(cv2.inRange(picture, tuple(low), tuple(high)), material)
    # The majority of 3 x 3 pixels; OpenCV's median is five times as slow on so small a picture.
    _, most = cv2.threshold(cv2.blur(like, (3, 3), borderType=cv2.BORDER_REPLICATE), 127, 255, cv2.THRESH_BINARY)
    mask = np.asarray(most, np.uint8)
    whole, count = cv2.countNonZero(material), cv2.countNonZero(mask)
    if not _SMALLEST * whole < count < _LARGEST * whole:
        return None
    return _largest(mask, max(_TOGETHER * count, _SMALLEST * whole))


def counts(masks: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(N,) how many are true in each of masks (N, ...)."""
    packed = np.packbits(masks.reshape(len(masks), math.prod(masks.shape[1:])), axis=1)
    return np.asarray(np.bitwise_count(packed).sum(axis=1, dtype=np.intp))


def _largest(mask: Mask, least: float) -> Mask | None:
    """The largest blob of a mask, or None when it has fewer pixels than `least`, which is most of the mask."""
    # Where the first pixel belongs to it, filling it is four times as quick as looking for all blobs.
    first = int(mask.argmax())
    filled = mask.copy()
    count, _, _, _ = cv2.floodFill(filled, None, (first % mask.shape[1], first // mask.shape[1]), (_FILLED,), flags=4)
    if count >= least:
        return np.asarray(cv2.inRange(filled, _FILLED, _FILLED), np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    if stats[largest, cv2.CC_STAT_AREA] < least:
        return None
    return np.asarray(cv2.inRange(labels, largest, largest), np.uint8)

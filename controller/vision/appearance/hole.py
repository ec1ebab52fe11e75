"""Holes in parts: where the table shows through."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Planes = NDArray[np.uint8]
Mask = NDArray[np.uint8]

_ALIKE, _NEARER, _LEAST_STEP = 0.1, 0.3, 10.0
"""The table within a hole is like the table around the part: to a tenth of its brightness, or to 0.3 of the step
from table to part where the outline of a hole was found; never better than noise allows (codes)."""
_SMALLEST, _LARGEST = 0.03, 0.65
"""Share of the part: what is smaller is a speck, what is larger leaves no part."""
_TOGETHER = 0.7
"""Share of what looks like the table that hangs together: stripes or dots of the table's colour are many."""


def blobs_like_table(
    planes: Planes, material: NDArray[np.bool_], table: NDArray[np.float32], flagged: Sequence[bool]
) -> NDArray[np.bool_]:
    """Where the table shows through each part, (N, h, w).

    Args:
        planes: ndarray of shape (N, 3, h, w), dtype uint8: blue, green and red of each part.
        material: ndarray of shape (N, h, w), dtype bool: within each part, away from its edges.
        table: ndarray of shape (N, 3): codes of the table around each.
        flagged: Of each whether the outline of a hole was found in it.
    """
    found = np.zeros(material.shape, bool)
    step = np.maximum(_ALIKE * table.max(axis=1, initial=0.0), _LEAST_STEP)
    for k in np.flatnonzero(flagged):
        # Found by its outline: what is nearer to the table than to the part shows, however uneven the light.
        contrast = np.abs(np.median(planes[k][:, material[k]], axis=1) - table[k]).max() if material[k].any() else 0.0
        step[k] = max(step[k], _NEARER * float(contrast))
    low = np.clip(np.floor(table - step[:, None]), 0, 255).astype(np.uint8)[:, :, None, None]
    high = np.clip(np.ceil(table + step[:, None]), 0, 255).astype(np.uint8)[:, :, None, None]
    # Most parts have none: every second pixel tells which need a closer look.
    some = material[:, ::2, ::2] & _within(planes[:, :, ::2, ::2], low, high)
    for k in np.flatnonzero(counts(some) > 0.5 * _SMALLEST * counts(material[:, ::2, ::2])):
        whole = np.count_nonzero(material[k])
        like = material[k] & _within(planes[k : k + 1], low[k : k + 1], high[k : k + 1])[0]
        mask = np.asarray(cv2.medianBlur(like.view(np.uint8), 3), np.uint8)
        count = cv2.countNonZero(mask)
        if _SMALLEST * whole < count < _LARGEST * whole:
            blob = _largest(mask, max(_TOGETHER * count, _SMALLEST * whole))
            if blob is not None:
                found[k] = blob
    return found


def _within(planes: Planes, low: Planes, high: Planes) -> NDArray[np.bool_]:
    """Where all three planes (N, 3, h, w) lie between two codes (N, 3, 1, 1)."""
    inside = (planes >= low) & (planes <= high)
    return np.asarray(inside[:, 0] & inside[:, 1] & inside[:, 2])


def counts(masks: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(N,) how many are true in each of masks (N, ...)."""
    packed = np.packbits(masks.reshape(len(masks), math.prod(masks.shape[1:])), axis=1)
    return np.asarray(np.bitwise_count(packed).sum(axis=1, dtype=np.intp))


def _largest(mask: Mask, least: float) -> NDArray[np.bool_] | None:
    """The largest blob of a mask, or None when it has fewer pixels than `least`."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    if stats[largest, cv2.CC_STAT_AREA] < least:
        return None
    return np.asarray(labels == largest)

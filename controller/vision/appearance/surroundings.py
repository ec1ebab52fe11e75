"""The colour of the empty table around each part: what tells of the light there."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection

_COARSE = 4
"""The table is looked at on every fourth pixel."""
_WIDER = 0.6
"""The table's colour is taken this share of the part's size around it."""
_ENOUGH = 24
_GRID = 20
"""The table is looked at where the lines of a grid of so many cross."""


def surroundings(image: NDArray[np.uint8], detections: Sequence[Detection]) -> NDArray[np.float32]:
    """Median BGR codes (N, 3) of the table around each detection, whatever else lies there left out."""
    coarse = image[::_COARSE, ::_COARSE]
    height, width = coarse.shape[:2]
    free = np.full((height, width), 255, np.uint8)
    for item in detections:
        cv2.fillPoly(free, [np.rint(item.outline_px / _COARSE).astype(np.int32)[:, None]], (0,))
    # A band of about 6 px around every part: its blur and the darkest of its shadow.
    free = np.asarray(cv2.erode(free, np.ones((3, 3), np.uint8)), np.uint8)
    if not len(detections):
        return np.empty((0, 3), np.float32)
    boxes: NDArray[np.float64] = np.array([list(item.bbox_px) for item in detections]) / _COARSE
    wider = np.asarray(np.maximum(_WIDER * boxes[:, 2:].max(axis=1), 3.0), np.float64)
    share = np.asarray((np.arange(_GRID) + 0.5) / _GRID, np.float64)
    # (N, GRID) columns and rows of a grid over each part and its surroundings.
    columns, rows = (
        np.floor((boxes[:, k] - wider).reshape(-1, 1) + np.outer(boxes[:, 2 + k] + 2.0 * wider, share)).astype(np.intp)
        for k in (0, 1)
    )
    inside_x = (columns >= 0) & (columns < width)
    inside_y = (rows >= 0) & (rows < height)
    columns, rows = columns.clip(0, width - 1), rows.clip(0, height - 1)
    clear = (free[rows[:, :, None], columns[:, None]] > 0) & inside_y[:, :, None] & inside_x[:, None]
    codes = image[rows[:, :, None] * _COARSE, columns[:, None] * _COARSE].reshape(len(boxes), -1, 3)
    clear = clear.reshape(len(boxes), -1)
    count = np.count_nonzero(clear, axis=1)
    # What is not table is sorted behind everything.
    ordered = np.where(clear[:, None], codes.transpose(0, 2, 1), np.uint16(256))
    ordered.sort(axis=2)
    at = np.arange(len(boxes))
    halves = (np.maximum(count - 1, 0) // 2, np.minimum(count // 2, clear.shape[1] - 1))
    out = 0.5 * (ordered[at, :, halves[0]].astype(np.float32) + ordered[at, :, halves[1]])
    few = count < _ENOUGH
    if few.any():
        rest = coarse[free > 0]
        out[few] = _median(rest if len(rest) else coarse.reshape(-1, 3))
    return np.asarray(out, np.float32)


def _median(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Median (3,) of codes (n, 3)."""
    ordered = np.sort(values, axis=0)
    middle = len(values) // 2
    return np.asarray(0.5 * (ordered[(len(values) - 1) // 2].astype(np.float32) + ordered[middle]), np.float32)

"""The colour of the empty table around each part: what tells of the light there."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection
from controller.vision.appearance.rings import Rings

_COARSE = 4
"""The table is looked at on every fourth pixel."""
_WIDER = 0.6
"""The table's colour is taken this share of the part's size around it."""
_ENOUGH = 12
_GRID = 10
"""The table is looked at where the lines of a grid of so many cross."""
_SHARE = (np.arange(_GRID) + 0.5) / _GRID
_NEIGHBOURS = np.ones((3, 3), np.uint8)


def surroundings(
    image: NDArray[np.uint8], detections: Sequence[Detection], rings: Rings
) -> NDArray[np.float32]:
    """Median BGR codes (N, 3) of the table around each detection, whatever else lies there left out.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8, BGR.
        detections: N parts.
        rings: Their outlines.
    """
    count = len(detections)
    if not count:
        return np.empty((0, 3), np.float32)
    coarse = image[::_COARSE, ::_COARSE]
    height, width = coarse.shape[:2]
    free = np.full((height, width), 255, np.uint8)
    for ring in rings.drawn(np.zeros((count, 2)), np.full(count, 1.0 / _COARSE), shift=0):
        cv2.fillPoly(free, [ring], (0,))
    # A band of about 6 px around every part: its blur and the darkest of its shadow.
    free = np.asarray(cv2.erode(free, _NEIGHBOURS), np.uint8)
    boxes: NDArray[np.float64] = np.array([item.bbox_px for item in detections]) / _COARSE
    wider = np.maximum(_WIDER * boxes[:, 2:].max(axis=1), 3.0)[:, None]
    # (N, 2, GRID) columns and rows of a grid over each part and its surroundings.
    lines = np.floor((boxes[:, :2] - wider)[:, :, None] + (boxes[:, 2:] + 2.0 * wider)[:, :, None] * _SHARE)
    most = np.array([[width - 1], [height - 1]])
    inside = (lines >= 0) & (lines <= most)
    columns, rows = np.clip(lines, 0, most).astype(np.intp).transpose(1, 0, 2)
    clear = (free.ravel()[(rows * width)[:, :, None] + columns[:, None]] > 0) & (
        inside[:, 1, :, None] & inside[:, 0, None]
    )
    places = (rows * (_COARSE * image.shape[1]))[:, :, None] + (columns * _COARSE)[:, None]
    codes = np.take(image.reshape(-1, 3), places.reshape(count, -1), axis=0)
    clear = clear.reshape(count, -1)
    found = np.count_nonzero(clear, axis=1)
    # What is not table is sorted behind everything.
    ordered = np.where(clear[:, None], codes.transpose(0, 2, 1), np.uint16(256))
    ordered.sort(axis=2)
    at = np.arange(count)
    halves = np.maximum(found - 1, 0) // 2, np.minimum(found // 2, clear.shape[1] - 1)
    out = 0.5 * (ordered[at, :, halves[0]].astype(np.float32) + ordered[at, :, halves[1]])
    few = found < _ENOUGH
    if few.any():
        rest = coarse[free > 0]
        out[few] = _median(rest if len(rest) else coarse.reshape(-1, 3))
    return np.asarray(out, np.float32)


def _median(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Median (3,) of codes (n, 3)."""
    ordered = np.sort(values, axis=0)
    middle = len(values) // 2
    return np.asarray(0.5 * (ordered[(len(values) - 1) // 2].astype(np.float32) + ordered[middle]), np.float32)

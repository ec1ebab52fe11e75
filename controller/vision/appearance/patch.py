"""The pixels that show the material of a part: inside its outline, away from its edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection

Image = NDArray[np.uint8]
Mask = NDArray[np.uint8]

_RIM = 0.07
"""How far inside the outline the material is looked at, share of the short side: beyond blur and side faces' edge."""
_LEAST_RIM = 1.5
"""px: the blur of a sharp lens."""
_COARSE = 4
"""The table is looked at on every fourth pixel."""
_WIDER = 0.6
"""The table's colour is taken this share of the part's size around it."""
_ALIKE, _NEARER, _LEAST_STEP = 0.1, 0.3, 10.0
"""The table within a hole is like the table around the part: to a tenth of its brightness, or to 0.3 of the step
from table to part where the outline of a hole was found; never better than noise allows (codes)."""
_ENOUGH = 24
_MOST = 400
"""Pixels of the table looked at around a part."""


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """One part cut out of its frame.

    Attributes:
        detection: The part.
        image: ndarray of shape (h, w, 3), dtype uint8, BGR: a view into the frame around the part.
        inside: ndarray of shape (h, w), dtype uint8: 255 within the outline.
        material: ndarray of shape (h, w), dtype uint8: 255 within the outline, away from edges and holes.
        solid: ndarray of shape (h, w), dtype uint8: 255 within the outline where there is no hole.
        corner: (x, y) of the cut's first pixel in the frame.
        table: ndarray of shape (3,): BGR codes of the empty table around the part.
    """

    detection: Detection
    image: Image
    inside: Mask
    material: Mask
    solid: Mask
    corner: tuple[int, int]
    table: NDArray[np.float64]


def cut_out(image: Image, detections: Sequence[Detection]) -> list[Patch | None]:
    """A patch for each detection; None for one too small or too far outside the picture to be looked at."""
    tables = surroundings(image, detections)
    return [_cut(image, item, table) for item, table in zip(detections, tables, strict=True)]


def surroundings(image: Image, detections: Sequence[Detection]) -> list[NDArray[np.float64]]:
    """Median BGR codes (3,) of the table around each detection, whatever else lies there left out."""
    coarse = image[::_COARSE, ::_COARSE]
    free = np.full(coarse.shape[:2], 255, np.uint8)
    for item in detections:
        ring = np.rint(item.outline_px / _COARSE).astype(np.int32)[:, None]
        cv2.fillPoly(free, [ring], (0,))
        # A band of about 6 px around every part: its blur and the darkest of its shadow.
        cv2.polylines(free, [ring], True, (0,), 3)
    everywhere: NDArray[np.float64] | None = None
    out = []
    for item in detections:
        x, y, w, h = (value / _COARSE for value in item.bbox_px)
        wider = max(_WIDER * max(w, h), 3.0)
        rows = slice(max(0, int(y - wider)), int(y + h + wider) + 1)
        columns = slice(max(0, int(x - wider)), int(x + w + wider) + 1)
        seen = coarse[rows, columns][free[rows, columns] > 0]
        if len(seen) >= _ENOUGH:
            out.append(np.median(seen[:: 1 + len(seen) // _MOST], axis=0))
            continue
        if everywhere is None:
            rest = coarse[free > 0]
            everywhere = np.asarray(np.median(rest if len(rest) else coarse.reshape(-1, 3), axis=0), np.float64)
        out.append(everywhere)
    return out


def _cut(image: Image, item: Detection, table: NDArray[np.float64]) -> Patch | None:
    height, width = image.shape[:2]
    low = np.maximum(np.floor(item.outline_px.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(item.outline_px.max(axis=0)).astype(int) + 2, (width, height))
    if (high - low).min() < 6:
        return None
    part = image[low[1] : high[1], low[0] : high[0]]
    ring = np.rint((item.outline_px - low) * 16.0).astype(np.int32)[:, None]
    inside = np.zeros(part.shape[:2], np.uint8)
    cv2.fillPoly(inside, [ring], (255,), shift=4)
    rim = max(_LEAST_RIM, _RIM * item.size_px[1])
    core: Mask = inside.copy()
    cv2.polylines(core, [np.rint(ring / 16.0).astype(np.int32)], True, (0,), max(1, 2 * round(rim) - 1))
    whole = cv2.countNonZero(core)
    if whole < 12:
        core, whole = inside, cv2.countNonZero(inside)
        if whole < 12:
            return None
    solid, material = inside, core
    step = _ALIKE * float(table.max())
    if "hole" in item.flags:
        # Found by its outline: what is nearer to the table than to the part shows, however uneven the light.
        contrast = np.abs(np.median(part[core > 0], axis=0) - table).max()
        step = max(step, _NEARER * float(contrast))
    hole = _hole(part, core, whole, table, max(step, _LEAST_STEP))
    if hole is not None:
        solid = inside & ~hole
        clear = core & ~np.asarray(cv2.dilate(hole, np.ones((5, 5), np.uint8)), np.uint8)
        material = clear if cv2.countNonZero(clear) >= 12 else core & ~hole
    return Patch(item, part, inside, material, solid, (int(low[0]), int(low[1])), table)


def _hole(part: Image, core: Mask, whole: int, table: NDArray[np.float64], step: float) -> Mask | None:
    """255 where the table shows through the part, or None.

    A hole has the table's colour to within a step (codes), hangs together, and leaves something of the part: stripes
    or dots of the table's colour are many, and a part of the table's own colour is no hole.
    """
    like = cv2.bitwise_and(cv2.inRange(part, np.floor(table - step), np.ceil(table + step)), core)
    like = cv2.medianBlur(like, 3)
    count = cv2.countNonZero(like)
    if not 0.03 * whole < count < 0.65 * whole:
        return None
    _, labels, stats, _ = cv2.connectedComponentsWithStats(like, connectivity=4)
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    if stats[largest, cv2.CC_STAT_AREA] < max(0.7 * count, 0.03 * whole):
        return None
    return np.asarray(cv2.inRange(labels, largest, largest), np.uint8)

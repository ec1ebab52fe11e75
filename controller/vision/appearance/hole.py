"""Holes in parts: where the table shows through. All parts of a frame are looked at together."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Planes = NDArray[np.uint8]
Masks = NDArray[np.bool_]

_ALIKE, _NEARER, _LEAST_STEP = 0.1, 0.3, 10.0
"""The table within a hole is like the table around the part: to a tenth of its brightness, or to 0.3 of the step
from table to part where the outline of a hole was found; never better than noise allows (codes)."""
_SMALLEST, _LARGEST = 0.03, 0.65
"""Share of the part: what is smaller is a speck, what is larger leaves no part."""
_TOGETHER = 0.7
"""Share of what looks like the table that hangs together: stripes or dots of the table's colour are many."""
_THIN = 2
"""Every second pixel of every second row tells a part's own brightness."""


def holes(planes: Planes, material: Masks, table: NDArray[np.float32], flagged: Sequence[bool]) -> Masks:
    """Where the table shows through parts: ndarray of shape (N, h, w), dtype bool.

    Args:
        planes: ndarray of shape (3, N, h, w), dtype uint8: blue, green and red of the parts.
        material: ndarray of shape (N, h, w), dtype bool: within each, away from its edges.
        table: ndarray of shape (N, 3), dtype float32: BGR codes of the table around each.
        flagged: Of each whether the outline of a hole was found in it.
    """
    out = np.zeros(material.shape, bool)
    step = _steps(planes, material, table, np.flatnonzero(flagged))[:, None]
    low = np.floor(np.maximum(table - step, 0.0)).astype(np.uint8).T[..., None, None]
    high = np.ceil(np.minimum(table + step, 255.0)).astype(np.uint8).T[..., None, None]
    like = ((planes >= low) & (planes <= high)).all(axis=0) & material
    whole = counts(material)
    chosen = np.flatnonzero(counts(like) > 0.5 * _SMALLEST * whole)
    if len(chosen):
        out[chosen] = _largest_blobs(_most_of_three_by_three(like[chosen]), whole[chosen])
    return out


def counts(masks: Masks) -> NDArray[np.intp]:
    """(N,) how many are true in each of masks (N, ...)."""
    packed = np.packbits(masks.reshape(len(masks), math.prod(masks.shape[1:])), axis=1)
    return np.asarray(np.bitwise_count(packed).sum(axis=1, dtype=np.intp))


def _steps(
    planes: Planes, material: Masks, table: NDArray[np.float32], flagged: NDArray[np.intp]
) -> NDArray[np.float32]:
    """(N,) codes by which the table within a hole may differ from the table around the part."""
    step: NDArray[np.float32] = np.maximum(_ALIKE * table.max(axis=1, initial=0.0), _LEAST_STEP)
    if len(flagged):
        # What is nearer to the table than to the part shows the table, however uneven the light.
        thin = slice(None, None, _THIN)
        within = material[flagged, thin, thin].reshape(len(flagged), -1)
        # Codes of 16 bits: numpy sorts them ten times as fast as those of 8. What is beyond goes behind everything.
        codes = np.where(within, planes[:, flagged, thin, thin].reshape(3, len(flagged), -1), np.uint16(256))
        codes.sort(axis=2)
        own = codes[:, np.arange(len(flagged)), counts(within) // 2].T
        step[flagged] = np.maximum(step[flagged], _NEARER * np.abs(own - table[flagged]).max(axis=1))
    return step


def _most_of_three_by_three(like: Masks) -> NDArray[np.uint8]:
    """(n, h + 1, w): 1 where most of 3 x 3 pixels are true; a row of 0 keeps the masks (n, h, w) apart."""
    count, height, width = like.shape
    sheet = np.zeros((count, height + 1, width), np.uint8)
    sheet[:, :height] = like
    near = cv2.boxFilter(sheet.reshape(-1, width), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    most = (np.asarray(near) > 4).reshape(sheet.shape).view(np.uint8)
    most[:, height] = 0
    return most


def _largest_blobs(sheet: NDArray[np.uint8], whole: NDArray[np.intp]) -> Masks:
    """(n, h, w) the largest blob of each of masks (n, h + 1, w), nothing where that is no hole.

    Args:
        sheet: Their last rows are 0.
        whole: Pixels of each part.
    """
    count, height, width = sheet.shape
    _, labels, stats, _ = cv2.connectedComponentsWithStats(sheet.reshape(-1, width), connectivity=4)
    area, owner = stats[1:, cv2.CC_STAT_AREA], stats[1:, cv2.CC_STAT_TOP] // height
    # The last label written for an owner is that of its largest blob.
    order = np.argsort(area, kind="stable")
    largest, most = np.zeros(count, np.intp), np.zeros(count, np.intp)
    largest[owner[order]] = order + 1
    most[owner[order]] = area[order]
    total = np.bincount(owner, area, count)
    hole = (total > _SMALLEST * whole) & (total < _LARGEST * whole)
    hole &= most >= np.maximum(_TOGETHER * total, _SMALLEST * whole)
    # No pixel has the label -1.
    wanted = np.where(hole, largest, -1)
    return np.asarray(labels.reshape(sheet.shape)[:, : height - 1] == wanted[:, None, None])

"""Sheets of paper, trays and lit plates: what covers much of the frame and holds several things is their table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.geometry import CameraModel, PlaneMap
from controller.vision.scene import Found

_LARGE = 0.25
"""Share of the frame that a sheet covers at least: no part to be sorted is as large."""
_RIM = 6
"""How far within its outline, px, a sheet begins to count: its own edge is no part."""
_THINGS = 2
"""So many things on it make a sheet; one may be the print or the hole of a large part."""
_WHOLE = 0.5
"""Share of the sheet that none of the things on it covers."""


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """What may be a sheet, cut out of the frame.

    Attributes:
        item: How it was found.
        image: ndarray of shape (h, w, 3), dtype uint8: its part of the frame, all beside it filled with its colour.
        beside: ndarray of shape (h, w), dtype uint8: not 0 beside it.
        corner: (x, y) of the cut in the frame.
        plane: The plane as the cut's pixels see it, or None.
    """

    item: Found
    image: NDArray[np.uint8]
    beside: NDArray[np.uint8]
    corner: NDArray[np.intp]
    plane: PlaneMap | None


def sheets(found: Sequence[Found], image: NDArray[np.uint8], plane: PlaneMap | None) -> list[Sheet]:
    """What is large enough for a sheet."""
    out = []
    height, width = image.shape[:2]
    for item in found:
        outline = item.face.astype(np.float32)
        if abs(cv2.contourArea(outline)) < _LARGE * height * width:
            continue
        x, y, w, h = cv2.boundingRect(np.rint(outline).astype(np.int32))
        x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + w, width), min(y + h, height)
        inside = np.zeros((y1 - y0, x1 - x0), np.uint8)
        cv2.fillPoly(inside, [np.rint(outline).astype(np.int32) - np.array([x0, y0], np.int32)], (255,))
        inside = np.asarray(cv2.erode(inside, np.ones((2 * _RIM + 1, 2 * _RIM + 1), np.uint8)), np.uint8)
        part = image[y0:y1, x0:x1].copy()
        part[inside == 0] = np.median(part[inside > 0], axis=0)
        out.append(Sheet(item, part, 255 - inside, np.array([x0, y0]), _seen_from(plane, x0, y0, part.shape)))
    return out


def _seen_from(plane: PlaneMap | None, x: int, y: int, shape: tuple[int, ...]) -> PlaneMap | None:
    """The same plane for a part of the picture whose first pixel is (x, y)."""
    if plane is None:
        return None
    matrix = plane.camera.matrix.copy()
    matrix[:2, 2] -= (x, y)
    return replace(plane, camera=CameraModel(matrix, plane.camera.distortion, (shape[1], shape[0])))


def unpacked(found: Sequence[Found], sheet: Sheet, things: Sequence[Found]) -> list[Found]:
    """All that was found, with the things on a sheet in the place of the sheet, if it is one."""
    covered = abs(cv2.contourArea(sheet.item.face.astype(np.float32)))
    small = [item for item in things if abs(cv2.contourArea(item.face.astype(np.float32))) < (1.0 - _WHOLE) * covered]
    if len(small) < _THINGS:
        return list(found)
    polygon = sheet.item.face.astype(np.float32)
    beside = [
        item for item in found
        if cv2.pointPolygonTest(polygon, (float(item.center[0]), float(item.center[1])), False) < 0.0
    ]  # fmt: skip
    moved = [
        replace(item, face=item.face + sheet.corner, outline=item.outline + sheet.corner,
                center=item.center + sheet.corner)
        for item in small
    ]  # fmt: skip
    return [*beside, *moved]

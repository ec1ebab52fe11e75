"""A class from a drawing: the views a camera would have of the outline; colour, texture and print are left open."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Descriptors, Detection, Frame, Shape
from controller.vision.appearance.look import look
from controller.vision.appearance.settings import Appearance
from controller.vision.classes.features import OPEN_BLOCKS, Floats32, block, features
from controller.vision.classes.markings import SIDE
from controller.vision.classes.store import TaughtClass
from controller.vision.drawings.outline import Floats, Outline

_ROOTS_PX = (45.0, 75.0, 110.0)
"""Roots of the area the part is drawn with, px: as cameras over a table see parts."""
_TURNS = 4
_TABLE, _PART = 200, 60
_DENSE = 96


def drawn_class(name: str, outline: Outline, height_mm: float, source: str) -> TaughtClass:
    """The class of parts with this outline.

    Args:
        name: What it is called.
        outline: From a drawing, mm.
        height_mm: Of the parts.
        source: Where the drawing came from.
    """
    rows = [
        _view(outline, root, 2.0 * math.pi * (k + 0.3) / _TURNS) for root in _ROOTS_PX for k in range(_TURNS)
    ]
    views = np.concatenate(rows)
    views[:, block("size")] = math.log(math.sqrt(outline.area))
    for open_ in OPEN_BLOCKS:
        views[:, block(open_)] = np.nan
    prints = np.zeros((len(views), SIDE, SIDE), np.uint8)
    return TaughtClass(name, "mm", views, (source,) * len(views), prints, height_mm)


def _view(outline: Outline, root: float, turn: float) -> Floats32:
    """(1, LENGTH): the features of the outline drawn so large and turned so."""
    scale = root / math.sqrt(outline.area)
    c, s = math.cos(turn), math.sin(turn)
    # Drawings have y up, pictures down.
    way = np.array([[c, s], [-s, c]]) * (scale, -scale)
    outer = outline.outer @ way
    low = outer.min(axis=0) - 0.7 * root - 8.0
    width, height = (int(v) for v in np.ceil(np.ptp(outer, axis=0) + 1.4 * root + 16.0))
    picture = np.full((height, width, 3), _TABLE, np.uint8)
    _fill(picture, outer - low, _PART)
    for hole in outline.holes:
        _fill(picture, hole @ way - low, _TABLE)
    ring = _even(outer - low)
    frame = Frame(1, 0.0, picture)
    moments = cv2.moments(ring.astype(np.float32))
    center = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
    x, y = ring.min(axis=0)
    w, h = np.ptp(ring, axis=0)
    _, (a, b), _ = cv2.minAreaRect(ring.astype(np.float32))
    seen = Detection(
        frame, Shape.OTHER, 1.0, ring, center, (max(a, b), min(a, b)), 0.0, outline.area * scale**2,
        (float(x), float(y), float(w), float(h)), Descriptors(1.0, 1.0, 0.0),
        flags=frozenset({"hole"} if outline.holes else ()),
    )  # fmt: skip
    return features([seen], look(picture, [seen], Appearance(reference="none")), None)


def _fill(picture: NDArray[np.uint8], ring: Floats, code: int) -> None:
    points = np.rint(ring * 16.0).astype(np.int32)[:, None]
    cv2.fillPoly(picture, [points], (code, code, code), shift=4, lineType=cv2.LINE_AA)


def _even(ring: Floats) -> Floats:
    """The ring with no side longer than a hundredth of its way around; corners stay."""
    ahead = np.roll(ring, -1, axis=0)
    length = np.linalg.norm(ahead - ring, axis=1)
    pieces = np.maximum(1, np.ceil(_DENSE * length / length.sum())).astype(int)
    parts = [p + (q - p) * (np.arange(n) / n)[:, None] for p, q, n in zip(ring, ahead, pieces, strict=True)]
    return np.concatenate(parts)

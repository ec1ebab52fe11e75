"""Which objects touch: the flag tells the planner that fingers may not fit between, and people where to look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.scene import Found, boxes, neighbours, outside

_GAP = 2.5
"""Outlines nearer than this, px, touch: their edges are blurred into each other by about as much."""
_WIDER = np.array([-_GAP, -_GAP, _GAP, _GAP])


def with_contacts(found: Sequence[Found]) -> list[Found]:
    """The objects, `touching` added to the flags of those whose faces lie within a few pixels of another's."""
    if len(found) < 2:
        return list(found)
    near = neighbours(boxes([item.face for item in found]) + _WIDER)
    touching: set[int] = set()
    for i, others in enumerate(near):
        for j in others:
            if not {i, j} <= touching and _reaches(found[i], found[j]):
                touching |= {i, j}
    return [replace(item, flags=item.flags | {"touching"}) if i in touching else item for i, item in enumerate(found)]


def _reaches(item: Found, other: Found) -> bool:
    """Whether a point just outside one face lies in the other."""
    polygon: NDArray[np.float32] = other.face.astype(np.float32)
    points = np.concatenate([outside([item.face], [_GAP], 96)[0, 0], item.face])
    near = ((points >= polygon.min(axis=0)) & (points <= polygon.max(axis=0))).all(axis=1)
    return any(cv2.pointPolygonTest(polygon, (float(x), float(y)), False) >= 0.0 for x, y in points[near])

"""Which objects touch: the flag tells the planner that fingers may not fit between, and people where to look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.scene import Found, boxes, neighbours, outside

Floats = NDArray[np.float64]

_GAP = 2.5
"""Outlines nearer than this, px, touch: their edges are blurred into each other by about as much."""
_WIDER = np.array([-_GAP, -_GAP, _GAP, _GAP])


def with_contacts(found: Sequence[Found]) -> list[Found]:
    """The objects, `touching` added to the flags of those whose faces lie within a few pixels of another's."""
    if len(found) < 2:
        return list(found)
    faces = [item.face for item in found]
    around = outside(faces, [_GAP], 96)[0]
    touching: set[int] = set()
    for i, others in enumerate(neighbours(boxes(faces) + _WIDER)):
        points = np.concatenate([around[i], faces[i]])
        for j in others:
            if not {i, j} <= touching and _reaches(points, faces[j]):
                touching |= {i, j}
    return [replace(item, flags=item.flags | {"touching"}) if i in touching else item for i, item in enumerate(found)]


def _reaches(points: Floats, face: Floats) -> bool:
    """Whether one of some points (N, 2) lies in a face (M, 2)."""
    polygon: NDArray[np.float32] = face.astype(np.float32)
    near = ((points >= polygon.min(axis=0)) & (points <= polygon.max(axis=0))).all(axis=1)
    return any(cv2.pointPolygonTest(polygon, (float(x), float(y)), False) >= 0.0 for x, y in points[near])

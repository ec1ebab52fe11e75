"""Printed markers in the corners of the table, in view all the time: where they were when the table was measured.

A camera, or a table, that was moved by a fraction of a millimetre shows at once, to a tenth of a pixel, and by which
marker: the scenery alone tells moves of a millimetre and more.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

DICTIONARY = "DICT_4X4_50"
#: Ids of the corner markers; 0 is the gripper's.
IDS = (1, 2, 3, 4)
#: Side of a marker's black square, mm.
SIZE_MM = 30.0
#: Markers seen this far from their places, px in the median, have been moved against the camera: 0.5 mm in an
#: ordinary cell. Noise, light and a passing shadow move them by 0.1 px.
MOVED = 1.0
#: How far about its place a marker is looked for, px.
_AROUND = 30


class Landmarks:
    """Corner markers and where they belong.

    Args:
        places: Corners (4, 2), px, by id.
    """

    def __init__(self, places: Mapping[int, Array]) -> None:
        self.places = dict(places)

    def displacement(self, image: Image) -> float | None:
        """How far the markers in sight lie from their places, px, the median over them; None when none is in sight.

        Hidden ones say nothing: the arm and its shadow pass over them.
        """
        found = []
        for name, place in self.places.items():
            seen = self._near(image, name, place)
            if seen is not None:
                found.append(float(np.linalg.norm(seen - place, axis=1).mean()))
        if not found and self.places:
            # None near its place: somewhere else, or all hidden.
            everywhere = find_landmarks(image)
            found = [
                float(np.linalg.norm(everywhere[name] - place, axis=1).mean())
                for name, place in self.places.items()
                if name in everywhere
            ]
        return float(np.median(found)) if found else None

    def _near(self, image: Image, name: int, place: Array) -> Array | None:
        height, width = image.shape[:2]
        low = np.maximum(np.floor(place.min(axis=0)).astype(int) - _AROUND, 0)
        high = np.minimum(np.ceil(place.max(axis=0)).astype(int) + _AROUND, [width, height])
        if (high - low < _AROUND).any():
            return None
        seen = find_landmarks(np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])).get(name)
        return None if seen is None else seen + low


def find_landmarks(image: Image) -> dict[int, Array]:
    """Corners (4, 2), px, of every corner marker in a picture, shape (H, W, 3) or (H, W), by id."""
    corners, ids, _ = _detector().detectMarkers(image)
    names = [] if ids is None else [int(name) for name in ids.ravel()]
    return {
        name: np.asarray(quad, np.float64).reshape(4, 2)
        for name, quad in zip(names, corners, strict=True)
        if name in IDS and names.count(name) == 1
    }


@cache
def _detector() -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = 3
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY)), parameters)

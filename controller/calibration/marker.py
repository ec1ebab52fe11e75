"""The printed marker on the gripper, by which the camera sees where the arm is."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def _plate() -> Array:
    pose = np.eye(4)
    pose[:3, :3] = [[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    pose[:3, 3] = -60.0, 0.0, 52.0
    return pose


@dataclass(frozen=True, slots=True, eq=False)
class ArmMarker:
    """An ArUco marker on a plate that sticks out of the gripper and faces back along the tool.

    Attributes:
        dictionary: OpenCV's name of the dictionary.
        marker_id: Which of its markers.
        size: Side of the black square, mm.
        margin: White border around it, mm.
        T_tool_marker: ndarray of shape (4, 4): its place by drawing (origin in its middle, x to its right,
            y to its top, z towards the reader, mm), good to a few mm and degrees.
    """

    dictionary: str = "DICT_4X4_50"
    marker_id: int = 0
    size: float = 30.0
    margin: float = 5.0
    T_tool_marker: Array = field(default_factory=_plate)

    @property
    def corners(self) -> Array:
        """Corners (4, 3) in the marker's own coordinates, in the order they are found, mm."""
        half = self.size / 2
        return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])

    @property
    def plate(self) -> Array:
        """Corners (4, 3) of the paper in the marker's own coordinates, mm."""
        return self.corners * (1.0 + 2.0 * self.margin / self.size)

    def find(self, image: NDArray[np.uint8]) -> Array | None:
        """Corners (4, 2), px, from its upper left clockwise as read; None when it is not seen."""
        found, ids, _ = _detector(self.dictionary).detectMarkers(image)
        mine = [corners for corners, name in zip(found, () if ids is None else ids.ravel(), strict=True)
                if name == self.marker_id]
        return np.asarray(mine[0], np.float64).reshape(4, 2) if len(mine) == 1 else None


@cache
def _detector(dictionary: str) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    # Lines fitted to the whole border are better than a window around each corner of a small marker.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    return cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)), parameters
    )

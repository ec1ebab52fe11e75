"""The printed marker on the gripper, by which the camera sees where the arm is."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration import edges
from controller.geometry import CameraModel

Array = NDArray[np.float64]


def _plate() -> Array:
    pose = np.eye(4)
    pose[:3, :3] = [[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    pose[:3, 3] = -60.0, 0.0, 62.0
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

    def find(self, image: NDArray[np.uint8], camera: CameraModel) -> Array | None:
        """Corners (4, 2), px, from its upper left clockwise as read; None when it is not seen."""
        found, ids, _ = _detector(self.dictionary).detectMarkers(image)
        names = () if ids is None else ids.ravel()
        mine = [corners for corners, name in zip(found, names, strict=True) if name == self.marker_id]
        if len(mine) != 1:
            return None
        gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        return refine_square(gray, np.asarray(mine[0], np.float64).reshape(4, 2), camera)


def refine_square(gray: NDArray[np.uint8], corners: Array, camera: CameraModel) -> Array:
    """Corners (4, 2) of a dark square on white as crossings of lines fitted to its sides, px.

    The sides hold far more of the picture than windows around the corners: 0.02 px per axis where
    `cornerSubPix` gives 0.15 and OpenCV's own fit to the thresholded contour 0.5. The lens is undone before
    a line is fitted: over 70 px it bends one by 0.1 px. Where a side cannot be followed all stay as they are.
    """
    lines = []
    for a, b, c, d in (np.roll(corners, -side, axis=0) for side in range(4)):
        along = (b - a) / np.linalg.norm(b - a)
        normal = np.array([along[1], -along[0]])
        # The border is a sixth of the marker (4 by 4 cells within it): the window ends inside it.
        reach = float(np.clip(0.7 * abs(normal @ ((c + d) / 2 - (a + b) / 2)) / 6, 1.5, 3.0))
        places = a + np.linspace(0.12, 0.88, _PLACES)[:, None] * (b - a)
        across = np.tile(normal, (_PLACES, 1))
        off = edges.offsets(gray, places, across, np.full(_PLACES, reach))
        on = (places + off[:, None] * across)[np.isfinite(off)]
        if len(on) < _PLACES // 2:
            return corners
        lines.append(edges.line(camera.rays(on)[:, :2]))
    crossings = np.array([np.cross(lines[index - 1], line) for index, line in enumerate(lines)])
    return camera.project(crossings / crossings[:, 2:])


#: Points along a side.
_PLACES = 24


@cache
def _detector(dictionary: str) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)), parameters
    )

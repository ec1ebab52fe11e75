"""Exact silhouettes of prisms, worked out on their own: points on the hull of the projected solid."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from controller.domain import CellCalibration, Descriptors, Detection, Frame, Shape
from controller.geometry import CameraModel, pose, pose_from_rvec

Array = NDArray[np.float64]

CAMERA = CameraModel(
    np.array([[1004.6, 0.0, 648.6], [0.0, 1004.6, 352.8], [0.0, 0.0, 1.0]]),
    np.array([-0.25, 0.06, 0.0006, -0.0004, 0.0]),
    (1280, 720),
)
FRAME = Frame(1, 0.0, np.zeros((720, 1280, 3), np.uint8))


def cell(tilt: float = 0.0, towards: float = 0.0) -> CellCalibration:
    """A camera 600 mm up, its optical axis `tilt` rad off the vertical."""
    lean = pose_from_rvec([tilt * math.cos(towards), tilt * math.sin(towards), 0.0], [0.0, 0.0, 0.0])
    down = pose_from_rvec([math.pi, 0.0, 0.0], [0.0, 0.0, 0.0])
    T_table_camera = pose(12.0, -7.0, 600.0, yaw=1.5) @ lean @ down
    return CellCalibration("cell-test", CAMERA, T_table_camera, np.eye(4))


def polygon(shape: Shape, size: float, aspect: float = 1.5) -> Array:
    """Footprint at yaw 0 about its centroid; `size` is the short side of its minimum-area rectangle."""
    if shape is Shape.CIRCLE:
        turns = 2 * math.pi / 2000 * np.arange(2000)
        return np.asarray(size / 2 * np.column_stack([np.cos(turns), np.sin(turns)]))
    if shape is Shape.HEXAGON:
        turns = math.pi / 3 * np.arange(6)
        return np.asarray(size / math.sqrt(3) * np.column_stack([np.cos(turns), np.sin(turns)]))
    if shape is Shape.TRIANGLE:
        turns = math.pi / 2 + 2 * math.pi / 3 * np.arange(3)
        return np.asarray(size * 2 / 3 * np.column_stack([np.cos(turns), np.sin(turns)]))
    long = size * (aspect if shape is Shape.RECTANGLE else 1.0)
    return np.array([[-long, -size], [long, -size], [long, size], [-long, size]]) / 2


def outline(feet: Array, height: float, calibration: CellCalibration, step_px: float = 1.0) -> tuple[Array, Array]:
    """Outline (N, 2), px, counter-clockwise as displayed, and the edge (N,) each point lies on."""
    solid = np.vstack([np.column_stack([feet, np.full(len(feet), z)]) for z in (0.0, height)])
    T = np.linalg.inv(calibration.T_table_camera)
    seen = solid @ T[:3, :3].T + T[:3, 3]
    flat = seen[:, :2] / seen[:, 2:]
    corners = flat[ConvexHull(flat).vertices]
    pieces, names = [], []
    for index, (a, b) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        count = max(1, round(np.linalg.norm(b - a) * 1000.0 / step_px))
        pieces.append(a + (b - a) * (np.arange(count) / count)[:, None])
        names.append(np.full(count, index))
    points = np.vstack(pieces)
    pixels = calibration.camera.project(np.column_stack([points, np.ones(len(points))]))
    return pixels[::-1], np.concatenate(names)[::-1]


def detection(shape: Shape, pixels: Array, angle: float | None, flags: frozenset[str] = frozenset()) -> Detection:
    """What an ideal vision would hand over."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    center = pixels.mean(axis=0)
    long = float(np.linalg.norm(high - low))
    return Detection(
        FRAME,
        shape,
        1.0,
        pixels,
        (float(center[0]), float(center[1])),
        (long, long),
        angle,
        long**2,
        (float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])),
        Descriptors(1.0, 1.0, 0.0),
        shape.value,
        flags,
    )

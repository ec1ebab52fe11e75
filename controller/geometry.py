"""Poses and the camera model: the arithmetic that every station of the walk shares.

Lengths are mm, angles rad. `T_a_b` is a (4, 4) matrix that maps points given in `b` into `a`.
Camera coordinates are OpenCV's (x right, y down, z forward); pixels are (x right, y down) with integers
at pixel centres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, *, yaw: float = 0.0) -> Array:
    """Rigid pose of a frame turned by `yaw` about z and moved to (x, y, z); shape (4, 4)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def pose_from_rvec(rvec: ArrayLike, tvec: ArrayLike) -> Array:
    """Rigid pose, shape (4, 4), from a Rodrigues vector (rad) and a translation (mm)."""
    transform_ = np.eye(4)
    transform_[:3, :3] = cv2.Rodrigues(np.asarray(rvec, np.float64).reshape(3, 1))[0]
    transform_[:3, 3] = np.asarray(tvec, np.float64).reshape(3)
    return transform_


def rvec_tvec(transform_: Array) -> tuple[Array, Array]:
    """Rodrigues vector (3,) and translation (3,) of a rigid pose of shape (4, 4)."""
    rotation = np.ascontiguousarray(transform_[:3, :3])
    skew = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    if np.abs(skew).max() < 1e-4 and np.trace(rotation) > 0.0:
        # Rodrigues takes turns below 1e-5 rad for none; here the sine is the angle to 1e-13.
        rvec = skew / 2.0
    else:
        rvec = np.asarray(cv2.Rodrigues(rotation)[0], np.float64).reshape(3)
    return rvec, np.asarray(transform_[:3, 3], np.float64)


def invert(transform_: Array) -> Array:
    """Inverse of a rigid pose of shape (4, 4)."""
    rotation = transform_[:3, :3]
    out = np.eye(4)
    out[:3, :3] = rotation.T
    out[:3, 3] = -rotation.T @ transform_[:3, 3]
    return out


def transform(transform_: Array, points: ArrayLike) -> Array:
    """Points of shape (..., 3) mapped by a rigid pose of shape (4, 4)."""
    return np.asarray(np.asarray(points, np.float64) @ transform_[:3, :3].T + transform_[:3, 3])


def rigidity_error(transform_: Array) -> float:
    """How far the rotation of a pose is from orthonormal and right-handed (0 for a proper pose)."""
    rotation = transform_[:3, :3]
    if not (np.abs(rotation) <= 2.0).all():  # the entries of a rotation are at most 1; NaN is none either
        return math.inf
    return float(np.abs(rotation @ rotation.T - np.eye(3)).max() + abs(np.linalg.det(rotation) - 1.0))


def wrap(angle: float, period: float = 2.0 * math.pi) -> float:
    """`angle` brought into [0, period)."""
    wrapped = math.fmod(angle, period)
    if wrapped < 0.0:
        wrapped += period
    return 0.0 if wrapped >= period else wrapped


def angle_difference(a: float, b: float, period: float = 2.0 * math.pi) -> float:
    """Smallest signed turn from `b` to `a` modulo `period`, in [-period/2, period/2)."""
    return wrap(a - b + period / 2.0, period) - period / 2.0


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Pinhole camera with OpenCV's lens model.

    Attributes:
        matrix: ndarray of shape (3, 3), [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], px.
        distortion: ndarray of shape (4,), (5,), (8,), (12,) or (14,), OpenCV's order.
        image_size: (width, height), px.
    """

    matrix: Array
    distortion: Array
    image_size: tuple[int, int]

    def project(self, points: ArrayLike) -> Array:
        """Pixels (N, 2) of points (N, 3) given in `camera`, mm."""
        zero: Any = np.zeros(3)
        objects = np.asarray(points, np.float64).reshape(-1, 1, 3)
        pixels, _ = cv2.projectPoints(objects, zero, zero, self.matrix, self.distortion)
        return np.asarray(pixels, np.float64).reshape(-1, 2)

    def rays(self, pixels: ArrayLike) -> Array:
        """Directions (N, 3) in `camera` with z = 1 through pixels (N, 2), the lens undone."""
        points = np.asarray(pixels, np.float64).reshape(-1, 1, 2)
        # OpenCV's default of 5 fixed-point rounds leaves 0.1 px near the corners of a wide lens.
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-10)
        # The stub has no None for R and P, which means identity.
        normalised = cv2.undistortPointsIter(points, self.matrix, self.distortion, None, None, criteria)  # type: ignore[call-overload]
        out = np.ones((len(points), 3))
        out[:, :2] = np.asarray(normalised).reshape(-1, 2)
        return out


@dataclass(frozen=True, slots=True)
class PlaneMap:
    """The one-to-one map between pixels and the plane z = `height` of `table`.

    Attributes:
        camera: The lens.
        T_table_camera: ndarray of shape (4, 4), maps `camera` into `table`.
        height: z of the plane in `table`, mm.
    """

    camera: CameraModel
    T_table_camera: Array
    height: float = 0.0

    def at(self, height: float) -> PlaneMap:
        """The same camera over the plane z = `height` (mm)."""
        return PlaneMap(self.camera, self.T_table_camera, height)

    def to_plane(self, pixels: ArrayLike, heights: ArrayLike | None = None) -> Array:
        """Points (N, 2) in `table`, mm, where the rays through pixels (N, 2) meet the plane.

        A ray that never meets the plane in front of the camera gives nan.

        Args:
            pixels: ndarray of shape (N, 2), px.
            heights: ndarray of shape (N,), mm: the plane each ray is to meet instead.
        """
        rays = self.camera.rays(pixels) @ self.T_table_camera[:3, :3].T
        origin = self.T_table_camera[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = ((self.height if heights is None else np.asarray(heights)) - origin[2]) / rays[:, 2]
            scale[~(scale > 0.0)] = np.nan
            return np.asarray(origin[:2] + rays[:, :2] * scale[:, None])

    def to_pixels(self, points: ArrayLike) -> Array:
        """Pixels (N, 2) of points (N, 2) of the plane, given in `table`, mm."""
        flat = np.asarray(points, np.float64).reshape(-1, 2)
        lifted = np.empty((len(flat), 3))
        lifted[:, :2], lifted[:, 2] = flat, self.height
        # Backwards through the pose, without its inverse.
        return self.camera.project((lifted - self.T_table_camera[:3, 3]) @ self.T_table_camera[:3, :3])

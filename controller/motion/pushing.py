"""What a straight push with the closed jaws does to a part: where they meet it, what it may meet, how it comes to lie.

Planar, in `table` (mm, rad).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Array, Gripper, LocatedObject
from controller.geometry import wrap
from controller.motion import grasps

BUMP = 3.0  # mm a pushed part keeps from others, unless it lies nearer already and goes away from them
_TOUCHED = 0.5  # mm: nearer than at first by more, it would push what it lies beside
_CORNERS = 16  # of what has no fewer


def keeps_clear(hull: Array, poses: Array, points: Array) -> NDArray[np.bool_]:
    """Whether a hull that is moved keeps away from points of obstacles, in each pose and all before: (P, T).

    Args:
        hull: ndarray of shape (H, 2): its corners about its middle, counter-clockwise, mm.
        poses: ndarray of shape (P, T, 3): it moved by (dx, dy) mm and turned by rad.
        points: ndarray of shape (N, 2), mm.
    """
    sides = np.roll(hull, -1, axis=0) - hull
    normals = np.column_stack([sides[:, 1], -sides[:, 0]]) / np.linalg.norm(sides, axis=1)[:, None]
    offsets = (normals * hull).sum(axis=1)
    wanted = np.minimum((points @ normals.T - offsets).max(axis=1) - _TOUCHED, BUMP)
    c, s = np.cos(poses[..., 2:]), np.sin(poses[..., 2:])
    turned = np.stack([c * normals[:, 0] - s * normals[:, 1], s * normals[:, 0] + c * normals[:, 1]], axis=-2)
    shifts = (poses[..., None, :2] @ turned)[..., 0, :] + offsets
    apart = (points @ turned - shifts[..., None, :]).max(axis=-1)
    return np.logical_and.accumulate((apart >= wanted).all(axis=-1), axis=1)


def finger_edges(gripper: Gripper, direction: float, ahead: Array, left: Array) -> Array:
    """Edges of the two closed fingers about the gripper's middle: ndarray of shape (8, 2, 2), (ahead, left) in mm.

    Between fingers closed as far as they go there still is their narrowest opening, into which a corner fits.
    """
    thickness, across = gripper.jaw_size
    inner = gripper.opening[0] / 2.0
    outer, half = inner + thickness, across / 2.0
    finger = np.array([[inner, -half], [outer, -half], [outer, half], [inner, half]])
    c, s = math.cos(direction), math.sin(direction)
    turn = np.array([[c, s], [-s, c]]) @ np.column_stack([ahead, left])
    placed = np.stack([finger, finger * [-1.0, 1.0]]) @ turn
    return np.stack([placed, placed[:, [1, 2, 3, 0]]], axis=2).reshape(8, 2, 2)


def contact(fingers: Array, along: Array, beside: Array) -> float:
    """How far fingers go ahead until they meet points of a rim, mm; inf when they pass on both sides of it.

    Args:
        fingers: See `finger_edges`.
        along: ndarray of shape (N,): the points, ahead of the gripper's middle.
        beside: ndarray of shape (N,): the points, left of it.
    """
    start, end = fingers[:, 0], fingers[:, 1]
    across = end[:, 1] - start[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (beside[:, None] - start[:, 1]) / across
        front = start[:, 0] + share * (end[:, 0] - start[:, 0])
    return float((along[:, None] - np.where((share >= 0.0) & (share <= 1.0), front, -math.inf)).min())


def rim_of(hull: Array) -> Array:
    """Points (N, 2) every 2 mm along a hull's sides, and its corners."""
    return np.vstack([hull, grasps.dense(hull)])


def shifted(part: LocatedObject, by: Sequence[float] | Array) -> LocatedObject:
    """A part moved by (dx, dy) mm and turned by rad about its middle."""
    dx, dy, turn = map(float, by)
    x, y = part.center
    c, s = math.cos(turn), math.sin(turn)
    footprint = (part.footprint - part.center) @ np.array([[c, s], [-s, c]]) + (x + dx, y + dy)
    period = part.shape.period
    yaw = None if part.yaw is None or period is None else wrap(part.yaw + turn, period)
    return replace(part, center=(x + dx, y + dy), footprint=footprint, yaw=yaw)


def coarse(hull: Array) -> Array:
    """A hull with at most 16 corners or so: as many as a round part needs to slide like one."""
    return hull[:: max(len(hull) // _CORNERS, 1)]


def hull_of(part: LocatedObject) -> Array:
    """Convex hull of the footprint, counter-clockwise: ndarray of shape (N, 2), mm."""
    hull = cv2.convexHull(part.footprint.astype(np.float32)).reshape(-1, 2).astype(np.float64)
    x, y = hull.T
    signed = float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return hull if signed > 0.0 else hull[::-1]

"""What a straight push with the closed jaws does to a part: where they meet it, how far it may go, how it comes to lie.

Planar, in `table` (mm, rad).
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from controller.domain import Array, Gripper, LocatedObject, Shape
from controller.geometry import wrap
from controller.motion import grasps

BUMP = 3.0  # mm a pushed part keeps from others: it may turn a little on its way
_LARGEST_TURN = math.radians(50.0)  # a pushed part turns until a side lies against the box: 45 deg for a square
_HALF_WIDE = 9.0  # mm beside the middle of its push that a part still is pushed and not turned away
_BOTH = 2.0  # mm within which both fingers meet a part about at once


def free_travel(hull: Array, ahead: Array, left: Array, along: Array, beside: Array) -> float:
    """How far a hull about its centre may go until it comes within `BUMP` of one of the points before it, mm."""
    across = hull @ left
    half = np.maximum(np.abs(across).max(), _HALF_WIDE) + BUMP
    reach = float((hull @ ahead).max())
    lane = (np.abs(beside) < half) & (along > 0.0)
    if not lane.any():
        return math.inf
    # The front of a hull is its farthest point beside a lane of twice BUMP about each obstacle.
    edge = rim_of(hull)
    gaps = np.abs((edge @ left)[None] - beside[lane][:, None])
    front = np.where(gaps < 2.0 * BUMP, (edge @ ahead)[None], -math.inf).max(axis=1)
    front = np.where(np.isfinite(front), front, -reach)
    return float((along[lane] - front).min()) - BUMP


def finger_edges(gripper: Gripper, direction: float, ahead: Array, left: Array) -> Array:
    """Edges of the two closed fingers about the gripper's middle: ndarray of shape (8, 2, 2), (ahead, left) in mm.

    Between fingers closed as far as they go there still is their narrowest opening, into which a corner fits.
    """
    thickness, across = gripper.jaw_size
    half = gripper.opening[0] / 2.0
    axis = np.array([math.cos(direction), math.sin(direction)])
    normal = np.array([-axis[1], axis[0]])
    edges = []
    for side in (1.0, -1.0):
        corners = [
            side * (half + out * thickness) * axis + beside * across / 2.0 * normal
            for out, beside in ((0.0, -1.0), (1.0, -1.0), (1.0, 1.0), (0.0, 1.0))
        ]
        placed = np.array(corners) @ np.column_stack([ahead, left])
        edges.append(np.stack([placed, np.roll(placed, -1, axis=0)], axis=1))
    return np.concatenate(edges)


def contact(fingers: Array, along: Array, beside: Array, aside: float) -> tuple[float, float]:
    """How far fingers go ahead until they meet points of a rim, and how far beside the rim's middle that is, mm.

    Args:
        fingers: See `finger_edges`.
        along: ndarray of shape (N,): the points, ahead of the gripper's middle.
        beside: ndarray of shape (N,): the points, left of it.
        aside: How far the gripper's middle stands left of the rim's.

    Returns:
        inf and 0 when they pass on both sides of it. What both fingers meet is not turned: 0 beside.
    """
    start, end = fingers[:, 0], fingers[:, 1]
    across = end[:, 1] - start[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (beside[:, None] - start[:, 1]) / across
        front = start[:, 0] + share * (end[:, 0] - start[:, 0])
    ways = along[:, None] - np.where((share >= 0.0) & (share <= 1.0), front, -math.inf)
    nearest = ways.reshape(len(along), 2, -1).min(axis=(0, 2))  # of each finger
    way = float(nearest.min())
    if not math.isfinite(way):
        return math.inf, 0.0
    if nearest.max() - way < _BOTH:
        return way, 0.0
    index = int(ways.min(axis=1).argmin())
    return way, abs(float(beside[index]) + aside)


def rim_of(hull: Array) -> Array:
    """Points (N, 2) every 2 mm along a hull's sides, and its corners."""
    return np.vstack([hull, grasps.dense(hull)])


def lands(moved: LocatedObject, by: Array) -> tuple[LocatedObject, ...]:
    """How a part pushed by (dx, dy) mm may come to lie: as it was, and turned until a side lies against the box."""
    center = np.array(moved.center)
    ahead = by / math.hypot(*by)
    straight = replace(
        moved, center=(float(center[0] + by[0]), float(center[1] + by[1])), footprint=moved.footprint + by
    )
    if moved.shape is Shape.CIRCLE:
        return (straight,)
    hull = hull_of(moved)
    edges = np.roll(hull, -1, axis=0) - hull
    edges = edges[np.linalg.norm(edges, axis=1) > 0.3 * max(moved.size)]
    if not len(edges):
        return (straight,)
    # Outward normals of the sides long enough to come to rest on, for a hull walked counter-clockwise.
    turns = np.arctan2(-ahead[1], -ahead[0]) - np.arctan2(-edges[:, 0], edges[:, 1])
    turns = (turns + math.pi) % (2.0 * math.pi) - math.pi
    turn = float(turns[np.argmin(np.abs(turns))])
    if abs(turn) > _LARGEST_TURN:
        return (straight,)
    c, s = math.cos(turn), math.sin(turn)
    footprint = (moved.footprint - center) @ np.array([[c, s], [-s, c]]) + center + by
    period = moved.shape.period
    yaw = None if moved.yaw is None or period is None else wrap(moved.yaw + turn, period)
    flush = replace(straight, footprint=footprint, yaw=yaw)
    return straight, flush


def hull_of(part: LocatedObject) -> Array:
    """Convex hull of the footprint, counter-clockwise: ndarray of shape (N, 2), mm."""
    hull = cv2.convexHull(part.footprint.astype(np.float32)).reshape(-1, 2).astype(np.float64)
    x, y = hull.T
    signed = float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return hull if signed > 0.0 else hull[::-1]

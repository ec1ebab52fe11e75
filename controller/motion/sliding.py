"""Where a part comes to lie that closed fingers push over the table: slow pushing in the plane, many pushes at once.

A part that slides slowly moves by what friction under it resists least: as if it had a mass of 1 and a moment of
inertia of the square of its mean distance from its middle. So each small step of the fingers is undone at the deepest
contact, the part moved and turned by the least that frees it, and held back along the finger by friction.

Source: Goyal, Ruina, Papadopoulos, "Planar sliding with dry friction" (1991): the ellipsoidal limit surface.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from controller.domain import Array, Gripper

FRICTION = np.array([0.3, 0.8])  # of parts, the least and the most that is known of them
_STEP = 2.5  # mm that the fingers go at a time
_ROUNDS = 2  # contacts undone in each step, as many as fingers
_MEAN_DISTANCE = 0.39  # of a part's points from its middle, of the root of its area: 0.38 (square) to 0.40 (triangle)
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def slide(hull: Array, gripper: Gripper, starts: Array, aheads: Array, turns: Array, travels: Sequence[float]) -> Array:
    """Where pushes leave a part, by its friction: ndarray of shape (F, P, T, 3), by (dx, dy) mm and turned by rad.

    Args:
        hull: ndarray of shape (H, 2): the part's corners about its middle, counter-clockwise, mm.
        gripper: Its fingers are closed.
        starts: ndarray of shape (P, 2): the gripper's middle from the part's where it meets the part, mm.
        aheads: ndarray of shape (P, 2): unit vectors it goes along.
        turns: ndarray of shape (P, 2): closing direction of the jaws there and at the end, rad.
        travels: How far it goes from there, T of them, increasing, mm.
    """
    sides = np.roll(hull, -1, axis=0) - hull
    lengths = np.hypot(*sides.T)
    normals = np.column_stack([sides[:, 1], -sides[:, 0]]) / lengths[:, None]
    part = _Part(hull, normals, (normals * hull).sum(axis=1), gripper)
    pushes, count = len(starts), len(starts) * len(FRICTION)
    starts, aheads, turns = (np.tile(each, (len(FRICTION), 1)) for each in (starts, aheads, turns))
    friction = np.repeat(FRICTION, pushes)
    poses, found, gone = np.zeros((count, 3)), [], 0.0
    for travel in travels:
        steps = math.ceil((travel - gone) / _STEP)
        by = (travel - gone) / steps * aheads
        for way in np.linspace(gone, travel, steps + 1)[1:]:
            share = way / travels[-1]
            jaws = _rotation((1.0 - share) * turns[:, 0] + share * turns[:, 1])
            before = poses.copy()
            for _ in range(_ROUNDS):
                part.undo_deepest(poses, before, starts + way * aheads, jaws, by, friction)
        gone = travel
        found.append(poses.copy())
    return np.stack(found, axis=1).reshape(len(FRICTION), pushes, len(travels), 3)


class _Part:
    """A part that fingers push: its corners, the outward normals and the distances of its sides, mm."""

    def __init__(self, hull: Array, normals: Array, offsets: Array, gripper: Gripper) -> None:
        self._hull, self._normals, self._offsets = hull, normals, offsets
        (x, y), (u, v) = hull.T, np.roll(hull, -1, axis=0).T
        self._inertia = _MEAN_DISTANCE**2 * 0.5 * float((x * v - u * y).sum())
        self._half = np.array(gripper.jaw_size) / 2.0
        beside = gripper.opening[0] / 2.0 + self._half[0]
        self._fingers = np.array([[beside, 0.0], [-beside, 0.0]])
        self._tips = (self._fingers[:, None] + _CORNERS * self._half).reshape(-1, 2)

    def undo_deepest(
        self, poses: Array, before: Array, middles: Array, jaws: Array, by: Array, friction: Array
    ) -> None:
        """Move parts out of the fingers where they are deepest in.

        Args:
            poses: ndarray of shape (N, 3): changed in place.
            before: The same before the last step of the fingers.
            middles: ndarray of shape (N, 2): the grippers' middles.
            jaws: ndarray of shape (N, 2, 2): turns rows of points with the grippers.
            by: ndarray of shape (N, 2): the last step.
            friction: ndarray of shape (N,).
        """
        every = np.arange(len(poses))
        own = _rotation(poses[:, 2])
        # Tips of the fingers within the part ...
        inner = (middles[:, None] + self._tips @ jaws - poses[:, None, :2]) @ own.transpose(0, 2, 1)
        heights = inner @ self._normals.T - self._offsets
        # ... and corners of the part within a finger.
        corners = poses[:, None, :2] + self._hull @ own
        within = ((corners - middles[:, None]) @ jaws.transpose(0, 2, 1))[:, :, None] - self._fingers
        depths = (self._half - np.abs(within)).reshape(len(poses), -1, 2)
        every_depth = np.concatenate([-heights.max(axis=2), depths.min(axis=2)], axis=1)
        deepest = every_depth.argmax(axis=1)
        depth = np.maximum(every_depth[every, deepest], 0.0)
        tip = np.minimum(deepest, len(self._tips) - 1)
        corner = np.maximum(deepest - len(self._tips), 0)
        side = heights[every, tip].argmax(axis=1)
        face = depths[every, corner].argmin(axis=1)
        outward = np.zeros_like(middles)
        outward[every, face] = np.sign(within.reshape(len(poses), -1, 2)[every, corner, face])
        at_tip = (deepest < len(self._tips))[:, None]
        place = np.where(at_tip, _turned(inner[every, tip], own), corners[every, corner // 2] - poses[:, :2])
        away = np.where(at_tip, -_turned(self._normals[side], own), _turned(outward, jaws))
        poses += self._shift(depth, place, away)
        # Friction keeps the place that is touched with the finger, as far as the pressure goes.
        along = np.column_stack([-away[:, 1], away[:, 0]])
        moved = poses - before
        carried = moved[:, :2] + moved[:, 2:] * np.column_stack([-place[:, 1], place[:, 0]])
        held = self._shift(((by - carried) * along).sum(axis=1), place, along)
        share = friction * depth / np.maximum(np.hypot(held[:, 0], held[:, 1]), 1e-9)
        poses += np.minimum(share, 1.0)[:, None] * held

    def _shift(self, distance: Array, place: Array, along: Array) -> Array:
        """The least motion (dx, dy, turn) of the parts that takes a place on them so far along a direction."""
        arm = place[:, 0] * along[:, 1] - place[:, 1] * along[:, 0]
        share = distance / (1.0 + arm**2 / self._inertia)
        return share[:, None] * np.column_stack([along, arm / self._inertia])


def _turned(points: Array, rotations: Array) -> Array:
    """Points (N, 2), each turned by its own matrix."""
    return np.asarray((points[:, None] @ rotations)[:, 0])


def _rotation(angle: Array) -> Array:
    """Matrices (N, 2, 2) that turn rows of points by angles (N,)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c, s, -s, c], axis=-1).reshape(-1, 2, 2)

"""Where a part comes to lie that closed fingers push over the table: slow pushing in the plane, many pushes at once.

A part that slides slowly moves by what friction under it resists least: as if it had a mass of 1 and a moment of
inertia of the square of its mean distance from its middle. So each small step of the fingers is undone at the deepest
contact, the part moved and turned by the least that frees it, and held back along the finger by friction.

Source: Goyal, Ruina, Papadopoulos, "Planar sliding with dry friction" (1991): the ellipsoidal limit surface.
"""

from __future__ import annotations

import numpy as np

from controller.domain import Array, Gripper

FRICTION = (0.3, 0.8)  # of parts, the least and the most that is known of them
_STEP = 2.0  # mm that the fingers go at a time
_ROUNDS = 3  # contacts undone in each step: a side against two fingers takes two
_MEAN_DISTANCE = 0.39  # of a part's points from its middle, of the root of its area: 0.38 (square) to 0.40 (triangle)
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def slide(
    hull: Array, gripper: Gripper, starts: Array, aheads: Array, turns: Array, ends: Array, friction: float
) -> Array:
    """Where pushes leave a part: ndarray of shape (P, T, 3), moved by (dx, dy) mm and turned by rad.

    Args:
        hull: ndarray of shape (H, 2): the part's corners about its middle, counter-clockwise, mm.
        gripper: Its fingers are closed.
        starts: ndarray of shape (P, 2): the gripper's middle from the part's, mm.
        aheads: ndarray of shape (P, 2): unit vectors it goes along.
        turns: ndarray of shape (P, 2): closing direction of the jaws at the start and after the last of `ends`, rad.
        ends: ndarray of shape (P, T): how far it goes, increasing, mm.
        friction: Coefficient of the part against the fingers.
    """
    sides = np.roll(hull, -1, axis=0) - hull
    normals = np.column_stack([sides[:, 1], -sides[:, 0]]) / np.linalg.norm(sides, axis=1)[:, None]
    offsets = (normals * hull).sum(axis=1)
    area = 0.5 * float((hull[:, 0] * np.roll(hull[:, 1], -1) - hull[:, 1] * np.roll(hull[:, 0], -1)).sum())
    inertia = _MEAN_DISTANCE**2 * area
    half = np.array(gripper.jaw_size) / 2.0
    beside = gripper.opening[0] / 2.0 + half[0]
    fingers = np.array([[beside, 0.0], [-beside, 0.0]])
    tips = (fingers[:, None] + _CORNERS * half).reshape(-1, 2)
    count = len(starts)
    every, part = np.arange(count), np.zeros((count, 3))
    found = np.empty((*ends.shape, 3))
    gone = np.zeros(count)
    for stop in range(ends.shape[1]):
        steps = max(int(np.ceil((ends[:, stop] - gone).max() / _STEP)), 1)
        by = (ends[:, stop] - gone) / steps
        for _ in range(steps):
            gone = gone + by
            turn = turns[:, 0] + (turns[:, 1] - turns[:, 0]) * gone / ends[:, -1]
            jaws = _rotation(turn)
            middle = starts + gone[:, None] * aheads
            before = part.copy()
            for _ in range(_ROUNDS):
                own = _rotation(part[:, 2])
                # Tips of the fingers within the part ...
                inner = (middle[:, None] + tips @ jaws - part[:, None, :2]) @ own.transpose(0, 2, 1)
                heights = inner @ normals.T - offsets
                side = heights.argmax(axis=2)
                depth_tips = -heights.max(axis=2)
                # ... and corners of the part within a finger.
                corners = part[:, None, :2] + hull @ own
                within = ((corners - middle[:, None]) @ jaws.transpose(0, 2, 1))[:, :, None] - fingers
                over = half - np.abs(within)
                depth_corners = over.min(axis=3).reshape(count, -1)
                depths = np.concatenate([depth_tips, depth_corners], axis=1)
                deepest = depths.argmax(axis=1)
                depth = np.maximum(depths[every, deepest], 0.0)
                tip = np.minimum(deepest, len(tips) - 1)
                corner = np.maximum(deepest - len(tips), 0)
                at_tip = deepest < len(tips)
                place = np.where(
                    at_tip[:, None], (inner[every, tip, None] @ own)[:, 0], corners[every, corner // 2] - part[:, :2]
                )
                face = over.reshape(count, -1, 2)[every, corner].argmin(axis=1)
                outward = np.sign(within.reshape(count, -1, 2)[every, corner])
                outward[every, 1 - face] = 0.0
                away = np.where(
                    at_tip[:, None], -(normals[side[every, tip], None] @ own)[:, 0], (outward[:, None] @ jaws)[:, 0]
                )
                part += _shift(depth, place, away, inertia)
                # Friction keeps the place that is touched with the finger, as far as the pressure goes.
                along = np.column_stack([-away[:, 1], away[:, 0]])
                moved = part - before
                carried = moved[:, :2] + moved[:, 2:] * np.column_stack([-place[:, 1], place[:, 0]])
                slip = ((by[:, None] * aheads - carried) * along).sum(axis=1)
                most = friction * depth
                held = _shift(slip, place, along, inertia)
                share = np.clip(most / np.maximum(np.linalg.norm(held[:, :2], axis=1), 1e-9), 0.0, 1.0)
                part += share[:, None] * held
        found[:, stop] = part
    return found


def _rotation(angle: Array) -> Array:
    """Matrices (P, 2, 2) that turn rows of points by angles (P,)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)


def _shift(distance: Array, place: Array, along: Array, inertia: float) -> Array:
    """The least motion (dx, dy, turn) of a part that takes a place on it so far along a direction."""
    arm = place[:, 0] * along[:, 1] - place[:, 1] * along[:, 0]
    share = distance / (1.0 + arm**2 / inertia)
    return share[:, None] * np.column_stack([along, arm / inertia])

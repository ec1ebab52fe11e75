"""Closed-form kinematics of the arms this project knows: a waist, a planar chain of three, maybe a wrist roll.

All functions are pure and vectorised over leading axes. The chain turns the tool by
`Rz(waist) Ry(pitch) Rx(roll)` with pitch = shoulder + elbow + wrist, so the plane of the arm is a two-link
problem once the pitch is chosen.

Source: two-link inverse kinematics by the law of cosines, e.g. Lynch and Park, Modern Robotics, 6.1.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.domain import ArmDescription, Array
from controller.errors import Unreachable
from controller.motion.by_arm import once_per_arm

TOP_DOWN = math.pi / 2
BRANCHES = 4
FACING_UP = 0
"""The branch that faces the point, elbow up: the one work is done in."""
_BEHIND = 179.5
"""deg of the waist: a gap narrower than this beside half a turn looks like none to who builds a cell."""
_JOINTS_WITH_ROLL = 5


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """The numbers of an arm's planar chain, mm and rad.

    Attributes:
        joints: 4 or 5.
        axis: (x, z) of the waist axis in `base`: the z is that of the shoulder.
        start: Distance of the shoulder from the waist axis, in the arm's plane.
        upper: (length, angle above the joint's x axis) from shoulder to elbow.
        fore: (length, angle above the joint's x axis) from elbow to wrist.
        hand: Distance from the wrist to the grasp point.
        low: ndarray of shape (J,), lowest joint angles.
        high: ndarray of shape (J,), highest joint angles.
        limits: (lowest, highest) of every joint.
    """

    joints: int
    axis: tuple[float, float]
    start: float
    upper: tuple[float, float]
    fore: tuple[float, float]
    hand: float
    low: Array
    high: Array
    limits: tuple[tuple[float, float], ...]


@once_per_arm
def chain(arm: ArmDescription) -> Chain:
    """The planar chain of an arm description (checked when the description is loaded)."""
    waist, shoulder, elbow, wrist = arm.joints[:4]
    roll = sum(joint.offset[0] for joint in arm.joints[4:])
    return Chain(
        joints=len(arm.joints),
        axis=(waist.offset[0], waist.offset[2] + shoulder.offset[2]),
        start=shoulder.offset[0],
        upper=(math.hypot(elbow.offset[0], elbow.offset[2]), math.atan2(elbow.offset[2], elbow.offset[0])),
        fore=(math.hypot(wrist.offset[0], wrist.offset[2]), math.atan2(wrist.offset[2], wrist.offset[0])),
        hand=roll + arm.tool[0],
        low=np.array([joint.limits[0] for joint in arm.joints]),
        high=np.array([joint.limits[1] for joint in arm.joints]),
        limits=tuple(joint.limits for joint in arm.joints),
    )


def points(arm: ArmDescription, q: ArrayLike) -> Array:
    """Positions in `base` of shoulder, elbow, wrist and grasp point: ndarray of shape (..., 4, 3), mm.

    Args:
        arm: The arm.
        q: ndarray of shape (..., J), joint angles, rad.
    """
    c = chain(arm)
    q = np.asarray(q, np.float64)
    # Angle below the horizon of each body's x axis; its own constant angle lifts the line to the next joint.
    below = np.cumsum(q[..., 1:4], axis=-1)
    upper = c.upper[1] - below[..., 0]
    fore = c.fore[1] - below[..., 1]
    out = np.empty((*q.shape[:-1], 4, 3))
    radius, height = np.empty(out.shape[:-1]), out[..., 2]
    radius[..., 0], height[..., 0] = c.start, c.axis[1]
    radius[..., 1] = c.start + c.upper[0] * np.cos(upper)
    height[..., 1] = c.axis[1] + c.upper[0] * np.sin(upper)
    radius[..., 2] = radius[..., 1] + c.fore[0] * np.cos(fore)
    height[..., 2] = height[..., 1] + c.fore[0] * np.sin(fore)
    radius[..., 3] = radius[..., 2] + c.hand * np.cos(below[..., 2])
    height[..., 3] = height[..., 2] - c.hand * np.sin(below[..., 2])
    waist = q[..., :1]
    out[..., 0] = c.axis[0] + radius * np.cos(waist)
    out[..., 1] = radius * np.sin(waist)
    return out


def forward(arm: ArmDescription, q: ArrayLike) -> Array:
    """Pose of the tool, T_base_tool: ndarray of shape (..., 4, 4), mm.

    Args:
        arm: The arm.
        q: ndarray of shape (..., J), joint angles, rad.
    """
    q = np.asarray(q, np.float64)
    out = np.zeros((*q.shape[:-1], 4, 4))
    out[..., :3, :3] = rotation(q)
    out[..., :3, 3] = points(arm, q)[..., 3, :]
    out[..., 3, 3] = 1.0
    return out


def rotation(q: ArrayLike) -> Array:
    """Rotation of the tool, R_base_tool: ndarray of shape (..., 3, 3), for joint angles (..., 4 or 5), rad."""
    q = np.asarray(q, np.float64)
    pitch = q[..., 1] + q[..., 2] + q[..., 3]
    roll = q[..., 4] if q.shape[-1] == _JOINTS_WITH_ROLL else np.zeros_like(pitch)
    cw, sw = np.cos(q[..., 0]), np.sin(q[..., 0])
    cp, sp = np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 1, 0], out[..., 2, 0] = cw * cp, sw * cp, -sp
    out[..., 0, 1], out[..., 1, 1], out[..., 2, 1] = cw * sp * sr - sw * cr, sw * sp * sr + cw * cr, cp * sr
    out[..., 0, 2], out[..., 1, 2], out[..., 2, 2] = cw * sp * cr + sw * sr, sw * sp * cr - cw * sr, cp * cr
    return out


def branches(
    arm: ArmDescription, position: ArrayLike, pitch: ArrayLike, roll: ArrayLike = 0.0
) -> tuple[Array, NDArray[np.bool_]]:
    """All postures that bring the grasp point to a pose, and which of them the joints allow.

    The four branches are: facing the point with the elbow up, down; reaching over the back, up, down.
    Where the point is out of reach the angles are nan.

    Args:
        arm: The arm.
        position: ndarray of shape (..., 3), in `base`, mm.
        pitch: Angle of the tool below the horizon, rad; broadcasts to (...).
        roll: Turn about the tool's axis, rad, as `Rz(azimuth) Ry(pitch) Rx(roll)`; broadcasts to (...).
            A 4-joint arm can only take those near 0 (facing) or pi (over the back).

    Returns:
        ndarray of shape (..., 4, J), rad, and ndarray of shape (..., 4), dtype bool: within the limits.
    """
    c = chain(arm)
    position = np.asarray(position, np.float64)
    x, y, z = position[..., 0] - c.axis[0], position[..., 1], position[..., 2]
    q = np.empty((*x.shape, BRANCHES, c.joints))
    azimuth = np.arctan2(y, x)
    q[..., :2, 0] = azimuth[..., None]
    q[..., 2:, 0] = np.where(azimuth > 0.0, azimuth - math.pi, azimuth + math.pi)[..., None]
    reach = np.hypot(x, y)
    cos_pitch, sin_pitch = c.hand * np.cos(pitch), c.hand * np.sin(pitch)
    up = z + sin_pitch - c.axis[1]
    # Over the back the plane's forward direction is reversed: radius and horizontal pointing change sign.
    out = np.empty((*x.shape, 2))
    out[..., 0] = reach - cos_pitch - c.start
    out[..., 1] = cos_pitch - reach - c.start
    far = out * out + (up * up)[..., None]
    a, b = c.upper[0], c.fore[0]
    cosine = (far - (a * a + b * b)) / (2.0 * a * b)
    with np.errstate(invalid="ignore"):
        bend = np.arccos(np.where(np.abs(cosine) <= 1.0, cosine, np.nan))
    direction = np.arctan2(up[..., None], out)
    turn = np.arctan2(b * np.sin(bend), a + b * cosine)
    # elbow up: the upper arm stands steeper than the line to the wrist, the forearm bends down
    q[..., 0::2, 1] = c.upper[1] - (direction + turn)
    q[..., 1::2, 1] = c.upper[1] - (direction - turn)
    level = c.fore[1] - c.upper[1]
    q[..., 0::2, 2] = bend + level
    q[..., 1::2, 2] = level - bend
    q[..., :2, 3] = np.asarray(pitch)[..., None]
    q[..., 2:, 3] = math.pi - np.asarray(pitch)[..., None]
    q[..., 3] -= q[..., 1] + q[..., 2]
    if c.joints == _JOINTS_WITH_ROLL:
        q[..., :2, 4] = np.asarray(roll)[..., None]
        q[..., 2:, 4] = np.asarray(roll)[..., None] - math.pi
    q[..., 1:] -= 2.0 * math.pi * np.round(q[..., 1:] / (2.0 * math.pi))
    allowed = ((q >= c.low) & (q <= c.high)).all(axis=-1)
    return q, np.asarray(allowed)


def inverse(arm: ArmDescription, position: ArrayLike, pitch: float = TOP_DOWN, roll: float = 0.0) -> Array:
    """Every posture within the joint limits that brings the grasp point to a pose.

    The same solutions as `branches`, for one pose and in plain arithmetic: ten times as fast as an array of one.

    Args:
        arm: The arm.
        position: (x, y, z) in `base`, mm.
        pitch: Angle of the tool below the horizon, rad.
        roll: Turn about the tool's axis, rad.

    Returns:
        ndarray of shape (B, J), B >= 1, rad: facing before over the back, elbow up before down.

    Raises:
        Unreachable: The message says whether the distance or which joint's limit is the reason.
    """
    found = [q for _, q in solutions(arm, position, pitch, roll, within=True)]
    if found:
        return np.array(found)
    x, y, z = (float(v) for v in np.asarray(position, np.float64))
    place = f"({x:.0f}, {y:.0f}, {z:.0f}) mm pitched {math.degrees(pitch):.0f} deg"
    all_known = list(solutions(arm, position, pitch, roll, within=False))
    if not all_known:
        raise Unreachable(f"{place} is too far from or too near to the shoulder", "move the part")
    # What keeps the arm from facing the point says more than what keeps it from reaching over its back.
    facing = all_known[0][0] < BRANCHES // 2
    known = np.array([q for k, q in all_known if (k < BRANCHES // 2) is facing])
    c = chain(arm)
    worst = known[np.argmin(np.maximum(known - c.high, c.low - known).max(axis=-1))]
    joint = int(np.argmax(np.maximum(worst - c.high, c.low - worst)))
    low, high = (math.degrees(v) for v in arm.joints[joint].limits)
    needed = math.degrees(worst[joint])
    if joint == 0 and abs(needed) > _BEHIND:
        raise Unreachable(
            f"{place} lies straight behind the arm, where its {arm.joints[0].name}'s turn ends "
            f"({needed:.2f} deg, allowed {low:.2f}..{high:.2f}); a few mm to one side it is within",
            "move it to one side",
        )
    raise Unreachable(
        f"{place} needs {arm.joints[joint].name} at {needed:.2f} deg, allowed {low:.2f}..{high:.2f}",
        "move the part",
    )


def solutions(
    arm: ArmDescription, position: ArrayLike, pitch: float, roll: float, *, within: bool
) -> Iterator[tuple[int, list[float]]]:
    """Index among the `branches` and joint angles (rad) of every posture for one pose.

    Args:
        arm: The arm.
        position: (x, y, z) in `base`, mm.
        pitch: Angle of the tool below the horizon, rad.
        roll: Turn about the tool's axis, rad.
        within: Leave out postures beyond the joint limits.
    """
    c = chain(arm)
    x, y, z = np.asarray(position, np.float64).tolist()
    azimuth = math.atan2(y, x - c.axis[0])
    reach = math.hypot(x - c.axis[0], y) - c.hand * math.cos(pitch)
    up = z + c.hand * math.sin(pitch) - c.axis[1]
    a, b = c.upper[0], c.fore[0]
    for k in range(BRANCHES):
        facing, sign = k < BRANCHES // 2, 1.0 if k % 2 == 0 else -1.0
        out = (reach if facing else -reach) - c.start
        cosine = (out * out + up * up - a * a - b * b) / (2.0 * a * b)
        if abs(cosine) > 1.0:
            continue
        bend = sign * math.acos(cosine)
        steep = math.atan2(up, out) + math.atan2(b * math.sin(bend), a + b * cosine)
        shoulder = _turned(c.upper[1] - steep)
        elbow = _turned(bend + c.fore[1] - c.upper[1])
        waist = azimuth if facing else azimuth - math.copysign(math.pi, azimuth)
        q = [waist, shoulder, elbow, _turned((pitch if facing else math.pi - pitch) - shoulder - elbow)]
        if c.joints == _JOINTS_WITH_ROLL:
            q.append(_turned(roll if facing else roll - math.pi))
        if not within or all(low <= v <= high for v, (low, high) in zip(q, c.limits, strict=True)):
            yield k, q


def _turned(angle: float) -> float:
    """`angle` within [-pi, pi]."""
    return angle - 2.0 * math.pi * round(angle / (2.0 * math.pi))


def roll_for(arm: ArmDescription, azimuth: float, direction: float) -> tuple[float, ...]:
    """Rolls that close the jaws along `direction` when the tool points down at `azimuth`.

    Two for an arm with a wrist roll (the jaws are alike); none otherwise unless the direction is the
    tangential one it is built for (within 1e-6 rad).

    Args:
        arm: The arm.
        azimuth: Angle of the arm's plane about z of `base`, rad.
        direction: Closing direction about z of `base`, rad modulo pi.
    """
    roll = (azimuth + math.pi / 2 - direction + math.pi / 2) % math.pi - math.pi / 2
    if chain(arm).joints == _JOINTS_WITH_ROLL:
        return (roll, roll - math.copysign(math.pi, roll))
    return (0.0,) if abs(roll) < 1e-6 else ()


def closing_direction(q: ArrayLike) -> float:
    """Direction of the tool's y axis about z of `base`, rad in (-pi, pi]; the jaws close along it both ways.

    That of `rotation`, for one posture (J,) and in plain arithmetic.
    """
    waist, shoulder, elbow, wrist, *rest = np.asarray(q, np.float64).tolist()
    roll = rest[0] if rest else 0.0
    across, along = math.cos(roll), math.sin(shoulder + elbow + wrist) * math.sin(roll)
    c, s = math.cos(waist), math.sin(waist)
    return math.atan2(s * along + c * across, c * along - s * across)

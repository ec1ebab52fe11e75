"""What only the world knows: where every part truly is, in the words of the controller's truth values."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from controller.domain import ArmDescription, Bin, TruePart
from sim_backends.parts import Part
from sim_backends.solids import Array

# A part that leans by more than this does not stand on its face, rad.
_LEAN = math.radians(5.0)
# Below the table's surface by more than this it has fallen off, mm.
_FALLEN = -30.0
# Tips of the jaws stay this far above the table when a part is taken, mm.
_TIP_CLEARANCE = 2.0


def true_parts(
    parts: Sequence[Part],
    poses: NDArray[np.float64],
    held: frozenset[int],
    bins: Sequence[Bin],
    T_base_bins: Array,
    T_base_table: Array,
    reachable: Sequence[bool],
    away: frozenset[int] = frozenset(),
) -> tuple[TruePart, ...]:
    """Truth about all parts at one moment.

    Args:
        parts: What they are.
        poses: ndarray of shape (P, 7): position (mm, `base`) and quaternion of each.
        held: Those in the gripper.
        bins: The bins.
        T_base_bins: The `table` their centres are given in.
        T_base_table: The `table` the truth is told in.
        reachable: For each part whether the arm could reach it at the start.
        away: Those that a person has.
    """
    out = []
    to_table, to_bins = np.linalg.inv(T_base_table), np.linalg.inv(T_base_bins)
    for index, (part, pose) in enumerate(zip(parts, poses, strict=True)):
        x_axis, z_axis = _axes(pose[3:])
        at = to_table[:3, :3] @ pose[:3] + to_table[:3, 3]
        along = to_table[:3, :3] @ x_axis
        period = part.shape.period
        out.append(
            TruePart(
                part_id=index,
                shape=part.shape,
                colour=part.colour,
                center=(float(at[0]), float(at[1])),
                yaw=None if period is None else math.atan2(along[1], along[0]) % period,
                size=part.size,
                height=part.height,
                upright=bool(z_axis[2] > math.cos(_LEAN)),
                place="away"
                if index in away
                else _place(to_bins[:3, :3] @ pose[:3] + to_bins[:3, 3], index in held, bins),
                reachable=reachable[index],
                kind=part.kind,
            )
        )
    return tuple(out)


def _place(at: Array, held: bool, bins: Sequence[Bin]) -> str:
    if held:
        return "gripper"
    if at[2] < _FALLEN:
        return "floor"
    for bin_ in bins:
        dx, dy = abs(at[0] - bin_.center[0]), abs(at[1] - bin_.center[1])
        # Parts may be heaped: anything above the bin's floor counts while its centre is inside the walls.
        if dx < bin_.size[0] / 2.0 and dy < bin_.size[1] / 2.0:
            return bin_.name
    return "table"


def _axes(quaternion: NDArray[np.float64]) -> tuple[Array, Array]:
    """First and third column of the rotation of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    first = np.array([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)])
    third = np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])
    return first, third


def can_reach(arm: ArmDescription, x: float, y: float) -> bool:
    """Whether the described arm can take a part at (x, y) of `base`, mm, from straight above, by its joint limits."""
    waist, shoulder, elbow, wrist = arm.joints[:4]
    out, up = math.hypot(x - waist.offset[0], y - waist.offset[1]) - shoulder.offset[0], _TIP_CLEARANCE
    up += arm.gripper.jaw_depth + arm.tool[0] + sum(joint.offset[0] for joint in arm.joints[4:])
    up -= waist.offset[2] + shoulder.offset[2]
    azimuth = math.atan2(y - waist.offset[1], x - waist.offset[0])
    if not waist.limits[0] <= azimuth <= waist.limits[1]:
        return False
    # Angles count as the joints do: positive from ahead to down.
    (a, alpha), (b, beta) = (
        (math.hypot(o[0], o[2]), math.atan2(-o[2], o[0])) for o in (elbow.offset, wrist.offset)
    )
    distance = math.hypot(out, up)
    cosine = (distance**2 - a**2 - b**2) / (2.0 * a * b)
    if abs(cosine) > 1.0:
        return False
    for bend in (math.acos(cosine), -math.acos(cosine)):
        first = math.atan2(-up, out) - math.atan2(b * math.sin(bend), a + b * math.cos(bend))
        second = bend + alpha - beta
        angles = (first - alpha, second, math.pi / 2.0 - (first - alpha) - second)
        wrapped = [math.remainder(angle, 2.0 * math.pi) for angle in angles]
        if all(j.limits[0] <= q <= j.limits[1] for j, q in zip((shoulder, elbow, wrist), wrapped, strict=True)):
            return True
    return False

"""Poses that let the camera tell base, joint offsets and marker mount apart, and a safe way through them.

Poses are drawn at random, kept when they are reachable, clear of the table and show the marker, and then
taken one by one, each the one that tells most about what is still unknown (the largest gain of the
determinant of the information).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from controller.calibration.arm_model import MarkerView, Unknowns
from controller.errors import Unreachable
from controller.geometry import invert
from controller.motion import kinematics

Array = NDArray[np.float64]

_DRAWN = 4000
_KEPT = 400
#: The marker is read well up to this angle off its normal, rad.
_FACING = math.radians(55.0)
#: Clear of the picture's border, px.
_BORDER = 25.0
#: No part of the forearm lies closer than this to the line of sight, mm: half a beam and half a marker.
_SIGHT = 48.0
#: Joints stay this far from their limits, rad: offsets and the model's goal offsets need room.
_LIMIT_MARGIN = math.radians(8.0)
#: Elbow and wrist, with the servos around them, stay this far above the table, mm.
_BODY_CLEARANCE = 60.0


def choose(
    view: MarkerView,
    count: int,
    *,
    clearance: float,
    azimuth: float = math.radians(50.0),
    seed: int = 0,
    start: Array | None = None,
) -> list[Array]:
    """Joint angles of `count` poses that together determine the arm best, in the order to take them.

    Args:
        view: The cell as known so far.
        count: Number of poses.
        clearance: Least height of jaws and plate above the table, mm: more than the tallest part there.
        azimuth: Largest waist angle to either side, rad.
        seed: Of the draw.
        start: Joint angles the arm comes from; its `ready` pose when not given.

    Raises:
        Unreachable: Hardly any pose shows the marker: arm, camera and table are not where they should be.
    """
    candidates = _candidates(view, clearance, azimuth, np.random.default_rng(seed))
    if len(candidates) < 2 * count:
        raise Unreachable(
            f"only {len(candidates)} of {_DRAWN} tried poses show the marker to the camera",
            "check origin_in_base_mm, the camera's view of the table and the marker's mount",
        )
    parameters = np.zeros(len(view.prior))
    whitener = view.whitener(parameters, candidates)
    rows = whitener @ (view.jacobian(parameters, candidates) * view.prior)
    gains = rows.transpose(0, 2, 1) @ rows
    information = np.eye(len(parameters))
    left = list(range(len(candidates)))
    chosen: list[int] = []
    for _ in range(count):
        values = np.linalg.slogdet(information + gains[left])[1]
        best = left.pop(int(np.argmax(values)))
        information = information + gains[best]
        chosen.append(best)
    return order(view, candidates[chosen], np.asarray(view.arm.ready if start is None else start), clearance)


def order(view: MarkerView, poses: Array, start: Array, clearance: float) -> list[Array]:
    """The poses, nearest next; one that cannot be reached in a straight joint line is left out."""
    left, at, out = list(poses), start, []
    while left:
        distances = [float(np.abs(pose - at).max()) for pose in left]
        for index in np.argsort(distances):
            if clear_line(view, at, left[index], clearance):
                at = left.pop(int(index))
                out.append(at)
                break
        else:
            break
    return out


def clear_line(view: MarkerView, a: Array, b: Array, clearance: float) -> bool:
    """Whether the straight joint line from `a` to `b` stays above the table.

    Poses that are themselves lower (a parked arm) may be left and reached: only what lies between counts.
    """
    count = max(3, int(np.ceil(np.abs(b - a).max() / math.radians(4.0))))
    shares = np.linspace(0.0, 1.0, count + 1)[1:-1]
    between = a + (b - a) * shares[:, None]
    floor = min(clearance, float(lowest(view, np.vstack([a, b])).min())) - 5.0
    return bool((lowest(view, between) >= floor).all())


def lowest(view: MarkerView, q: Array) -> Array:
    """Height (N,) of the lowest point of jaws and plate for joint angles (N, J), mm above the table.

    Elbow and wrist count as lower by what their servos need.
    """
    tools = kinematics.forward(view.arm, q)
    gripper = view.arm.gripper
    side = gripper.opening[1] / 2 + gripper.jaw_size[0]
    half = gripper.jaw_size[1] / 2
    tips = np.array([[gripper.jaw_depth, y, z] for y in (-side, side) for z in (-half, half)])
    plate = view.marker.plate @ view.marker.T_tool_marker[:3, :3].T + view.marker.T_tool_marker[:3, 3]
    body = np.vstack([tips, plate])
    heights = np.einsum("nj,kj->nk", tools[:, 2, :3], body) + tools[:, 2, 3, None]
    links = kinematics.points(view.arm, q)[:, 1:3, 2] - _BODY_CLEARANCE + 45.0
    return np.asarray(np.minimum(heights.min(axis=1), links.min(axis=1)))


def _candidates(view: MarkerView, clearance: float, azimuth: float, random: np.random.Generator) -> Array:
    """Feasible joint angles (N, J), at most `_KEPT`."""
    radius, turn = random.uniform(120.0, 330.0, _DRAWN), random.uniform(-azimuth, azimuth, _DRAWN)
    position = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), random.uniform(40.0, 200.0, _DRAWN)])
    pitch = np.deg2rad(random.uniform(45.0, 125.0, _DRAWN))
    has_roll = len(view.arm.joints) > 4
    roll = np.deg2rad(random.uniform(-100.0, 100.0, _DRAWN)) if has_roll else np.zeros(_DRAWN)
    angles, allowed = kinematics.branches(view.arm, position, pitch, roll)
    q = angles.reshape(-1, angles.shape[-1])[allowed.ravel()]
    limits = np.array([joint.limits for joint in view.arm.joints])
    q = q[((q > limits[:, 0] + _LIMIT_MARGIN) & (q < limits[:, 1] - _LIMIT_MARGIN)).all(axis=1)]
    q = q[np.abs(q[:, 0]) <= azimuth]
    q = q[lowest(view, q) >= clearance]
    q = q[visible(view, q, view.unknowns(np.zeros(len(view.prior))))]
    return q[random.permutation(len(q))[:_KEPT]]


def visible(view: MarkerView, q: Array, unknowns: Unknowns) -> NDArray[np.bool_]:
    """Which joint angles (N, J) show the whole marker, well turned and not behind the arm."""
    corners = view.in_camera(unknowns, q)
    centre = corners.mean(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    facing = np.einsum("ni,ni->n", normal, centre)
    cosine = facing / np.linalg.norm(normal, axis=1) / np.linalg.norm(centre, axis=1)
    ahead = corners[..., 2].min(axis=1) > 50.0
    pixels = view.camera.project(corners.reshape(-1, 3)).reshape(len(q), 4, 2)
    size = np.array(view.camera.image_size)
    inside = ((pixels > _BORDER) & (pixels < size - _BORDER)).all(axis=(1, 2))
    seen = ahead & inside & (cosine > math.cos(_FACING)) & (_sight(view, q, centre) > _SIGHT)
    return np.asarray(seen, np.bool_)


def _sight(view: MarkerView, q: Array, centre: Array) -> Array:
    """Distance (N,) of the arm's bones from the line between camera and marker, mm."""
    T_camera_base = invert(view.T_table_camera) @ invert(view.T_base_table)
    bones = kinematics.points(view.arm, q)
    shares = np.linspace(0.0, 1.0, 8)
    pieces = [a + (b - a) * s for a, b in _pairs(bones) for s in shares]
    points = np.stack(pieces, axis=1) @ T_camera_base[:3, :3].T + T_camera_base[:3, 3]
    along = np.clip(np.einsum("nki,ni->nk", points, centre) / np.einsum("ni,ni->n", centre, centre)[:, None], 0, 1)
    return np.asarray(np.linalg.norm(points - along[..., None] * centre[:, None], axis=2).min(axis=1))


def _pairs(bones: Array) -> Sequence[tuple[Array, Array]]:
    """Elbow to wrist and wrist to tool: the shoulder's link never comes between."""
    return [(bones[:, 1], bones[:, 2]), (bones[:, 2], bones[:, 3])]

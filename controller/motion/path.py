"""The geometry of a move: joint lines and straight vertical strokes, rounded where they meet.

A path is a smooth curve in joint space over a phase that grows by one for every second at full joint speed.
How fast it is travelled is decided elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from controller.domain import ArmDescription, Array
from controller.errors import Unreachable
from controller.motion.kinematics import branches, chain, points

# Knots every 12 ms of full speed: the spline between them leaves a vertical stroke by less than 1 um.
KNOT_SPACING = 0.012
_STROKE_STEP = 2.0  # mm between the exact solutions a vertical stroke is made of


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """One piece of a path over its own parameter in [0, 1].

    Attributes:
        curve: Maps ndarray (N,) of the parameter and an order of derivative to ndarray (N, J), rad.
        length: Length at full joint speed, s.
    """

    curve: Callable[[Array, int], Array]
    length: float


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A curve in joint space.

    Attributes:
        spline: Joint angles (rad) over the phase.
        length: Largest phase; about the duration at full joint speed, s.
        marks: Phases where the legs begin and end, the roundings between them: 2 a leg.
    """

    spline: CubicSpline
    length: float
    marks: tuple[float, ...]


def speed_limits(arm: ArmDescription) -> Array:
    """Planned joint speeds at most: ndarray of shape (J,), rad/s."""
    return np.array([joint.speed_limit for joint in arm.joints])


def line(arm: ArmDescription, start: Array, end: Array) -> Leg:
    """The straight line in joint space."""
    delta = end - start

    def curve(t: Array, order: int) -> Array:
        if order == 0:
            return start + np.multiply.outer(t, delta)
        return np.broadcast_to(delta if order == 1 else 0.0 * delta, (len(t), len(delta)))

    return Leg(curve, float(np.linalg.norm(delta / speed_limits(arm))))


def stroke(arm: ArmDescription, position: Sequence[float], posture: Array, rise: float) -> Leg:
    """The straight vertical line of the grasp point, the tool's direction kept.

    Args:
        arm: The arm.
        position: (x, y, z) in `base` where the stroke starts, mm.
        posture: Joint angles there; the branch is kept.
        rise: How far up (negative: down), mm.

    Raises:
        Unreachable: Some point of it is out of reach.
    """
    count = max(int(abs(rise) / _STROKE_STEP) + 1, 6)
    heights = np.linspace(0.0, rise, count)
    way = np.empty((count, 3))
    way[:] = position
    way[:, 2] += heights
    q, allowed = follow_branch(arm, way, posture)
    if not allowed.all():
        where = way[int(np.argmin(allowed)), 2]
        raise Unreachable(
            f"the vertical stroke at ({position[0]:.0f}, {position[1]:.0f}) mm leaves the reach at {where:.0f} mm",
            "move the part or the bin nearer",
        )
    spline = CubicSpline(np.linspace(0.0, 1.0, count), q)
    travel = np.linalg.norm(np.diff(q, axis=0) / speed_limits(arm), axis=1).sum()
    return Leg(lambda t, order: np.asarray(spline(t, order)), float(travel))


def follow_branch(arm: ArmDescription, way: Array, posture: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Joint angles along a way, in the branch of a posture: ndarray (N, J), rad, and (N,) of allowed ones.

    The waist and the wrist's roll stay as they are in `posture` where the branches differ by whole turns.
    """
    below = float(posture[1:4].sum())
    facing = np.cos(posture[0] - np.arctan2(way[0, 1], way[0, 0] - chain(arm).axis[0])) > 0.0
    pitch = below if facing else np.pi - below
    roll = float(posture[4]) if len(posture) > 4 else 0.0
    q, allowed = branches(arm, way, pitch, roll if facing else roll + np.pi)
    near = np.abs(q[0] - posture)
    near = np.minimum(near, 2.0 * np.pi - near).max(axis=-1)
    if not np.isfinite(near).any():
        return q[:, 0], np.zeros(len(way), bool)
    best = int(np.nanargmin(near))
    return q[:, best], allowed[:, best]


def tool_travel(arm: ArmDescription, leg: Leg, count: int = 33) -> tuple[Array, Array]:
    """Parameters (count,) of a leg and how far the grasp point has come there (count,), mm."""
    t = np.linspace(0.0, 1.0, count)
    way = points(arm, leg.curve(t, 0))[:, 3]
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
    return t, np.concatenate([[0.0], np.cumsum(steps)])


def join(arm: ArmDescription, legs: Sequence[Leg], corners: Sequence[tuple[float, float]]) -> Path:
    """One smooth path along legs, with a quintic where two meet.

    Args:
        arm: The arm.
        legs: In order; each begins where the one before ends.
        corners: For each meeting, (mm of tool travel cut from the end of the leg before, mm cut from the
            start of the leg after). A cut never takes more than half of a leg that has a corner at both
            ends, or all of one that has it at one.
    """
    speeds = speed_limits(arm)
    cuts = np.array([[0.0, 1.0]] * len(legs))
    for k, leg in enumerate(legs):
        before = corners[k - 1][1] if k > 0 else 0.0
        after = corners[k][0] if k < len(legs) - 1 else 0.0
        t, travel = tool_travel(arm, leg)
        total = travel[-1]
        room = total / 2.0 if before > 0.0 and after > 0.0 else total
        if total > 0.0:
            cuts[k, 0] = np.interp(min(before, room), travel, t)
            cuts[k, 1] = np.interp(total - min(after, room), travel, t)
    samples: list[Array] = []
    marks: list[int] = []
    total_count = 0

    def add(piece: Array) -> None:
        nonlocal total_count
        samples.append(piece)
        total_count += len(piece)

    for k, leg in enumerate(legs):
        low, high = cuts[k]
        count = max(int(leg.length * (high - low) / KNOT_SPACING) + 2, 3)
        marks.append(total_count)
        add(leg.curve(np.linspace(low, high, count), 0))
        marks.append(total_count - 1)
        if k + 1 < len(legs):
            add(_corner(leg, high, legs[k + 1], cuts[k + 1, 0], speeds))
    q = np.concatenate(samples)
    steps = np.linalg.norm(np.diff(q, axis=0) / speeds, axis=1)
    phase = np.concatenate([[0.0], np.cumsum(steps)])
    keep = np.concatenate([[True], steps > 1e-9])  # legs of no length repeat a knot
    if keep.sum() < 2:
        q, phase, keep = np.repeat(q[:1], 4, axis=0), np.arange(4) * 1e-6, np.ones(4, bool)
        return Path(CubicSpline(phase, q), float(phase[-1]), (0.0, float(phase[-1])))
    return Path(CubicSpline(phase[keep], q[keep]), float(phase[-1]), tuple(float(phase[m]) for m in marks))


def _corner(first: Leg, at: float, second: Leg, then: float, speeds: Array) -> Array:
    """Inner samples of a quintic that leaves `first` and meets `second` with their tangents and curvatures."""
    q0, t0, c0 = _frame(first, at, speeds)
    q1, t1, c1 = _frame(second, then, speeds)
    length = float(np.linalg.norm((q1 - q0) / speeds))
    if length < 1e-9:
        return np.empty((0, len(q0)))
    d0, d1, a0, a1 = length * t0, length * t1, length**2 * c0, length**2 * c1
    u = np.linspace(0.0, 1.0, max(int(length / KNOT_SPACING) + 2, 6))[1:-1, None]
    # Quintic Hermite basis.
    u2, u3 = u * u, u * u * u
    h0 = 1 - u3 * (10 - 15 * u + 6 * u2)
    h1 = u - u3 * (6 - 8 * u + 3 * u2)
    h2 = 0.5 * u2 - u3 * (1.5 - 1.5 * u + 0.5 * u2)
    h3 = u3 * (0.5 - u + 0.5 * u2)
    h4 = u3 * (-4 + 7 * u - 3 * u2)
    return np.asarray(h0 * q0 + h1 * d0 + h2 * a0 + h3 * a1 + h4 * d1 + (1 - h0) * q1)


def _frame(leg: Leg, at: float, speeds: Array) -> tuple[Array, Array, Array]:
    """Point, unit tangent and curvature of a leg, in units of joint angle over phase."""
    t = np.array([at])
    q, first, second = (leg.curve(t, order)[0] for order in range(3))
    scale = float(np.linalg.norm(first / speeds))
    if scale < 1e-12:
        return q, np.zeros_like(q), np.zeros_like(q)
    tangent = first / scale
    along = float((second / speeds) @ (tangent / speeds))
    return q, tangent, (second - along * tangent) / scale**2

"""The geometry of a move: joint lines and straight vertical strokes, rounded where they meet.

A path is a smooth curve in joint space over a phase that grows by one for every second at full joint speed.
How fast it is travelled is decided elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from controller.domain import ArmDescription, Array
from controller.errors import Unreachable
from controller.motion.kinematics import branches, chain, points, solutions

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

# Knots every 12 ms of full speed: the spline between them leaves a vertical stroke by less than 1 um.
KNOT_SPACING = 0.012
_CUBIC = 4  # knots that a cubic spline needs
_STROKE_STEP = 5.0  # mm between the points of a straight line that are checked against the reach
_DIFFERENCE = 1e-4  # share of a stroke


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """One piece of a path over its own parameter in [0, 1].

    Attributes:
        curve: Maps parameters (N,) to joint angles (N, J), rad.
        bends: Whether the curve is not straight in joint space.
        length: Length at full joint speed, s.
        travel: Two ndarrays of the same shape: parameters, and how far the grasp point has come there, mm.
        start: Joint angles at its start: ndarray of shape (J,), rad.
        end: Joint angles at its end: ndarray of shape (J,), rad.
    """

    curve: Callable[[Array], Array]
    bends: bool
    length: float
    travel: tuple[Array, Array]
    start: Array
    end: Array

    def reversed(self) -> Leg:
        """The same way back."""
        t, way = self.travel
        curve = self.curve
        back = 1.0 - t[::-1], way[-1] - way[::-1]
        return Leg(lambda t: curve(1.0 - t), self.bends, self.length, back, self.end, self.start)

    def frame(self, at: float) -> tuple[Array, Array, Array]:
        """Joint angles and their first and second derivative by the parameter, each (J,)."""
        before, here, after = self.curve(np.array([at - _DIFFERENCE, at, at + _DIFFERENCE]))
        # Exact solutions a hair apart: good to 1e-14, so is their second difference to 1e-6.
        second = (after - 2.0 * here + before) / _DIFFERENCE**2 if self.bends else 0.0 * here
        return here, (after - before) / (2.0 * _DIFFERENCE), second


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A curve in joint space.

    Attributes:
        spline: Joint angles (rad) over the phase.
        length: Largest phase; about the duration at full joint speed, s.
        marks: Phases where the legs begin and end, the roundings between them: 2 a leg.
    """

    spline: BSpline
    length: float
    marks: tuple[float, ...]


def speed_limits(arm: ArmDescription) -> Array:
    """Planned joint speeds at most: ndarray of shape (J,), rad/s."""
    return np.array([joint.speed_limit for joint in arm.joints])


def line(arm: ArmDescription, start: Array, end: Array) -> Leg:
    """The straight line in joint space."""
    delta = end - start

    def curve(t: Array) -> Array:
        return np.asarray(start + t[:, None] * delta)

    t = np.linspace(0.0, 1.0, 17)
    way = points(arm, curve(t))[:, 3]
    travel = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    return Leg(curve, False, float(np.linalg.norm(delta / speed_limits(arm))), (t, travel), start, end)


def stroke(arm: ArmDescription, posture: Array, rise: float) -> Leg:
    """The straight vertical line of the grasp point, the tool's direction and the branch kept.

    Args:
        arm: The arm.
        posture: Joint angles where it starts, rad.
        rise: How far up (negative: down), mm.

    Raises:
        Unreachable: Some point of it is out of reach.
    """
    return straight(arm, posture, np.array([0.0, 0.0, rise]))


def straight(arm: ArmDescription, posture: Array, by: Array) -> Leg:
    """The straight line of the grasp point, the tool's pitch, its roll joint and the branch kept.

    Args:
        arm: The arm.
        posture: Joint angles where it starts, rad.
        by: ndarray of shape (3,), how far in `base`, mm.

    Raises:
        Unreachable: Some point of it is out of reach.
    """
    start = points(arm, posture)[3]
    pitch, roll, branch = branch_of(arm, posture)

    def solve(t: Array) -> tuple[Array, NDArray[np.bool_]]:
        q, allowed = branches(arm, start + t[:, None] * by, pitch, roll)
        return q[:, branch], allowed[:, branch]

    distance = float(np.linalg.norm(by))
    t = np.linspace(0.0, 1.0, max(int(distance / _STROKE_STEP) + 1, 3))
    q, allowed = solve(t)
    if not allowed.all():
        x, y, z = start + by * t[int(np.argmin(allowed))]
        raise Unreachable(
            f"the straight way from ({start[0]:.0f}, {start[1]:.0f}, {start[2]:.0f}) mm leaves the arm's reach at "
            f"({x:.0f}, {y:.0f}, {z:.0f}) mm",
            "move the part or the bin nearer, or step another way",
        )
    length = float(np.linalg.norm(np.diff(q, axis=0) / speed_limits(arm), axis=1).sum())
    travel = np.array([0.0, 1.0]), np.array([0.0, distance])
    return Leg(lambda t: solve(t)[0], True, length, travel, q[0], q[-1])


def rest_of(arm: ArmDescription, positions: Array, start: Array) -> Leg:
    """What is left of a move from its pose that is nearest to another.

    Args:
        arm: The arm.
        positions: ndarray of shape (N, J): the move, rad.
        start: ndarray of shape (J,), rad.
    """
    from scipy.interpolate import make_interp_spline

    speeds = speed_limits(arm)
    left = positions[int(np.abs((positions - start) / speeds).max(axis=1).argmin()) :]
    phase = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(left, axis=0) / speeds, axis=1))])
    # A move dwells where it ends: of its poses those that lie some way apart.
    wanted = np.linspace(0.0, phase[-1], int(phase[-1] / KNOT_SPACING) + 1)
    apart = np.unique(np.searchsorted(phase, wanted).clip(max=len(phase) - 1))
    if len(apart) < _CUBIC:
        return line(arm, left[0], left[-1])
    spline = make_interp_spline(phase[apart] / phase[apart[-1]], left[apart])
    way = np.linalg.norm(np.diff(points(arm, left[apart])[:, 3], axis=0), axis=1)
    travel = phase[apart] / phase[apart[-1]], np.concatenate([[0.0], np.cumsum(way)])
    return Leg(lambda t: np.asarray(spline(t)), True, float(phase[-1]), travel, left[0], left[apart[-1]])


def branch_of(arm: ArmDescription, posture: Array) -> tuple[float, float, int]:
    """Pitch and roll of the tool (rad) and the index of the branch that gives this posture back.

    Raises:
        Unreachable: No branch does: the waist stands where the grasp point has no direction.
    """
    place = points(arm, posture)[3]
    azimuth = math.atan2(place[1], place[0] - chain(arm).axis[0])
    facing = math.cos(posture[0] - azimuth) > 0.0
    below = float(posture[1:4].sum())
    pitch = below if facing else math.pi - below
    roll = float(posture[4]) if len(posture) > 4 else 0.0
    roll = roll if facing else roll + math.pi
    for branch, q in solutions(arm, place, pitch, roll, within=False):
        if np.abs(q - posture).max() < 1e-6:
            return pitch, roll, branch
    raise Unreachable("the arm stands folded so that its tool cannot be moved straight up", "move it by hand")


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
        t, travel = leg.travel
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
        count = max(int(leg.length * (high - low) / KNOT_SPACING) + 2, _CUBIC)
        marks.append(total_count)
        add(leg.curve(np.linspace(low, high, count)))
        marks.append(total_count - 1)
        if k + 1 < len(legs):
            add(_corner(leg, high, legs[k + 1], cuts[k + 1, 0], speeds))
    # Half a second to load: for those who plan, not for every command.
    from scipy.interpolate import make_interp_spline

    q = np.concatenate(samples)
    steps = np.linalg.norm(np.diff(q, axis=0) / speeds, axis=1)
    phase = np.concatenate([[0.0], np.cumsum(steps)])
    keep = np.concatenate([[True], steps > 1e-9])  # legs of no length repeat a knot
    if keep.sum() < _CUBIC:
        still = np.arange(_CUBIC) * 1e-6
        spline = make_interp_spline(still, np.repeat(q[:1], _CUBIC, axis=0))
        return Path(spline, float(still[-1]), (0.0, float(still[-1])))
    spline = make_interp_spline(phase[keep], q[keep], check_finite=False)
    return Path(spline, float(phase[-1]), tuple(float(phase[m]) for m in marks))


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
    q, first, second = leg.frame(at)
    scale = float(np.linalg.norm(first / speeds))
    if scale < 1e-12:
        return q, np.zeros_like(q), np.zeros_like(q)
    tangent = first / scale
    along = float((second / speeds) @ (tangent / speeds))
    return q, tangent, (second - along * tangent) / scale**2

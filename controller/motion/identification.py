"""What an arm's own moves say about its servos and links: the figures behind the offset against sag and lag.

A servo in position mode pushes with `stiffness * (goal - position)`. Over a logged move both are known, so that
everything the joint had to overcome (gravity and inertia of its links, its rotor's inertia, back-EMF, friction) can
be fitted, in units of the stiffness: only those ratios matter to the offset, and only they can be told apart.

Source: the equations of `dynamics`; least squares with a normal prior about the described figures, e.g. Swevers,
Verdonck and De Schutter, "Dynamic Model Identification for Industrial Robots", IEEE Control Systems 2007.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from controller.domain import ArmDescription, Array, ServoCycle, ServoDynamics
from controller.errors import CalibrationPoorFit
from controller.motion import dynamics
from controller.motion.kinematics import TOP_DOWN, chain, inverse, solutions
from controller.motion.trajectory import PERIOD

# Logs are smoothed over 110 ms: longer than the servos' own 45 ms of lag, shorter than a move's phases.
_WINDOW, _ORDER = 11, 3
_MOVING = 0.05  # rad/s: below it friction may have either sign, so that nothing can be learnt from it
_TICK = 2.0 * np.pi / 4096.0
_NOISE = _TICK / 2.0  # rad: rounding of a position, and what the smoothing leaves
# How far an arm may be from its description: a fifth in masses and gains, twice in what nobody publishes.
_PRIOR_LOAD, _PRIOR_OTHER = 0.2, 1.0
_PITCHES = (TOP_DOWN, 1.3, 1.0)  # rad below the horizon
# Friction that was measured may be made up for nearly whole: what is left decides where a joint stops.
_FRICTION_SHARE = 0.9
_FEWEST = 300  # samples of a joint in motion
_LARGEST_CHANGE = 1.0  # a share: beyond it the description belongs to another arm
_WORST_RESIDUAL = 0.02  # rad


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """An arm's dynamics as its moves showed them.

    Attributes:
        arm: Name of the arm.
        joints: Dynamics of every joint, base to tool; the stiffness carries the scale of its loads.
        link_scale: Mass of every link over the described one.
        before, after: Root mean square of goal minus predicted goal, rad, with the described and the fitted figures.
        samples: Cycles used.
    """

    arm: str
    joints: tuple[ServoDynamics, ...]
    link_scale: tuple[float, ...]
    before: Array
    after: Array
    samples: int


def ordinary_moves(arm: ArmDescription, height: float) -> tuple[Array, ...]:
    """Postures to go through in turn: up and down, near and far, left and right, the wrist turned.

    Args:
        arm: The arm.
        height: Height of the grasp point in `base` at the lowest, mm.

    Raises:
        Unreachable: The arm's joints do not allow them.
    """
    places = (
        (0.34, -0.7, 0.0, 0.4), (0.45, 0.5, 0.0, -0.9), (0.36, 0.9, 0.12, 1.1), (0.46, -0.4, 0.0, 0.2),
        (0.34, 0.2, 0.10, -1.2), (0.45, -0.8, 0.05, 1.2), (0.36, -0.1, 0.0, -0.6), (0.44, 0.8, 0.06, 0.0),
    )  # fmt: skip
    c = chain(arm)
    reach = c.start + c.upper[0] + c.fore[0] + c.hand
    return tuple(
        _posture(arm, radius * reach, azimuth, height + rise * reach, roll) for radius, azimuth, rise, roll in places
    )


def _posture(arm: ArmDescription, radius: float, azimuth: float, height: float, roll: float) -> Array:
    """Pointing down at a place about the waist, or as steeply as the joints allow. Raises Unreachable."""
    axis = chain(arm).axis[0]
    position = (axis + radius * math.cos(azimuth), radius * math.sin(azimuth), height)
    roll = roll if len(arm.joints) > 4 else 0.0
    for pitch in _PITCHES:
        found = list(solutions(arm, position, pitch, roll, within=True))
        if found:
            return np.array(found[0][1])
    return np.asarray(inverse(arm, position, roll=roll)[0])


def identify(arm: ArmDescription, moves: Sequence[Sequence[ServoCycle]]) -> Identification:
    """Fit loads, rotor inertia, back-EMF and friction of every joint to logged moves.

    Args:
        arm: The arm as it is described.
        moves: The cycles of each move, in order, empty-handed.

    Raises:
        CalibrationPoorFit: Too little motion, or moves that no such arm makes.
    """
    logs = [_regressors(arm, piece) for cycles in moves for piece in _unbroken(cycles)]
    if not logs:
        raise CalibrationPoorFit("no move was logged", "let the arm make its moves undisturbed")
    error, loads, qd, qdd = (np.concatenate([log[k] for log in logs]) for k in range(4))
    moving = np.abs(qd) > _MOVING
    if moving.sum(axis=0).min() < _FEWEST:
        raise CalibrationPoorFit("a joint hardly moved", "let the arm make all its moves")
    nominal = [joint.dynamics for joint in arm.joints]
    stiffness = np.array([servo.stiffness for servo in nominal])
    slide = np.tanh(qd / dynamics.FRICTION_SPEED)
    own = np.stack(
        [
            qdd * [servo.inertia for servo in nominal],
            qd * [servo.damping for servo in nominal],
            slide * [servo.friction for servo in nominal],
        ],
        axis=2,
    )
    count, links = len(arm.joints), loads.shape[2]

    def predicted(x: Array) -> Array:
        scale, rest = x[:links], x[links:].reshape(count, 4)
        together = loads @ scale * rest[:, 0] + np.einsum("njk,jk->nj", own, rest[:, 1:])
        return np.asarray(together / stiffness)

    prior = np.concatenate(
        [np.full(links, _PRIOR_LOAD), np.tile([_PRIOR_LOAD, _PRIOR_OTHER, _PRIOR_LOAD, _PRIOR_OTHER], count)]
    )

    def residuals(x: Array) -> Array:
        # Samples 10 ms apart share their smoothing: counted as one in a window.
        off = (predicted(x) - error)[moving] / (_NOISE * np.sqrt(_WINDOW))
        return np.concatenate([off, (x - 1.0) / prior])

    # Slow to load: for those who identify an arm, not for all who read what was identified.
    from scipy.optimize import least_squares

    start = np.ones(len(prior))
    fit = least_squares(residuals, start, bounds=(0.05, 5.0), loss="soft_l1", f_scale=3.0)
    before, after = (
        np.sqrt(np.array([np.mean((predicted(x) - error)[moving[:, j], j] ** 2) for j in range(count)]))
        for x in (start, fit.x)
    )
    if after.max() > _WORST_RESIDUAL:
        joint = arm.joints[int(after.argmax())].name
        raise CalibrationPoorFit(
            f"{joint} misses its model by {np.degrees(after.max()):.1f} deg", "look whether something hinders the arm"
        )
    scale, rest = fit.x[:links], fit.x[links:].reshape(count, 4)
    if np.abs(np.concatenate([scale, rest[:, 0]]) - 1.0).max() > _LARGEST_CHANGE:
        raise CalibrationPoorFit("the loads do not fit the description", "check that this is the arm described")
    # A joint's stiffness and its loads only show as a ratio: the stiffness takes it, the rest follows.
    joints = tuple(
        ServoDynamics(
            stiffness=float(servo.stiffness / own_[0]),
            damping=float(servo.damping * own_[2] / own_[0]),
            friction=float(servo.friction * own_[3] / own_[0]),
            inertia=float(servo.inertia * own_[1] / own_[0]),
            friction_share=_FRICTION_SHARE,
        )
        for servo, own_ in zip(nominal, rest, strict=True)
    )
    return Identification(arm.name, joints, tuple(map(float, scale)), before, after, int(moving.any(axis=1).sum()))


def identified(
    arm: ArmDescription, joints: Sequence[ServoDynamics], link_scale: Sequence[float]
) -> ArmDescription:
    """The description with identified figures in place of the published ones.

    Args:
        arm: The arm.
        joints: Dynamics, base to tool.
        link_scale: Mass of every link over the described one.
    """
    return replace(
        arm,
        joints=tuple(replace(joint, dynamics=own) for joint, own in zip(arm.joints, joints, strict=True)),
        links=tuple(replace(link, mass=link.mass * s) for link, s in zip(arm.links, link_scale, strict=True)),
    )


def _unbroken(cycles: Sequence[ServoCycle]) -> list[Sequence[ServoCycle]]:
    """The stretches of a move in which no cycle is missing."""
    sent = np.array([cycle.sent_at for cycle in cycles])
    gaps = [0, *(np.nonzero(np.diff(sent) > 1.5 * PERIOD)[0] + 1).tolist(), len(cycles)]
    pieces = [cycles[a:b] for a, b in pairwise(gaps)]
    return [piece for piece in pieces if len(piece) > 2 * _WINDOW]


def _regressors(arm: ArmDescription, cycles: Sequence[ServoCycle]) -> tuple[Array, Array, Array, Array]:
    """Of one move: goal minus position, torque of every link on every joint, speed and acceleration.

    All are taken in the middle of the time in which a goal was in force.
    """
    from scipy.signal import savgol_filter

    goals = np.array([cycle.goals for cycle in cycles])
    positions = np.array([cycle.positions for cycle in cycles])
    delay = float(np.mean([cycle.read_at - cycle.sent_at for cycle in cycles]))
    q, qd, qdd = (
        savgol_filter(positions, _WINDOW, _ORDER, deriv=k, delta=PERIOD, axis=0) for k in range(3)
    )
    # The position was measured about half the exchange after the goal went out.
    ahead = dynamics.lead(PERIOD) - delay / 2.0
    q = q + qd * ahead + qdd * (ahead**2 / 2.0)
    qd = qd + qdd * ahead
    inner = slice(_WINDOW // 2, len(cycles) - _WINDOW // 2)
    q, qd, qdd, goals = q[inner], qd[inner], qdd[inner], goals[inner]
    return goals - q, _loads(arm, q, qd, qdd), qd, qdd


def _loads(arm: ArmDescription, q: Array, qd: Array, qdd: Array) -> Array:
    """Torque that each link by itself asks of every joint: ndarray of shape (N, J, L), Nm."""
    found = []
    for k in range(len(arm.links)):
        links = tuple(replace(link, mass=link.mass if i == k else 0.0) for i, link in enumerate(arm.links))
        found.append(dynamics.torque(replace(arm, links=links), q, qd, qdd))
    return np.stack(found, axis=2)

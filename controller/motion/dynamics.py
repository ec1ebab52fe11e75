"""What a servo must be told so that the joint goes where it shall: the offset against sag and lag.

A Dynamixel in position mode is a spring: it pushes with `stiffness * (goal - position)` against gravity, inertia,
back-EMF and friction. Telling it the wanted angle alone misses by centimetres. The model here is the arm as point
masses in one plane plus each joint's own rotor; every parameter comes from the arm's description, so that figures
identified from logs replace the nominal ones without a change here.

Source: Lagrange's equations of point masses in cylindrical coordinates, e.g. Spong, Robot Modeling and
Control, chapter 7.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from controller.domain import ArmDescription, Array
from controller.motion.by_arm import once_per_arm

GRAVITY = 9.80665  # m/s^2
# The tanh spreads the change of friction's sign over +-0.05 rad/s, two encoder ticks in one 100 Hz period.
FRICTION_SPEED = 0.05  # rad/s
# The servo takes a goal once a period and holds it; half a period and the loop's own millisecond make it late.
LOOP_DELAY = 0.001  # s
_M = 1e-3  # mm to m


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """An arm as numbers: metres and kilograms."""

    start: float
    # Each body's way from the shoulder: (x, z) along and across the upper arm, the forearm, the hand; (B, 3, 2).
    # The last is the payload.
    legs: Array
    masses: Array
    column: float  # moment of inertia of what turns with the waist only, kg m^2
    stiffness: Array
    damping: Array
    friction: Array
    inertia: Array


@once_per_arm
def _model(arm: ArmDescription) -> _Model:
    joints, links = arm.joints, arm.links
    # What the roll joint carries sits on its axis as far as the plane is concerned.
    shift = [0.0, 0.0, 0.0, 0.0] + [joint.offset[0] for joint in joints[4:]]
    centers = [(link.center[0] + shift[k], link.center[2]) for k, link in enumerate(links)][1:]
    centers.append((sum(shift) + arm.tool[0], 0.0))
    legs = np.zeros((len(centers), 3, 2))
    for k, center in enumerate(centers):
        carrier = min(k, 2)
        for j in range(carrier):
            legs[k, j] = joints[j + 2].offset[0], joints[j + 2].offset[2]
        legs[k, carrier] = center
    first = links[0]
    servo = [joint.dynamics for joint in joints]
    return _Model(
        start=joints[1].offset[0] * _M,
        legs=legs * _M,
        masses=np.array([*(link.mass for link in links[1:]), 0.0]),
        column=first.mass * (first.center[0] ** 2 + first.center[1] ** 2) * _M**2,
        stiffness=np.array([s.stiffness for s in servo]),
        damping=np.array([s.damping for s in servo]),
        friction=np.array([s.friction_share * s.friction for s in servo]),
        inertia=np.array([s.inertia for s in servo]),
    )


def torque(arm: ArmDescription, q: Array, qd: Array, qdd: Array, payload: Array | float = 0.0) -> Array:
    """Torque the links and the payload ask of the joints (rotors, back-EMF and friction left out).

    Args:
        arm: The arm.
        q: ndarray of shape (N, J), rad.
        qd: ndarray of shape (N, J), rad/s.
        qdd: ndarray of shape (N, J), rad/s^2.
        payload: Mass at the grasp point, kg; scalar or ndarray of shape (N,).

    Returns:
        ndarray of shape (N, J), Nm, about the joints' own axes.
    """
    m = _model(arm)
    below = np.cumsum(q[:, 1:4], axis=1)
    rate = np.cumsum(qd[:, 1:4], axis=1)
    gain = np.cumsum(qdd[:, 1:4], axis=1)
    cos, sin = np.cos(below), np.sin(below)
    spin, spin_gain = qd[:, 0], qdd[:, 0]
    mass = np.repeat(m.masses[:, None], len(q), axis=1)
    mass[-1] = payload
    # From joint to joint on the way to each body, outwards and up: (bodies, N, 3).
    out = m.legs[:, None, :, 0] * cos + m.legs[:, None, :, 1] * sin
    up = m.legs[:, None, :, 1] * cos - m.legs[:, None, :, 0] * sin
    w2 = rate * rate
    radius = m.start + out.sum(axis=2)
    radius_rate = (rate * up).sum(axis=2)
    push = mass * ((gain * up - w2 * out).sum(axis=2) - radius * spin**2)
    lift = mass * (GRAVITY - (gain * out + w2 * up).sum(axis=2))
    about = (push[..., None] * up - lift[..., None] * out).sum(axis=0)  # each planar body's own absolute angle
    tau = np.zeros_like(q)
    tau[:, 0] = m.column * spin_gain + (mass * radius * (radius * spin_gain + 2.0 * radius_rate * spin)).sum(axis=0)
    tau[:, 1:4] = np.cumsum(about[:, ::-1], axis=1)[:, ::-1]
    return tau


def offset(arm: ArmDescription, q: Array, qd: Array, qdd: Array, payload: Array | float = 0.0) -> Array:
    """How far ahead of the wanted angles the goals must be: ndarray of shape (N, J), rad; arguments as of `torque`."""
    m = _model(arm)
    friction = m.friction * np.tanh(qd / FRICTION_SPEED)
    total = torque(arm, q, qd, qdd, payload) + m.inertia * qdd + m.damping * qd + friction
    return np.asarray(total / m.stiffness)


def joint_offsets(arm: ArmDescription, calibrated: Mapping[str, float]) -> Array:
    """Calibrated joint offsets in joint order (0 where there is none): ndarray of shape (J,), rad."""
    return np.array([calibrated.get(name, 0.0) for name in arm.joint_names])


def lead(period: float) -> float:
    """How far ahead of its sample a streamed goal looks, s: half a period and the servo's loop time."""
    return period / 2.0 + LOOP_DELAY

"""Register units to the core's and back, and the gripper's mechanisms: small pure functions.

Source: ROBOTIS e-Manual, X series: one turn is 4096 ticks with 2048 in the middle; a unit of velocity is
0.229 rev/min. With the right Drive_Mode a joint's angle grows with its ticks for every arm described.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.domain import Gripper
from drivers.arm.control_table import PWM_FULL

TICKS_PER_RAD = 4096 / (2.0 * math.pi)
CENTER_TICKS = 2048
TICKS_MAX = 4095
VELOCITY_UNIT = 0.229 * 2.0 * math.pi / 60.0
"""rad/s per unit of Present_Velocity."""
VOLTAGE_UNIT = 0.1
"""V per unit of Present_Input_Voltage."""


def ticks_from_angles(angles: ArrayLike) -> NDArray[np.int64]:
    """Goal_Position for joint angles (rad), to the nearest tick."""
    ticks: NDArray[np.int64] = np.rint(np.asarray(angles, np.float64) * TICKS_PER_RAD + CENTER_TICKS).astype(np.int64)
    return ticks


def ticks_from_angle(angle: float) -> int:
    """Goal_Position for one joint angle (rad), to the nearest tick."""
    return round(angle * TICKS_PER_RAD + CENTER_TICKS)


def stall_angle(position_p_gain: int) -> float:
    """Angle between goal and joint at which the P gain alone asks for all of the PWM, rad.

    Source: ROBOTIS e-Manual, X series, "Position PID Gain": PWM = Position_P_Gain / 128 * ticks.
    """
    return PWM_FULL * 128.0 / position_p_gain / TICKS_PER_RAD


def angle_from_ticks(ticks: int) -> float:
    """Joint angle (rad) of a Present_Position."""
    return (ticks - CENTER_TICKS) / TICKS_PER_RAD


def opening_from_angle(gripper: Gripper, angle: float) -> float:
    """Clear opening (mm) of a gripper whose servo stands at `angle` (rad)."""
    if gripper.mechanism == "rack":
        per_rad, at_zero = gripper.parameters
        return at_zero + per_rad * angle
    radius, link, inset = gripper.parameters
    return 2.0 * (radius * math.sin(angle) + math.sqrt(link**2 - (radius * math.cos(angle)) ** 2)) - 2.0 * inset


def angle_from_opening(gripper: Gripper, opening: float) -> float:
    """Servo angle (rad) that gives a clear opening (mm).

    The crank is solved by the cosine rule in the triangle of horn, link and jaw: with f the jaw's distance from
    the centre, l^2 = f^2 + r^2 - 2 f r sin a. Openings beyond its dead points give the dead point.
    """
    if gripper.mechanism == "rack":
        per_rad, at_zero = gripper.parameters
        return (opening - at_zero) / per_rad
    radius, link, inset = gripper.parameters
    jaw = min(max(opening / 2.0 + inset, link - radius), link + radius)
    sine = (jaw**2 + radius**2 - link**2) / (2.0 * jaw * radius)
    return math.asin(min(max(sine, -1.0), 1.0))


def opening_sign(gripper: Gripper) -> int:
    """+1 where the jaws open with growing angle, -1 where they close."""
    return -1 if gripper.mechanism == "rack" and gripper.parameters[0] < 0.0 else 1

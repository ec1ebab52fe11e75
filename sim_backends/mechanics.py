"""What turns in a servo and what a gripper's servo moves: gear trains, cranks and racks of the simulated arms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from controller.domain import Gripper
from controller.errors import ConfigError

MM = 1e-3  # m, MuJoCo's unit


@dataclass(frozen=True, slots=True)
class ServoMechanics:
    """What the world knows of a servo model: its gear train, not its electronics.

    Attributes:
        friction: Coulomb friction at the horn, Nm.
        inertia: Rotor inertia seen at the horn, kg m^2.
    """

    friction: float
    inertia: float


# Friction and inertia are assumed, between published models of the XM430 (0.012 to 0.045 kg m^2).
SERVOS = {
    "XM430-W350": ServoMechanics(0.08, 0.028),
    "XL430-W250": ServoMechanics(0.05, 0.012),
}


def mechanics(model: str) -> ServoMechanics:
    """Gear train of a servo model.

    Raises:
        ConfigError: The world does not know it.
    """
    for name, found in SERVOS.items():
        if model.startswith(name):
            return found
    raise ConfigError(f"the simulated world has no servo {model!r}", f"it knows {', '.join(SERVOS)}")


def half_opening(gripper: Gripper, angle: float) -> float:
    """Distance of one pad from the middle, mm, at a servo angle (rad, as registered with the right Drive_Mode).

    Source: slider-crank mechanism; horn radius and link length from Interbotix xs_driver.cpp.
    """
    if gripper.mechanism == "rack":
        per_rad, at_zero = gripper.parameters
        return (at_zero + per_rad * angle) / 2.0
    horn, link, inset = gripper.parameters
    return horn * math.sin(angle) + math.sqrt(link**2 - (horn * math.cos(angle)) ** 2) - inset


def servo_angle(gripper: Gripper, opening: float) -> float:
    """Servo angle (rad) at a clear opening (mm); the inverse of `half_opening`."""
    if gripper.mechanism == "rack":
        per_rad, at_zero = gripper.parameters
        return (opening - at_zero) / per_rad
    horn, link, inset = gripper.parameters
    half = opening / 2.0 + inset
    return math.asin(max(-1.0, min(1.0, (horn**2 + half**2 - link**2) / (2.0 * horn * half))))


def horn_range(gripper: Gripper) -> tuple[float, float]:
    """Mechanical stops of the gripper's servo, rad: a millimetre beyond the described openings."""
    ends = (servo_angle(gripper, gripper.opening[0] - 1.0), servo_angle(gripper, gripper.opening[1] + 1.0))
    return min(ends), max(ends)


def coupling(gripper: Gripper) -> tuple[float, ...]:
    """Coefficients of the quartic in the servo angle that MuJoCo's joint equality uses for half the opening, m."""
    low, high = horn_range(gripper)
    # Chebyshev nodes spread the error of the fit evenly (below 0.04 mm for the crank of the X-series arms).
    nodes = (low + high) / 2.0 + (high - low) / 2.0 * np.cos(math.pi * (np.arange(40) + 0.5) / 40.0)
    halves = np.array([half_opening(gripper, float(a)) for a in nodes]) * MM
    return tuple(float(c) for c in np.polynomial.polynomial.polyfit(nodes, halves, 4))

"""The shafts: the seam between the virtual servos and the world whose joints they turn.

Everything here speaks of the bare output shaft of a servo as it is mounted: before Drive_Mode, in rad
from the middle of the encoder (tick 2048), in Nm and V as physics has it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol


class Shaft(NamedTuple):
    """What an encoder could see.

    Attributes:
        angle: rad.
        velocity: rad/s.
        torque: Torque the motor applies, Nm.
    """

    angle: float
    velocity: float
    torque: float


class Drive(NamedTuple):
    """What the servo's controller does to its motor until told otherwise.

    torque = clip(stiffness * (target - angle) + bias, -limit, limit) - damping * velocity

    Attributes:
        target: rad.
        stiffness: Nm/rad.
        damping: Nm s/rad, the motor's back-EMF; acts also with torque off (gear friction is the world's).
        bias: Nm.
        limit: Nm; 0 is torque off.
    """

    target: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    bias: float = 0.0
    limit: float = 0.0


class Plant(Protocol):
    """The mechanical world behind a servo bus. Not thread-safe: one thread advances and reads it."""

    def now(self) -> float:
        """Simulated time, s."""
        ...

    def advance(self, seconds: float) -> None:
        """Let `seconds` of simulated time pass (whole physics steps; the remainder is carried over)."""
        ...

    def shaft(self, servo_id: int) -> Shaft:
        """The shaft of one servo, with the encoder's own errors."""
        ...

    def drive(self, servo_id: int, drive: Drive) -> None:
        """Apply from now on."""
        ...

    def on_step(self, callback: Callable[[float], None]) -> None:
        """Have `callback(dt)` called before every physics step of `dt` s (profiles, watchdogs, heating)."""
        ...

"""A mechanical world without a world: independent shafts, for tests that need no physics engine."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from sim_backends.plant import Drive, Shaft


class _Wheel:
    def __init__(self) -> None:
        self.angle = self.velocity = self.torque = 0.0
        self.low, self.high, self.load = -math.inf, math.inf, 0.0
        self.target = self.stiffness = self.damping = self.bias = self.limit = 0.0


class IdealPlant:
    """Shafts with inertia, moved by nothing but their motors.

    Args:
        servo_ids: One shaft each.
        dt: Length of a step, s.
        inertia: kg m^2 at each output shaft; the default is that of a loaded wrist joint, which the factory
            gains of an XM430 settle within half a second.
    """

    def __init__(self, servo_ids: Iterable[int], dt: float = 0.002, inertia: float = 0.02) -> None:
        self._wheels = {servo_id: _Wheel() for servo_id in servo_ids}
        self._dt = dt
        self._inertia = inertia
        self._now = 0.0
        self._stepped = 0.0
        self._callbacks: list[Callable[[float], None]] = []

    def now(self) -> float:
        """Simulated time, s, the part of a step that is still owed included."""
        return self._now

    def advance(self, seconds: float) -> None:
        """Let `seconds` pass in whole steps; the remainder is carried over."""
        end = self._now + max(0.0, seconds)
        while self._stepped + self._dt <= end + 1e-12:
            self._now = max(self._now, self._stepped)
            for callback in self._callbacks:
                callback(self._dt)
            for wheel in self._wheels.values():
                self._turn(wheel)
            self._stepped += self._dt
        self._now = end

    def _turn(self, wheel: _Wheel) -> None:
        """One semi-implicit Euler step, implicit in the damping and stable for it."""
        dt, inertia = self._dt, self._inertia
        motor = wheel.stiffness * (wheel.target - wheel.angle) + wheel.bias
        motor = max(-wheel.limit, min(wheel.limit, motor))
        velocity = (wheel.velocity + dt / inertia * (motor + wheel.load)) / (1.0 + dt / inertia * wheel.damping)
        angle = wheel.angle + dt * velocity
        if not wheel.low <= angle <= wheel.high:
            angle = max(wheel.low, min(wheel.high, angle))
            velocity = 0.0
        wheel.angle, wheel.velocity = angle, velocity
        wheel.torque = motor - wheel.damping * velocity

    def shaft(self, servo_id: int) -> Shaft:
        """The shaft of one servo; its encoder is perfect."""
        wheel = self._wheels[servo_id]
        return Shaft(wheel.angle, wheel.velocity, wheel.torque)

    def drive(self, servo_id: int, drive: Drive) -> None:
        """Apply from the next step on."""
        wheel = self._wheels[servo_id]
        wheel.target, wheel.stiffness, wheel.damping = drive.target, drive.stiffness, drive.damping
        wheel.bias, wheel.limit = drive.bias, drive.limit

    def on_step(self, callback: Callable[[float], None]) -> None:
        """Have `callback(dt)` called before every step."""
        self._callbacks.append(callback)

    def block(self, servo_id: int, low: float = -math.inf, high: float = math.inf) -> None:
        """Let hard stops hold a shaft within [low, high], rad."""
        wheel = self._wheels[servo_id]
        wheel.low, wheel.high = low, high

    def place(self, servo_id: int, angle: float) -> None:
        """Turn a shaft by hand to `angle`, rad, at rest."""
        wheel = self._wheels[servo_id]
        wheel.angle, wheel.velocity = angle, 0.0

    def load(self, servo_id: int, torque: float) -> None:
        """Hang a constant torque on a shaft, Nm."""
        self._wheels[servo_id].load = torque

"""The servo's own motion profile: where the goal of the position loop is at every moment of a move.

Positions are ticks, times s; a profile is planned once per goal and evaluated in closed form.

Source: ROBOTIS e-Manual, `dxl/x/xm430-w350`, "Profile Velocity", "Drive Mode", "What is the Profile".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

SPEED_UNIT = 0.229 / 60 * 4096
"""ticks/s per unit of Profile_Velocity (0.229 rev/min)."""
RAMP_UNIT = 214.577 / 3600 * 4096
"""ticks/s^2 per unit of Profile_Acceleration (214.577 rev/min^2)."""


@dataclass(frozen=True, slots=True)
class Profile:
    """Pieces of constant acceleration that end at rest at the goal.

    Attributes:
        start: Time of its beginning, s.
        pieces: (duration s, position, velocity, acceleration at its beginning) of each piece.
        goal: Ticks.
        kind: Bits 4-5 of Moving_Status: 1 rectangular, 2 triangular, 3 trapezoidal.
    """

    start: float
    pieces: tuple[tuple[float, float, float, float], ...]
    goal: float
    kind: int

    def at(self, now: float) -> tuple[float, float, bool]:
        """(position, velocity, it has ended) at a time."""
        t = now - self.start
        for duration, position, velocity, acceleration in self.pieces:
            if t < duration:
                return position + t * (velocity + 0.5 * acceleration * t), velocity + acceleration * t, False
            t -= duration
        return self.goal, 0.0, True


def _chain(start: float, position: float, velocity: float, steps: list[tuple[float, float]], goal: float) -> Profile:
    """A profile from (duration, acceleration) steps; velocity is continuous except where `steps` cannot be."""
    pieces = []
    for duration, acceleration in steps:
        if duration <= 0.0:
            continue
        pieces.append((duration, position, velocity, acceleration))
        position += duration * (velocity + 0.5 * acceleration * duration)
        velocity += acceleration * duration
    moving = [piece for piece in pieces if piece[3] == 0.0]
    return Profile(start, tuple(pieces), goal, 3 if moving else 2)


def rectangular(now: float, position: float, goal: float, speed: float) -> Profile:
    """Constant speed (ticks/s) at once, and none at the goal: Profile_Acceleration is 0."""
    distance = goal - position
    velocity = math.copysign(speed, distance)
    return Profile(now, ((abs(distance) / speed, position, velocity, 0.0),), goal, 1)


def trapezoidal(now: float, position: float, velocity: float, goal: float, speed: float, ramp: float) -> Profile:
    """Velocity-based profile: speed at most `speed` (ticks/s), acceleration `ramp` (ticks/s^2).

    A profile that replaces a running one goes on from its velocity. Assumption: it brakes, and turns back,
    with `ramp` where it would pass the goal or is faster than `speed`.
    """
    distance = goal - position
    stopping = velocity * abs(velocity) / (2.0 * ramp)
    direction = 1.0 if distance - stopping >= 0.0 else -1.0
    ahead = direction * distance
    initial = direction * velocity
    peak = min(math.sqrt(max(ramp * ahead + 0.5 * initial * initial, 0.0)), speed)
    if initial > speed:
        peak = speed
    first = (peak - initial) / ramp
    cruise = ahead - (peak * peak - initial * initial) / (2.0 * ramp) * (1.0 if first >= 0.0 else -1.0)
    cruise -= peak * peak / (2.0 * ramp)
    steps = [
        (abs(first), math.copysign(ramp, first) * direction),
        (cruise / peak if peak > 0.0 and cruise > 1e-9 else 0.0, 0.0),
        (peak / ramp, -ramp * direction),
    ]
    return _chain(now, position, velocity, steps, goal)


def timed(now: float, position: float, velocity: float, goal: float, duration: float, ramp: float) -> Profile:
    """Time-based profile: `duration` s in all, of which `ramp` s (at most half) at each end.

    Assumption: a profile that replaces a running one goes on from its velocity when it has a ramp; no manual
    says so.
    """
    ramp = min(ramp, 0.5 * duration)
    if ramp <= 0.0:
        distance = goal - position
        return Profile(now, ((duration, position, distance / duration, 0.0),), goal, 1)
    cruise = (goal - position - 0.5 * velocity * ramp) / (duration - ramp)
    steps = [(ramp, (cruise - velocity) / ramp), (duration - 2.0 * ramp, 0.0), (ramp, -cruise / ramp)]
    return _chain(now, position, velocity, steps, goal)


def plan(now: float, position: float, velocity: float, goal: float, speed: int, ramp: int, time_based: bool) -> Profile:
    """The profile that the registers ask for.

    Assumption: every write of a goal plans anew, also when the goal is the old one.

    Args:
        now: s.
        position: Where the running profile, or the servo, is, ticks.
        velocity: Of the running profile, ticks/s.
        goal: Ticks.
        speed: Profile_Velocity, not 0.
        ramp: Profile_Acceleration.
        time_based: Drive_Mode bit 2: both registers are milliseconds.
    """
    if time_based:
        return timed(now, position, velocity, goal, speed * 1e-3, ramp * 1e-3)
    if ramp:
        return trapezoidal(now, position, velocity, goal, speed * SPEED_UNIT, ramp * RAMP_UNIT)
    return rectangular(now, position, goal, speed * SPEED_UNIT)

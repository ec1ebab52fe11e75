"""A trajectory under way: how far it has come and what the servos are told, without a bus or a clock.

Progress follows measured time, but never jumps: time lost to a late cycle is lost to the trajectory too, and a
stop slows the progress down instead of the joints, so that they stay on their path.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from controller.domain import Trajectory

Array = NDArray[np.float64]

STOP_TIME = 0.12
"""s from full progress to none while a joint is at its full speed: keeps the servos below 0.8 of their power; 0.2 costs
more path. With their whole stall torque the waist would need 0.07."""

SHORTEST_STOP = 0.04
"""s from full progress to none at a third of the speed and below: in proportion to the speed, and in four goals."""

STANDSTILL = 0.060
"""A gap after which joints have come to rest at their last goal, s (their lag is 45 ms): restart from rest."""

BLEND_TIME = 0.25
"""s over which a difference between the last goal and the trajectory's first is led to zero."""

_LATE_PERIODS = 2


class Progress:
    """Where on a trajectory the goals are.

    Args:
        trajectory: What to stream.
        last_goals: ndarray of shape (J,), rad: what the servos were told last.
        full_speeds: ndarray of shape (J,), rad/s: the speeds at which a stop takes `STOP_TIME`.

    Attributes:
        phase: s along the trajectory.
        slipped: s of real time the trajectory has lost to late cycles.
    """

    def __init__(self, trajectory: Trajectory, last_goals: Array, full_speeds: Array) -> None:
        self.phase = 0.0
        self.slipped = 0.0
        self._trajectory = trajectory
        self._carry: Array = last_goals - trajectory.goals[0]
        self._blended = 0.0
        self._ramp = 1.0
        self._gain = 0.0
        self._stop_times = _stop_times(trajectory, full_speeds)

    @property
    def at_end(self) -> bool:
        """The last goal has been reached, nothing is left to blend."""
        return self.phase >= self._trajectory.duration and self._blended >= BLEND_TIME

    @property
    def standing(self) -> bool:
        """The goals do not move on, because of a stop."""
        return self._ramp <= 0.0

    @property
    def rate(self) -> float:
        """Progress per time, 0..1."""
        return 0.5 * (1.0 - math.cos(math.pi * self._ramp))

    @property
    def positions(self) -> Array:
        """Where the joints should be, rad."""
        return self._sample(self._trajectory.positions)

    @property
    def goals(self) -> Array:
        """What to tell the servos, rad."""
        left = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self._blended / BLEND_TIME)))
        return self._told() + left * self._carry

    def _told(self) -> Array:
        """The trajectory's goals for the rate it is passed at: the lead against lag shrinks with it, sag stays."""
        goals = self._sample(self._trajectory.goals)
        if self._trajectory.resting is not None:
            resting = self._sample(self._trajectory.resting)
            goals = resting + self.rate * (goals - resting)
        if self._trajectory.braking is not None:
            goals = goals + self._gain * self._sample(self._trajectory.braking)
        return goals

    def rest(self) -> None:
        """Begin at standstill."""
        self._ramp = self._gain = 0.0

    def advance(self, elapsed: float, stopping: bool) -> None:
        """Move on by at most two periods of the `elapsed` s, slowing down or speeding up as asked."""
        step = min(elapsed, _LATE_PERIODS * self._trajectory.period)
        self.slipped += elapsed - step
        if elapsed > STANDSTILL:
            self._ramp = 0.0
        before = self.rate
        if stopping:
            # Cycles add up to a whole ramp but for rounding.
            self._ramp = max(0.0, self._ramp - step / self._stop_time - 1e-9)
        else:
            self._ramp = min(1.0, self._ramp + step / STOP_TIME)
        self._gain = (self.rate - before) / step if step > 0.0 else 0.0
        moved = step * 0.5 * (before + self.rate)
        done = self.phase >= self._trajectory.duration
        self.phase = min(self._trajectory.duration, self.phase + moved)
        self._blended += step if done else moved

    def rebase(self, goals: Array) -> None:
        """Go on from other goals (rad), at rest: what the servos were told last is no longer in force."""
        self._blended = 0.0
        self.rest()
        self._carry = goals - self._told()

    @property
    def _stop_time(self) -> float:
        index = min(int(self.phase / self._trajectory.period), len(self._stop_times) - 1)
        return float(self._stop_times[index])

    def _sample(self, values: Array) -> Array:
        place = self.phase / self._trajectory.period
        index = min(int(place), len(values) - 1)
        share = place - index
        if share <= 0.0 or index + 1 >= len(values):
            return np.asarray(values[index])
        return np.asarray(values[index] * (1.0 - share) + values[index + 1] * share)


def _stop_times(trajectory: Trajectory, full_speeds: Array) -> Array:
    """How long a stop takes that begins at each sample: ndarray of shape (N,), s.

    In proportion to the fastest joint's speed, so that stops ask for the same deceleration wherever they begin; the
    samples that a full stop still passes count.
    """
    if len(trajectory.positions) < 2:
        return np.array([SHORTEST_STOP])
    speeds = np.abs(np.diff(trajectory.positions, axis=0)) / trajectory.period
    share = (speeds / full_speeds).max(axis=1)
    ahead = math.ceil(0.5 * STOP_TIME / trajectory.period)
    padded = np.concatenate([share, np.zeros(ahead)])
    passed = np.lib.stride_tricks.sliding_window_view(padded, ahead + 1).max(axis=1)
    return np.asarray(np.clip(STOP_TIME * passed, SHORTEST_STOP, STOP_TIME))

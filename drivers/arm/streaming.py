"""A trajectory under way: how far it has come and what the servos are told, without a bus or a clock.

Progress follows measured time, but never jumps: time lost to a late cycle is lost to the trajectory too, and a
stop slows the progress down instead of the joints, so that they stay on their path.
"""

from __future__ import annotations

import math
from enum import Enum, auto

import numpy as np
from numpy.typing import NDArray

from controller.domain import Trajectory

Array = NDArray[np.float64]

LONGEST_RAMP = 0.12
"""s from full progress to none at most, and from none to full: with it the waist needs 0.7 of its stall torque."""

SHORTEST_RAMP = 0.03
"""s from full progress to none at least: three goals."""

STANDSTILL = 0.060
"""A gap after which joints have come to rest at their last goal, s (their lag is 45 ms): restart from rest."""

BLEND_TIME = 0.25
"""s over which a difference between the last goal and the trajectory's first is led to zero."""

_LATE_PERIODS = 2
_STANDS = 1e-9  # a rate below which only rounding is left of a ramp


class Pace(Enum):
    """What becomes of the progress."""

    GO = auto()  # at full rate, or up to it
    HOLD = auto()  # slow down gently and stand
    STOP = auto()  # stand as soon as the servos can


TORQUE_SHARE = {Pace.HOLD: 0.5, Pace.STOP: 0.9}
"""Of its stall torque, what slowing down may ask of a servo; a stop leaves the rest to what the model does not know."""


class Progress:
    """Where on a trajectory the goals are.

    A goal holds until the next, so it is chosen for the change of the rate that the coming period brings.

    Args:
        trajectory: What to stream.
        last_goals: ndarray of shape (J,), rad: what the servos were told last.
        stall: ndarray of shape (J,), rad: how far from its joint a goal has the servo push with its whole torque.

    Attributes:
        phase: s along the trajectory.
        rate: Progress per time, 0..1.
        slipped: s of real time the trajectory has lost to late cycles.
    """

    def __init__(self, trajectory: Trajectory, last_goals: Array, stall: Array) -> None:
        self.phase = 0.0
        self.rate = 1.0
        self.slipped = 0.0
        self._trajectory = trajectory
        self._stall = stall
        self._carry: Array = last_goals - trajectory.goals[0]
        self._blended = 0.0
        self._gain = 0.0

    @property
    def at_end(self) -> bool:
        """The last goal has been reached, nothing is left to blend."""
        return self.phase >= self._trajectory.duration and self._blended >= BLEND_TIME

    @property
    def standing(self) -> bool:
        """The goals do not move on, because of a stop."""
        return self.rate <= 0.0

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
        move = self._trajectory
        middle = self.rate + 0.5 * self._gain * move.period
        goals = self._sample(move.goals)
        resting = goals if move.resting is None else self._sample(move.resting)
        told = resting + middle * (goals - resting)
        if self._gain != 0.0 and move.braking is not None:
            told += self._gain * self._sample(move.braking)
        return np.asarray(told)

    def _shares(self) -> tuple[Array, Array, Array]:
        """What a goal consists of: to stand still here, to pass at full rate, and for each 1/s the rate changes by."""
        move = self._trajectory
        goals = self._sample(move.goals)
        resting = goals if move.resting is None else self._sample(move.resting)
        push = np.zeros_like(goals) if move.braking is None else self._sample(move.braking)
        return resting, goals - resting, push

    def rest(self) -> None:
        """Begin at standstill."""
        self.rate = self._gain = 0.0

    def advance(self, elapsed: float, pace: Pace) -> None:
        """Move on by at most two periods of the `elapsed` s, and choose how the rate changes until the next goal."""
        period = self._trajectory.period
        step = min(elapsed, _LATE_PERIODS * period)
        self.slipped += elapsed - step
        if elapsed > STANDSTILL:
            self.rest()
        before = self.rate
        self.rate = min(1.0, before + self._gain * step)
        if self.rate < _STANDS:
            self.rate = 0.0
        moved = step * 0.5 * (before + self.rate)
        done = self.phase >= self._trajectory.duration
        self.phase = min(self._trajectory.duration, self.phase + moved)
        self._blended += step if done else moved
        if pace is Pace.GO:
            self._gain = min(1.0 / LONGEST_RAMP, (1.0 - self.rate) / period)
        else:
            self._gain = -min(self._steepest(TORQUE_SHARE[pace] * self._stall), self.rate / period)

    def _steepest(self, reach: Array) -> float:
        """How fast the rate may fall with no goal farther than `reach` (rad) from its joint, 1/s."""
        resting, lead, push = self._shares()
        held = resting - self.positions + self.rate * lead
        room = (reach + np.sign(push) * held) / np.maximum(np.abs(push), 1e-9)
        return min(max(float(room.min()), 1.0 / LONGEST_RAMP), 1.0 / SHORTEST_RAMP)

    def rebase(self, goals: Array) -> None:
        """Go on from other goals (rad), at rest: what the servos were told last is no longer in force."""
        self._blended = 0.0
        self.rest()
        self._carry = goals - self._told()

    def _sample(self, values: Array) -> Array:
        place = self.phase / self._trajectory.period
        index = min(int(place), len(values) - 1)
        share = place - index
        if share <= 0.0 or index + 1 >= len(values):
            return np.asarray(values[index])
        return np.asarray(values[index] * (1.0 - share) + values[index + 1] * share)

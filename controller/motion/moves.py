"""Legs made into moves: rounded, timed, with the model's offset, and on ways that the gate lets pass."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from controller.domain import ArmDescription, Array, Point, Trajectory
from controller.errors import LimitViolation, PlanError
from controller.geometry import invert, transform
from controller.motion import ways
from controller.motion.gate import Gate
from controller.motion.kinematics import chain, points
from controller.motion.overhead import Overhead
from controller.motion.path import Leg, join
from controller.motion.trajectory import generate

CALM_SPEED = 1000.0  # mm/s of the tool in moves that carry nothing anywhere: ready, rest, by hand
_FREE_IT = "nothing has moved: free the arm with `controller jog`, or by hand with its supply off, then reset"
_START_CLIP = math.radians(3.0)  # a joint may rest this far outside its limits without being refused

_Choice = TypeVar("_Choice")
_Plan = TypeVar("_Plan")


@dataclass(frozen=True, slots=True, eq=False)
class Moves:
    """Makes the moves of one arm in one cell.

    Attributes:
        arm: The arm.
        gate: What it may not do.
        offsets: ndarray of shape (J,): calibrated joint offsets, rad.
        overhead: How high it passes.
        speed: Share of the arm's speed limits, in (0, 1].
    """

    arm: ArmDescription
    gate: Gate
    offsets: Array
    overhead: Overhead
    speed: float = 1.0

    def start(self, measured: Array) -> Array:
        """Measured joint angles (J,) without the calibrated offsets; a hair outside a limit counts as at it.

        Raises:
            LimitViolation: A joint stands outside its limits.
        """
        q = np.asarray(measured, np.float64) - self.offsets
        c = chain(self.arm)
        clipped = np.clip(q, c.low, c.high)
        for joint, value, inside in zip(self.arm.joints, q, clipped, strict=True):
            if not abs(value - inside) <= _START_CLIP:
                limit = math.degrees(inside)
                raise LimitViolation(
                    f"{joint.name} stands at {math.degrees(value):.1f} deg, limit {limit:.1f} deg",
                    "move it inside by hand with torque off",
                )
        return clipped

    def along(
        self,
        name: str,
        legs: Sequence[Leg],
        corners: Sequence[tuple[float, float]],
        payload: tuple[float, float] = (0.0, 0.0),
    ) -> Trajectory:
        """As fast as the joints allow along legs; arguments as of `path.join` and `trajectory.generate`."""
        path = join(self.arm, legs, corners)
        return generate(self.arm, path, name, speed=self.speed, joint_offsets=self.offsets, payload=payload)

    def calm(
        self, name: str, legs: Sequence[Leg], corners: Sequence[tuple[float, float]], limit: float
    ) -> Trajectory:
        """Slowed so far that the tool, swung out on a stretched arm, keeps a speed limit (mm/s)."""
        path = join(self.arm, legs, corners)
        speed = self.speed
        while True:
            trajectory = generate(self.arm, path, name, speed=speed, joint_offsets=self.offsets)
            way = points(self.arm, trajectory.positions)[:, 3]
            top = float(np.linalg.norm(np.diff(way, axis=0), axis=1).max(initial=0.0)) / trajectory.period
            if top <= limit:
                return trajectory
            # A little more than in proportion: smoothing takes less off the peak of a slower move.
            speed *= 0.98 * limit / top

    def between(self, name: str, q0: Array, goal: Array) -> Trajectory:
        """From a pose (J,) to another, rad, over a safe height where the direct way passes low; approved.

        Raises:
            LimitViolation: The gate refuses every way tried.
        """

        def made(way: ways.Way) -> Trajectory:
            trajectory = self.calm(name, *way, CALM_SPEED)
            self.gate.check(trajectory, q0)
            return trajectory

        clear = self.overhead.between(self.below(q0), self.below(goal))
        found = itertools.chain(ways.between(self.arm, clear, q0, goal), ways.raised(self.arm, clear, q0, goal))
        try:
            return first(found, made)
        except LimitViolation as error:
            raise LimitViolation(error.cause, _FREE_IT) from error

    def approach(self, q0: Array, down: Leg, rounded: float, opening: float, climb: float) -> Trajectory:
        """From a pose to the top of a stroke and down; approved.

        Args:
            q0: ndarray of shape (J,): where it begins, rad.
            down: The stroke, from a height that passes over everything on the way.
            rounded: mm of the stroke that the way there is rounded into.
            opening: Clear opening of the jaws, mm.
            climb: mm that the way begins straight up.

        Raises:
            LimitViolation: The gate refuses every way tried.
        """

        def made(way: ways.Way) -> Trajectory:
            legs, corners = way
            trajectory = self.along("approach", [*legs, down], [*corners, (ways.CORNER, rounded)])
            self.gate.check(trajectory, q0, opening=opening)
            return replace(trajectory, narrow=self._among_parts(trajectory, down, rounded))

        clear = float(points(self.arm, down.start)[3, 2])
        found = (
            ways.between(self.arm, clear, q0, down.start)
            if climb <= 0.0
            else ways.climbing(self.arm, clear, q0, down.start, climb)
        )
        return first(found, made)

    def below(self, q: Array) -> Point:
        """(x, y) in `table` of the grasp point in a pose (J,), mm."""
        x, y, _ = transform(invert(self.overhead.T_base_table), points(self.arm, q)[3]).tolist()
        return x, y

    def clear(self, first: Point, last: Point | None = None) -> float:
        """Height of the grasp point that passes over everything from one place of `table` to another, mm.

        Args:
            first: (x, y) of the one, mm.
            last: Of the other; below the ready pose when None.
        """
        ready = self.below(np.array(self.arm.ready))
        return self.overhead.between(first, ready if last is None else last)

    def _among_parts(self, approach: Trajectory, down: Leg, rounded: float) -> float:
        """When an approach has come `rounded` mm down from the top of its descent, s."""
        height = points(self.arm, approach.positions)[:, 3, 2]
        top = points(self.arm, down.start)[3, 2]
        over = np.flatnonzero(height > top - rounded - 1.0)
        return float(over[-1] if len(over) else 0) * approach.period


def first(choices: Iterable[_Choice], plan: Callable[[_Choice], _Plan]) -> _Plan:
    """The plan of the first of several choices that has one; there is one choice at least.

    Raises:
        PlanError: None has: why not the first.
    """
    failure: PlanError | None = None
    for choice in choices:
        try:
            return plan(choice)
        except PlanError as error:
            failure = failure or error
    assert failure is not None
    raise failure

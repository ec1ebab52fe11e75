"""Ways from pose to pose over everything that stands on the table; the gate decides which of them is taken."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, product

import numpy as np

from controller.domain import ArmDescription, Array
from controller.errors import Unreachable
from controller.motion.kinematics import chain, points
from controller.motion.path import Leg, line, speed_limits, stroke
from controller.motion.postures import LIFT

CORNER = 100.0  # mm of sideways travel that are rounded into a stroke
_ANGLES = 9  # of shoulder, elbow and wrist each, tried for a pose to leave a bad place by: about 25 deg apart
_INSIDE = 0.15  # rad that such a pose keeps from the limits: rounded corners bulge
_TRIES = 60  # of those poses at most, the nearest first: 5 ms each

Way = tuple[list[Leg], list[tuple[float, float]]]
"""Legs, and the corners between them (see `path.join`)."""


def between(arm: ArmDescription, clear: float, q0: Array, goal: Array) -> Iterator[Way]:
    """Ways between two poses, the fastest sensible one first.

    Args:
        arm: The arm.
        clear: Height of the grasp point (mm, `base`) that passes over everything.
        q0: ndarray of shape (J,): where it begins, rad.
        goal: ndarray of shape (J,): where it ends, rad.
    """
    here = points(arm, q0)[3]
    there = points(arm, goal)[3]
    if here[2] >= min(clear, there[2]) - 1.0 or float(np.abs(q0 - goal).max()) < 1e-6:
        yield [line(arm, q0, goal)], []
    rise = clear - here[2]
    if rise > 1.0:
        try:
            up = stroke(arm, q0, rise)
        except Unreachable:
            pass
        else:
            yield [up, line(arm, up.end, goal)], [(max(rise - LIFT / 2.0, 0.0), CORNER)]
    for first, second in _tucked(arm, q0[0], goal[0]):
        yield (
            [line(arm, q0, first), line(arm, first, second), line(arm, second, goal)],
            [(5.0, CORNER / 2.0), (CORNER / 2.0, 5.0)],
        )
    yield [line(arm, q0, goal)], []


def raised(arm: ArmDescription, clear: float, q0: Array, goal: Array) -> Iterator[Way]:
    """Ways for an arm that has sunk, limp, to where neither straight up nor straight to the goal is free.

    Arguments as for `between`.
    """
    for out in islice(_raised(arm, clear, q0), _TRIES):
        first, second = next(_tucked(arm, q0[0], goal[0]))
        yield (
            [line(arm, q0, out), line(arm, out, first), line(arm, first, second), line(arm, second, goal)],
            [(5.0, 5.0), (5.0, CORNER / 2.0), (CORNER / 2.0, 5.0)],
        )


def climbing(arm: ArmDescription, clear: float, q0: Array, goal: Array, climb: float) -> Iterator[Way]:
    """The way out of a bin: straight up by `climb` mm and over the walls before it turns.

    Raises:
        Unreachable: The arm cannot go straight up from there.
    """
    rise = max(clear - points(arm, q0)[3, 2], climb + LIFT / 2.0)
    up = stroke(arm, q0, rise)
    yield [up, line(arm, up.end, goal)], [(max(rise - LIFT / 2.0, climb), CORNER)]


def _tucked(arm: ArmDescription, waist: float, goal: float) -> Iterator[tuple[Array, Array]]:
    """Folded poses at two waist angles to pass through when the tool cannot go straight up."""
    for pose in (arm.ready, arm.rest):
        first, second = np.array(pose), np.array(pose)
        first[0], second[0] = waist, goal
        yield first, second


def _raised(arm: ArmDescription, clear: float, q0: Array) -> Iterator[Array]:
    """Poses (J,) over everything at a pose's own waist angle and roll, the soonest reached first."""
    c = chain(arm)
    steps = [np.linspace(c.low[joint] + _INSIDE, c.high[joint] - _INSIDE, _ANGLES) for joint in (1, 2, 3)]
    poses = np.tile(q0, (_ANGLES**3, 1))
    poses[:, 1:4] = list(product(*steps))
    poses = poses[points(arm, poses)[:, 1:, 2].min(axis=1) >= clear]
    yield from poses[np.argsort(np.abs((poses - q0) / speed_limits(arm)).max(axis=1), kind="stable")]

"""Where the arm stands over a place of the table or a bin: low, and straight above it.

Pure reach: nothing here knows paths, time or the parts around.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.domain import ArmDescription, Array, Bin, ErrorMap, Grasp, LocatedObject, Point
from controller.errors import PlanError, Unreachable
from controller.geometry import transform
from controller.motion.gate import WALL_MARGIN, Gate
from controller.motion.kinematics import (
    FACING_UP,
    TOP_DOWN,
    chain,
    closing_direction,
    inverse,
    roll_for,
    rotation,
    solutions,
)
from controller.motion.overhead import PART_BELOW_TIPS, Overhead
from controller.motion.path import speed_limits

# Beyond the top-down reach the tool may lean outwards, steepest first; flatter than 65 deg the fingers' backs
# come near the table.
PITCHES = tuple(math.radians(deg) for deg in (90.0, 85.0, 80.0, 75.0, 70.0, 65.0))
# The vertical stroke at part and bin. Lifts of 30 to 80 mm cost the same to 3 %; 60 clears every wall used.
LIFT = 60.0
SETTLING = 3.0  # mm between the lowest corner of the jaws and what the gate asks over a wall
FALL = 8.0  # mm that a part may fall onto what lies in the bin
MIN_BEND = math.radians(8.0)


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """A low pose, the pose straight above it, and the stroke's height (mm)."""

    low: Array
    high: Array
    rise: float


class Postures:
    """Finds stops for one arm in one cell.

    Args:
        arm: The arm.
        gate: Knows where the table lies and what the jaws fit into.
        error_map: What the tool comes down beside its aim, where that is known.
        jaws: (y, z) of the middle of the jaws beside its place in the drawing, in `tool`, mm.
    """

    def __init__(
        self, arm: ArmDescription, gate: Gate, error_map: ErrorMap | None = None, jaws: Point = (0.0, 0.0)
    ) -> None:
        self._arm = arm
        self._gate = gate
        self._error_map = error_map
        self._jaws = np.array([0.0, *jaws])
        self._T = gate.T_base_table
        self._yaw = math.atan2(self._T[1, 0], self._T[0, 0])
        self._walls = Overhead(arm, self._T, gate.bins).walls

    def azimuth(self, point: Point) -> float:
        """Direction of the arm's plane when the tool is at a point of `table` (mm), rad about z of `base`."""
        x, y, _ = transform(self._T, [*point, 0.0])
        return math.atan2(y, x - chain(self._arm).axis[0])

    def tangent(self, point: Point) -> float:
        """Closing direction of an arm without wrist roll at a point of `table` (mm), rad about z of `table`."""
        return self.azimuth(point) + math.pi / 2 - self._yaw

    def over(
        self,
        point: Point,
        height: float,
        rolls: Sequence[float] | None,
        direction: float = 0.0,
        clear: float | None = None,
    ) -> Stop:
        """The pose at a place of `table` from above and the one `LIFT` over it or higher.

        Args:
            point: (x, y) in `table`, mm.
            height: z of the grasp point, the middle of the jaws, in `table`, mm.
            rolls: Rolls to choose from; None: those that close along `direction` (rad, `table`).
            direction: See `rolls`.
            clear: Height of the upper pose at least (see `Overhead`), mm; over walls and parts when None.

        Raises:
            Unreachable: The message says why.
        """
        arm = self._arm
        aim = point if self._error_map is None else self._error_map.aim(point)
        middle = transform(self._T, [*aim, height])
        rise = max(LIFT, (self._walls if clear is None else clear) - height)
        if rolls is None:
            rolls = roll_for(arm, self.azimuth(point), direction + self._yaw) or (0.0,)
        roll = min(rolls, key=abs)
        for pitch in PITCHES:
            position = middle - rotation([self.azimuth(aim), pitch, 0.0, 0.0, roll]) @ self._jaws
            ends = [
                next((q for k, q in solutions(arm, place, pitch, roll, within=True) if k == FACING_UP), None)
                for place in (position, position + np.array([0.0, 0.0, rise]))
            ]
            # A stretched arm would have to move infinitely fast along the stroke.
            if ends[0] and ends[1] and min(self._bend(ends[0]), self._bend(ends[1])) > MIN_BEND:
                return Stop(np.array(ends[0]), np.array(ends[1]), rise)
        for over in (0.0, rise):
            inverse(arm, middle + np.array([0.0, 0.0, over]), TOP_DOWN, roll)
        raise Unreachable(
            f"({middle[0]:.0f}, {middle[1]:.0f}) mm can only be reached with the arm stretched out or folded back",
            "move it nearer, or in front of the arm",
        )

    def drop(
        self,
        bin: Bin,
        drop: Point,
        taken: tuple[LocatedObject, Grasp] | None,
        held: Array,
        pile: float | None,
        clear: float | None = None,
    ) -> Stop:
        """The pose that lets the part go over `drop`, its centre there, or as near as it fits between the walls.

        Args:
            bin: The bin.
            drop: (x, y) in `table`, mm.
            taken: The part as it lay, and how it is held; None: nothing is.
            held: ndarray of shape (J,): the posture it was gripped in, rad.
            pile: Height of what lies in the bin, or None: unknown, up to the brim.
            clear: See `over`.

        Raises:
            Unreachable: The message says why.
        """
        gripper = self._arm.gripper
        half = np.array(bin.size) / 2.0
        if (np.abs(np.array(drop) - bin.center) > half).any():
            raise Unreachable(f"drop ({drop[0]:.0f}, {drop[1]:.0f}) mm lies outside bin {bin.name}", "mend the drop")
        # As wide as the gate judges the way: so far the jaws open when they keep the part at the first try.
        opening = gripper.opening[1] if taken is None else taken[1].opening
        brim = bin.height + WALL_MARGIN + SETTLING
        over = gripper.jaw_depth + max(brim, (pile if pile is not None else bin.height) + PART_BELOW_TIPS + 1.0)
        deep = gripper.jaw_depth + PART_BELOW_TIPS + FALL + (pile if pile is not None else bin.height)
        best: tuple[float, Stop] | None = None
        failure: Unreachable | None = None
        held_yaw = closing_direction(held)
        for roll in self._drop_rolls(drop):
            try:
                place = drop
                for _ in range(2):
                    # The part hangs beside the grasp point and turns with the tool, which turns with the waist.
                    stop = self.over(place, over, (roll,), clear=clear)
                    if taken is not None:
                        place = _let_go_at(bin, drop, *taken, closing_direction(stop.low) - held_yaw)
                if deep < over:
                    stop = self.over(place, deep, (roll,), clear=clear)
                fits = deep < over and self._gate.jaws_inside(bin, stop.low, opening)
                if not fits:
                    stop = self.over(place, over, (roll,), clear=clear)
                    # A tool that leans out has one jaw lower than the other.
                    if (short := brim - self._gate.lowest(stop.low, opening)) > 0.0:
                        stop = self.over(place, over + short, (roll,), clear=clear)
            except Unreachable as error:
                failure = failure or error
                continue
            # Deeper is better than sooner: 1 mm of fall is worth 10 ms.
            cost = float((np.abs(stop.high - held) / speed_limits(self._arm)).max())
            cost += 0.0 if fits else 0.01 * max(over - deep, 0.0)
            if best is None or cost < best[0]:
                best = cost, stop
        if best is None:
            assert failure is not None
            raise failure
        return best[1]

    def bin_error(self, bin: Bin, drop: Point | None = None, pile: float | None = None) -> str | None:
        """Why no part can be let go in a bin, or None when it can.

        Args:
            bin: The bin.
            drop: (x, y) in `table`, mm; its middle when None.
            pile: Height of what lies in it, mm, or None: unknown, up to the brim.
        """
        try:
            self.drop(bin, bin.center if drop is None else drop, None, np.array(self._arm.ready), pile)
        except PlanError as error:
            return error.cause
        return None

    def _bend(self, q: Sequence[float]) -> float:
        """Angle by which the elbow is bent away from straight, rad."""
        c = chain(self._arm)
        return abs(q[2] - (c.fore[1] - c.upper[1]))

    def _drop_rolls(self, drop: Point) -> tuple[float, ...]:
        """Rolls that set the jaws along the sides of the bin, or the only one there is."""
        azimuth = self.azimuth(drop)
        rolls = [r for k in range(2) for r in roll_for(self._arm, azimuth, self._yaw + k * math.pi / 2)]
        return tuple(rolls) or (0.0,)


def between_walls(bin: Bin, drop: Point, outline: Array) -> Point:
    """The place nearest to `drop` where a part falls on no wall; in the middle of two that it does not fit between.

    A part that comes down on a wall comes to lie over it, where the jaws go for the bin beside.

    Args:
        bin: The bin, its sides along `table`'s.
        drop: (x, y) in `table` where the part's centre is wanted, mm.
        outline: ndarray of shape (N, 2): the part's outline about its centre as it hangs, `table`, mm.
    """
    room = np.array(bin.size) / 2.0 - WALL_MARGIN
    low, high = bin.center - room - outline.min(axis=0), bin.center + room - outline.max(axis=0)
    middle = (low + high) / 2.0
    x, y = np.clip(drop, np.minimum(low, middle), np.maximum(high, middle))
    return float(x), float(y)


def _let_go_at(bin: Bin, drop: Point, part: LocatedObject, grasp: Grasp, turn: float) -> Point:
    """Where in `table` the grasp point lets go of a part that has turned with the tool by `turn`, rad."""
    c, s = math.cos(turn), math.sin(turn)
    turned = np.array([[c, s], [-s, c]])
    x, y = between_walls(bin, drop, (part.footprint - part.center) @ turned)
    beside = (np.array(part.center) - grasp.center) @ turned
    return x - float(beside[0]), y - float(beside[1])

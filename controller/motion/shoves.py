"""Moves of the closed jaws that shove a part: down beside it, straight along, and away."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.domain import Array, LocatedObject, NudgePlan, Point, Trajectory
from controller.motion import grasps, ways
from controller.motion.ground import Push
from controller.motion.moves import Moves
from controller.motion.overhead import PART_BELOW_TIPS
from controller.motion.path import line, straight, stroke
from controller.motion.postures import Postures

PUSH_SPEED = 100.0  # mm/s: a part let go at this speed slides on by 2 mm at friction 0.3
TOUCH_SPEED = 25.0  # mm/s: it slides on by 0.1 mm
_LET_GO = 5.0  # mm back from a part that was touched before the jaws rise beside it


@dataclass(frozen=True, slots=True, eq=False)
class Shoves:
    """Makes the moves of one arm that shove a part; each approved as a whole.

    Attributes:
        moves: Of the arm in its cell.
        postures: How it stands over a place.
    """

    moves: Moves
    postures: Postures

    def nudge(
        self, target: LocatedObject, push: Push, others: Sequence[LocatedObject], q0: Array, climb: float
    ) -> NudgePlan:
        """A push that should free a part; arguments as of `Planner.plan_nudge`, `q0` (J,) where it begins, rad.

        Raises:
            Unreachable: The push lies outside the reach.
            LimitViolation: The gate refuses it.
        """
        moves, arm = self.moves, self.moves.arm
        opening = arm.gripper.opening[0]
        height = grasps.grasp_height(push.moved, arm.gripper)
        clear = moves.clear(moves.below(q0), push.start)
        stop = self.postures.over(push.start, height, None, push.direction, clear)
        tall = max([target.height, *(other.height for other in others)])
        rounded = stop.rise - min(tall + PART_BELOW_TIPS + arm.gripper.jaw_depth - height + 2.0, stop.rise)
        approach = moves.approach(q0, stroke(arm, stop.low, stop.rise).reversed(), rounded, opening, climb)
        along = straight(arm, stop.low, self._in_base(push.way * np.array(push.ahead)))
        shove = moves.calm("push", [along], [], PUSH_SPEED)
        up = stroke(arm, along.end, stop.rise)
        home = line(arm, up.end, np.array(arm.ready))
        retreat = moves.along("retreat", [up, home], [(rounded, ways.CORNER)])
        moves.gate.check_moves((shove, retreat), approach.positions[-1], opening)
        gone = push.travel * push.ahead[0], push.travel * push.ahead[1]
        return NudgePlan(target, push.moved, gone, push.ends, opening, approach, shove, retreat)

    def touch(
        self, part: LocatedObject, beside: Point, by: Array, roll: float, q0: Array
    ) -> tuple[Trajectory, Trajectory, Trajectory]:
        """A slow push of a part that lies alone; see `Planner.plan_touch`, `q0` (J,) where it begins, rad.

        Raises:
            Unreachable: A place lies outside the reach.
            LimitViolation: The gate refuses a move.
        """
        moves, arm = self.moves, self.moves.arm
        opening = arm.gripper.opening[0]
        stop = self.postures.over(beside, grasps.grasp_height(part, arm.gripper), (roll,))
        approach = moves.approach(q0, stroke(arm, stop.low, stop.rise).reversed(), 0.0, opening, 0.0)
        along = straight(arm, stop.low, self._in_base(by))
        push = moves.calm("touch", [along], [], TOUCH_SPEED)
        back = straight(arm, along.end, self._in_base(by * (-_LET_GO / math.hypot(*by))))
        up = stroke(arm, back.end, stop.rise)
        home = line(arm, up.end, np.array(arm.ready))
        retreat = moves.along("retreat", [back, up, home], [(0.0, 0.0), (0.0, ways.CORNER)])
        moves.gate.check_moves((push, retreat), approach.positions[-1], opening)
        return approach, push, retreat

    def _in_base(self, way: Array) -> Array:
        """A way (2,) along the table, given in `table`, in `base`: ndarray of shape (3,), mm."""
        return np.asarray(self.moves.overhead.T_base_table[:3, :3] @ np.array([*way, 0.0]))

"""Moves under a person's eye: bounded steps and slow ways home, the tool never faster than 250 mm/s.

Source: ISO 10218-1, 5.7.3: manual mode at reduced speed, at most 250 mm/s at the tool centre point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from controller.domain import ArmDescription, Array, Bin, CellCalibration, Trajectory
from controller.errors import LimitViolation
from controller.geometry import invert, transform
from controller.motion import dynamics
from controller.motion.kinematics import chain, forward, points
from controller.motion.path import Leg, join, line, straight
from controller.motion.planner import Planner
from controller.motion.trajectory import generate

REDUCED_SPEED = 250.0  # mm/s of the grasp point
_JOINT_SHARE = 0.25  # of the joints' speed limits, where the tool hardly moves (a wrist roll)
_TRIES = 4
_LARGEST_TURN = 0.6  # rad a joint may turn in one straight step: more means the arm is about to fold over


class ManualPlanner:
    """Plans moves at reduced speed, each approved by the safety gate. Pure, like `Planner`.

    Args:
        arm: The arm.
        calibration: Where `table` lies in `base`, and the joint offsets.
        bins: Whose walls the jaws keep clear of.
    """

    def __init__(self, arm: ArmDescription, calibration: CellCalibration, bins: Sequence[Bin]) -> None:
        self.arm = arm
        self.calibration = calibration
        self._bins = tuple(bins)
        self._offsets = dynamics.joint_offsets(arm, calibration.joint_offsets)
        self._T_table_base = invert(np.asarray(calibration.T_base_table, np.float64))
        self._gate = Planner(arm, calibration, self._bins).gate

    def posture(self, measured: Array) -> Array:
        """Joint angles (J,) as the model has them, rad: the measured ones without the calibrated offsets."""
        c = chain(self.arm)
        return np.clip(np.asarray(measured, np.float64) - self._offsets, c.low, c.high)

    def tool(self, posture: Array) -> Array:
        """The grasp point, the middle of the jaws, in `table`: ndarray of shape (3,), mm."""
        return transform(self._T_table_base @ forward(self.arm, posture), [0.0, *self.calibration.jaws])

    def home(self, measured: Array) -> Trajectory:
        """To the ready pose. Raises LimitViolation."""
        return self._slowed(lambda share: self._planner(share).home(measured))

    def park(self, measured: Array) -> Trajectory:
        """To the rest pose, where torque may go off. Raises LimitViolation."""
        return self._slowed(lambda share: self._planner(share).park(measured))

    def turned(self, posture: Array, joint: int, angle: float, opening: float) -> Trajectory:
        """One joint turned.

        Args:
            posture: ndarray of shape (J,): where the arm is, as `posture` has it, rad.
            joint: Index from base to tool.
            angle: rad.
            opening: Clear opening of the jaws, mm.

        Raises:
            LimitViolation: The gate refuses it; nothing moves.
        """
        goal = posture.copy()
        goal[joint] += angle
        return self._step(posture, line(self.arm, posture, goal), opening)

    def shifted(self, posture: Array, by: Array, opening: float) -> Trajectory:
        """The tool moved along a straight line, its pitch and its roll joint kept.

        Args:
            posture: ndarray of shape (J,): where the arm is, rad.
            by: ndarray of shape (3,): how far, along the axes of `table`, mm.
            opening: Clear opening of the jaws, mm.

        Raises:
            Unreachable: A point of the line is out of reach.
            LimitViolation: The gate refuses it; nothing moves.
        """
        T_base_table = np.asarray(self.calibration.T_base_table, np.float64)
        leg = straight(self.arm, posture, T_base_table[:3, :3] @ by)
        if np.abs(leg.end - posture).max() > _LARGEST_TURN:
            raise LimitViolation("the arm is nearly folded or stretched here", "turn single joints instead")
        return self._step(posture, leg, opening)

    def _step(self, posture: Array, leg: Leg, opening: float) -> Trajectory:
        path = join(self.arm, [leg], [])
        move = self._slowed(lambda share: generate(self.arm, path, "jog", speed=share, joint_offsets=self._offsets))
        self._gate.check(move, posture, opening=opening)
        return move

    def _slowed(self, plan: Callable[[float], Trajectory]) -> Trajectory:
        share = _JOINT_SHARE
        for _ in range(_TRIES):
            move = plan(share)
            top = self._tool_speed(move)
            if top <= REDUCED_SPEED:
                return move
            share *= 0.98 * REDUCED_SPEED / top
        raise LimitViolation(f"{move.name}: tool speed {top:.0f} mm/s, limit {REDUCED_SPEED:.0f}", "nothing has moved")

    def _tool_speed(self, move: Trajectory) -> float:
        way = points(self.arm, move.positions)[:, 3]
        return float(np.linalg.norm(np.diff(way, axis=0), axis=1).max(initial=0.0)) / move.period

    def _planner(self, share: float) -> Planner:
        return Planner(self.arm, self.calibration, self._bins, speed=share)

"""The arm at work for a calibration: moved by plans that the gate has approved, parked and let go in the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from controller.calibration.identified import load_identified
from controller.config.cell import CellConfig
from controller.domain import Array, CellCalibration, Trajectory
from controller.errors import ArmError, SafetyStop
from controller.motion import dynamics
from controller.motion.planner import Planner
from controller.ports import Arm

_CORRECTIONS = 3
_CLOSE = 0.0008  # rad: half an encoder tick of 0.088 degrees
_LARGEST_CORRECTION = 0.02  # rad: a joint further off is hindered, and pushing harder would not help


class Mover:
    """Moves one arm by a plan, and corrects where a move ends."""

    def __init__(self, arm: Arm, planner: Planner) -> None:
        self.arm = arm
        self.planner = planner
        self._last: Trajectory | None = None

    def to(self, pose: Array) -> None:
        """Bring the joints to angles (J,) of the model, about along the straight joint line. Moves metal."""
        move = self.planner.plan_move("calibrate", self.arm.state().positions, pose)
        self._follow(move)
        self._last = move

    def settle(self) -> None:
        """Shift the goals by what the encoders still miss of the last move's end. Moves metal by less than a degree.

        A servo holds a load by standing off its goal; the model foresees most of that, friction and the true
        weights of the links leave 0.2 degrees.
        """
        assert self._last is not None
        offsets = dynamics.joint_offsets(self.arm.description, self.planner.calibration.joint_offsets)
        pose = self._last.positions[-1]
        told = np.array(self._last.goals[-1])
        goals = told.copy()
        for _ in range(_CORRECTIONS):
            off = pose + offsets - self.arm.state().positions
            if np.abs(off).max() < _CLOSE:
                return
            goals = np.clip(goals + off, told - _LARGEST_CORRECTION, told + _LARGEST_CORRECTION)
            self._follow(Trajectory("settle", self._last.period, np.array([pose, pose]), np.array([goals, goals])))

    def _follow(self, move: Trajectory) -> None:
        if not self.arm.follow(move).finished:
            raise SafetyStop("stopped on request", "start again")


@contextmanager
def at_work(
    arm: Arm, config: CellConfig, calibration: CellCalibration, folder: Path | None = None
) -> Iterator[Mover]:
    """Energise the arm, and in the end park it and let go; after a failure of the arm it holds still.

    Moves as the arm was identified, where the calibration's folder says how.
    """
    planner = planner_in(arm, config, calibration, folder)
    arm.energise()
    mover = Mover(arm, planner)
    try:
        yield mover
    except ArmError:
        raise
    except BaseException:
        arm.clear_stop()
        _park(mover)
        raise
    _park(mover)


def _park(mover: Mover) -> None:
    if mover.arm.follow(mover.planner.park(mover.arm.state().positions)).finished:
        mover.arm.relax()


def planner_in(arm: Arm, config: CellConfig, calibration: CellCalibration, folder: Path | None) -> Planner:
    """A planner for the arm as a calibration's folder has it identified."""
    description = arm.description if folder is None else load_identified(folder, arm.description)
    return Planner(description, calibration, config.bin_values(), speed=config.arm.speed_percent / 100.0)

"""Moving an arm for its calibration: corrected at the end, parked whatever happens, still after its own failure."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from controller.backends import nominal_camera
from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.domain import ArmState, Array, CellCalibration, MoveReport, Trajectory
from controller.errors import ArmError, SafetyStop
from controller.motion import kinematics
from controller.service.at_work import at_work

CONFIG = load_cell(shipped("sim.toml"))
ARM = load_arm("reactorx_150")
OFFSETS = {"shoulder": math.radians(1.0), "elbow": math.radians(-0.7)}
LENS, ABOVE = nominal_camera(CONFIG)
CALIBRATION = CellCalibration("x", LENS, ABOVE, CONFIG.table.T_base_table(), OFFSETS)
ADDED = np.array([OFFSETS.get(name, 0.0) for name in ARM.joint_names])
POSE = kinematics.inverse(ARM, (220.0, 40.0, 60.0))[0]


class Drooping:
    """An arm whose joints stand off what they are told, by more than the model foresees."""

    description = ARM

    def __init__(self, droop: float) -> None:
        self.q = np.array(ARM.ready) + ADDED
        self.droop = droop * np.array([0.2, 1.0, 0.6, -0.4, 0.1])
        self.ended: Array = self.q
        self.corrected: Array = self.q
        self.carried: Array = np.zeros(5)
        self.told: Array = self.q
        self.log: list[str] = []
        self.stopped = False
        self.failing = False

    def state(self) -> ArmState:
        return ArmState(0.0, self.q, np.zeros(5), 40.0, 0.0)

    def energise(self) -> ArmState:
        self.log.append("energise")
        return self.state()

    def relax(self) -> None:
        self.log.append("relax")

    def clear_stop(self) -> None:
        self.stopped = False

    def follow(self, trajectory: Trajectory, *_: object, **__: object) -> MoveReport:
        if self.failing:
            raise ArmError("arm", trajectory.name, "a joint is blocked")
        self.log.append(trajectory.name)
        if self.stopped:
            return MoveReport(False, self.state())
        # What the model adds to the goals carries the weight it knows of.
        if trajectory.name != "settle":
            self.carried = trajectory.goals[-1] - trajectory.positions[-1] - ADDED
        self.told = trajectory.goals[-1]
        self.q = self.told - self.carried - self.droop
        return MoveReport(True, self.state())


def work(arm: Any, *, stopped: bool = False, failing: bool = False, settle: bool = False) -> Array:
    """Move to the pose and correct it; the goals of the move. Only the methods the mover calls are there."""
    with at_work(arm, CONFIG, CALIBRATION) as mover:
        arm.stopped, arm.failing = stopped, failing
        mover.to(POSE)
        told = np.array(arm.told)
        if settle:
            mover.settle()
        arm.ended = arm.q - ADDED
        arm.corrected = arm.told - told
    return told


def test_a_droop_is_corrected_by_the_encoders() -> None:
    arm = Drooping(math.radians(0.4))
    work(arm)
    assert np.abs(arm.ended - POSE).max() > math.radians(0.35)
    arm = Drooping(math.radians(0.4))
    work(arm, settle=True)
    assert np.abs(arm.ended - POSE).max() < math.radians(0.05)
    assert arm.log.count("settle") == 1  # it was there at once, and was left alone
    assert arm.log[-2:] == ["park", "relax"]


@pytest.mark.safety("SR-15")
def test_a_hindered_joint_is_not_pushed_ever_harder() -> None:
    arm = Drooping(math.radians(5.0))
    work(arm, settle=True)
    assert 0.0 < np.abs(arm.corrected).max() <= 0.02 + 1e-12


@pytest.mark.safety("SR-20")
def test_a_stop_ends_the_work_and_parks_the_arm() -> None:
    arm = Drooping(0.0)
    with pytest.raises(SafetyStop):
        work(arm, stopped=True)
    assert arm.log[-2:] == ["park", "relax"]


@pytest.mark.safety("SR-23")
def test_after_a_failure_of_the_arm_nothing_moves() -> None:
    arm = Drooping(0.0)
    with pytest.raises(ArmError):
        work(arm, failing=True)
    assert arm.log == ["energise"]

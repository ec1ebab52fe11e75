"""Rehearsals keep what they promise: an air run stays above the parts, is slow, and never grips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.backends import BackendOptions, Devices, rehearsed
from controller.config.arm import load_arm
from controller.cycle.rehearsal import (
    AIR_CLEARANCE,
    AIR_SPEED,
    AirPlanner,
    EmptyHanded,
    ImaginedPart,
    OneLook,
    Rehearsal,
)
from controller.domain import Frame
from controller.errors import CameraEnded, LimitViolation, NoClearGrasp
from controller.geometry import invert, transform
from controller.motion import kinematics
from controller.motion.overhead import TALLEST_PART
from controller.motion.planner import Planner
from sim_backends.recording_arm import RecordingArm
from sim_backends.replay_camera import ReplayCamera
from sim_backends.virtual_clock import VirtualClock
from tests.unit.motion.scene import RX150, bins, calibration, scatter

BINS = bins()
REAL = Planner(RX150, calibration(), BINS)
AIR = AirPlanner(RX150, calibration(), BINS, speed=AIR_SPEED)
T_TABLE_BASE = invert(calibration().T_base_table)


@pytest.mark.safety("SR-18")
@given(seed=st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_an_air_run_passes_over_the_tallest_part_and_is_slow(seed: int) -> None:
    things = scatter(np.random.default_rng(seed), 3)
    try:
        plan = AIR.plan_pick(things[0], things[1:], BINS[0], BINS[0].center, np.array(RX150.ready))
    except NoClearGrasp:
        return
    except LimitViolation:
        # At the wall of a bin; then the real pick is refused too.
        with pytest.raises(LimitViolation):
            REAL.plan_pick(things[0], things[1:], BINS[0], BINS[0].center, np.array(RX150.ready))
        return
    limits = np.array([joint.speed_limit for joint in RX150.joints])
    for move in plan.trajectories:
        grasp_point = transform(T_TABLE_BASE, kinematics.points(RX150, move.positions)[:, 3])
        tips = grasp_point[:, 2] - RX150.gripper.jaw_depth
        # It carries nothing: the jaws' tips are what comes lowest.
        assert tips.min() > TALLEST_PART + AIR_CLEARANCE
        speed = np.abs(np.diff(move.positions, axis=0)).max(axis=0) / move.period
        # The gate allows sampling two percent over the planned limit.
        assert (speed <= 1.02 * AIR_SPEED * limits).all()


@pytest.mark.safety("SR-18")
def test_empty_hands_never_move_their_jaws() -> None:
    commands: list[dict[str, object]] = []
    clock = VirtualClock()
    inner = RecordingArm(load_arm("reactorx_150"), clock, on_command=commands.append)
    arm = EmptyHanded(inner, ImaginedPart())
    arm.open()
    arm.energise()
    assert arm.grip(20.0).opening == 20.0
    assert arm.state().opening == 20.0
    assert "grip" not in {command["command"] for command in commands}


@pytest.mark.safety("SR-18")
def test_a_dry_run_tells_the_arm_nothing(tmp_path: Path) -> None:
    clock = VirtualClock()
    asked: list[str] = []

    class Silent(RecordingArm):
        def __getattribute__(self, name: str) -> object:
            if not name.startswith("_"):
                asked.append(name)
            return super().__getattribute__(name)

    devices = Devices(OneLook(ReplayCamera(tmp_path, clock)), Silent(RX150, clock), clock)
    asked.clear()
    dry = rehearsed(devices, RX150, BackendOptions(tmp_path), Rehearsal.DRY)
    dry.arm.open()
    dry.arm.energise()
    assert dry.arm.follow(REAL.home(np.array(RX150.rest))).finished
    dry.arm.grip(20.0)
    dry.arm.relax()
    dry.close()
    assert not set(asked) & {"open", "energise", "follow", "grip", "relax"}
    assert (tmp_path / "moves.jsonl").read_text(encoding="utf-8").count("\n") == 4


def test_a_rehearsal_looks_once() -> None:
    frame = Frame(1, 0.0, np.zeros((2, 2, 3), np.uint8))

    class Camera:
        def open(self) -> None: ...
        def close(self) -> None: ...
        def capture(self, after: float, timeout: float = 2.0) -> Frame:
            return frame

    camera = OneLook(Camera())
    assert camera.capture(0.0) is frame
    with pytest.raises(CameraEnded):
        camera.capture(0.0)

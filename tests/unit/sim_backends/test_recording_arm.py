from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from controller.domain import ArmDescription, Gripper, Joint, Trajectory
from controller.errors import ArmError, BusError, InputError, LimitViolation, MotionTimeout
from controller.ports import Arm
from sim_backends.recording_arm import Command, CommandFile, RecordingArm
from sim_backends.virtual_clock import VirtualClock

REST = (0.0, -0.5)
ARM = ArmDescription(
    name="two",
    title="Two joints",
    baud=1_000_000,
    joints=tuple(
        Joint(name, number, "XM430-W350", axis, (0.0, 0.0, 100.0), (-3.0, 3.0), False, 2.0, 8.0)
        for number, (name, axis) in enumerate((("waist", "z"), ("shoulder", "y")), 1)
    ),
    links=(),
    tool=(0.0, 0.0, 100.0),
    gripper=Gripper(9, "XL430-W250", "rack", (30.0, 52.0), (30.0, 74.0), False, (8.0, 18.0), 15.0),
    rest=REST,
    ready=(0.5, 0.0),
    payload=0.05,
)


def move(end: tuple[float, float], start: tuple[float, float] = REST, name: str = "approach") -> Trajectory:
    positions = np.linspace(start, end, 11)
    return Trajectory(name, 0.01, positions, positions + 0.02)


@pytest.fixture
def arm() -> RecordingArm:
    arm = RecordingArm(ARM, VirtualClock(5.0))
    arm.open()
    arm.energise()
    arm.commands.clear()
    return arm


def test_it_is_the_port(arm: RecordingArm) -> None:
    assert isinstance(arm, Arm)


def test_commands_are_recorded_exactly_in_order(arm: RecordingArm) -> None:
    arm.grip(60.0)
    arm.follow(move((math.radians(30.0), -0.5)))
    arm.grip(100.0, effort=0.5)
    arm.relax()
    arm.assert_commands(
        [
            {"at_s": 5.0, "command": "grip", "opening_mm": 60.0, "effort": 1.0},
            {
                "at_s": 5.3,
                "command": "follow",
                "name": "approach",
                "duration_s": 0.1,
                "from_deg": {"waist": 0.0, "shoulder": -28.6479},
                "to_deg": {"waist": 30.0, "shoulder": -28.6479},
            },
            {"at_s": 5.4, "command": "grip", "opening_mm": 74.0, "effort": 0.5},
            {"at_s": 5.54, "command": "relax"},
        ]
    )


def test_a_difference_is_shown_line_by_line(arm: RecordingArm) -> None:
    arm.grip(60.0)
    arm.grip(40.0)
    fields = ("command", "opening_mm")
    arm.assert_commands([{"command": "grip", "opening_mm": o} for o in (60.0, 40.0)], fields)
    with pytest.raises(AssertionError, match=r'-\{"command": "grip", "opening_mm": 41.0\}\n\+\{.*40.0\}'):
        arm.assert_commands([{"command": "grip", "opening_mm": o} for o in (60.0, 41.0)], fields)
    with pytest.raises(AssertionError, match="commands differ"):
        arm.assert_commands([{"command": "grip", "opening_mm": 60.0}], fields)


def test_the_state_follows_the_commands_and_the_clock_their_duration() -> None:
    clock = VirtualClock()
    arm = RecordingArm(ARM, clock)
    arm.open()
    assert arm.state().positions.tolist() == list(REST)
    arm.energise()
    report = arm.follow(move((0.4, 0.1)))
    assert report.finished
    assert clock.now() == pytest.approx(0.1, abs=1e-9)  # ten float additions of 0.01 s
    assert report.state.positions.tolist() == [0.4, 0.1]
    assert report.state.velocities.tolist() == [0.0, 0.0]
    assert arm.grip(50.0).opening == arm.state().opening == 50.0


def test_a_trajectory_from_elsewhere_is_refused_unrecorded(arm: RecordingArm) -> None:
    with pytest.raises(LimitViolation, match=r"starts 5.7 deg from where shoulder stands"):
        arm.follow(move((0.5, 0.0), start=(0.0, -0.4)))
    with pytest.raises(LimitViolation, match="do not fit 2 joints"):
        arm.follow(Trajectory("odd", 0.01, np.zeros((3, 4)), np.zeros((3, 4))))
    with pytest.raises(LimitViolation):
        arm.follow(Trajectory("nan", 0.01, np.full((3, 2), np.nan), np.zeros((3, 2))))
    assert arm.commands == []
    assert arm.state().positions.tolist() == list(REST)


def test_nothing_moves_when_closed_or_without_torque() -> None:
    arm = RecordingArm(ARM, VirtualClock())
    with pytest.raises(ArmError, match="not open"):
        arm.energise()
    with pytest.raises(ArmError, match="not open"):
        arm.state()
    arm.open()
    for action in (lambda: arm.follow(move((0.4, 0.1))), lambda: arm.grip(40.0)):
        with pytest.raises(ArmError, match="torque is off"):
            action()
    assert arm.commands == []


def test_a_stop_ends_the_running_move_on_its_path() -> None:
    class StoppingClock(VirtualClock):
        def sleep(self, seconds: float) -> None:
            super().sleep(seconds)
            if self.now() > 0.035:
                stopped.request_stop()

    stopped = arm = RecordingArm(ARM, StoppingClock())
    arm.open()
    arm.energise()
    report = arm.follow(move((0.5, -0.5)))
    assert not report.finished
    assert report.state.positions.tolist() == pytest.approx([0.2, -0.5])
    assert not arm.follow(move((0.0, 0.0), start=(0.2, -0.5))).finished
    assert not arm.grip(40.0).finished
    arm.clear_stop()
    assert [c["command"] for c in arm.commands] == ["energise", "follow", "stop", "follow", "grip", "clear_stop"]
    arm.relax()
    arm.close()


def test_a_move_that_has_nothing_to_do_is_unfinished_while_stopped(arm: RecordingArm) -> None:
    still = Trajectory("still", 0.01, np.array([REST]), np.array([REST]))
    arm.request_stop()
    assert not arm.follow(still).finished
    arm.clear_stop()
    assert arm.follow(still).finished


def test_a_stop_is_on_record_even_if_nothing_follows(arm: RecordingArm) -> None:
    arm.request_stop()
    arm.close()
    assert [c["command"] for c in arm.commands] == ["stop"]


def test_scripted_failures_come_at_their_call(arm: RecordingArm) -> None:
    arm.fail_on("grip", 2, BusError("bus", "write", "timeout", "silent"))
    arm.grip(40.0)
    with pytest.raises(BusError, match="silent"):
        arm.grip(50.0)
    assert arm.state().opening == 40.0
    arm.grip(50.0)
    assert [c.get("fails") for c in arm.commands] == [None, "BusError", None]


def test_a_move_can_fail_on_its_way(arm: RecordingArm) -> None:
    arm.fail_on("follow", 1, MotionTimeout("shoulder", "follow", "blocked"), fraction=0.5)
    with pytest.raises(MotionTimeout):
        arm.follow(move((1.0, -0.5)))
    assert arm.state().positions.tolist() == [0.5, -0.5]


@pytest.mark.parametrize("operation", ["open", "state", "energise", "relax"])
def test_every_call_can_be_made_to_fail_once(operation: str) -> None:
    arm = RecordingArm(ARM, VirtualClock())
    call: Callable[[], object] = getattr(arm, operation)
    if operation != "open":
        arm.open()
    arm.fail_on(operation, 1, BusError("bus", operation, "lost", "gone"))
    with pytest.raises(BusError, match="gone"):
        call()
    call()


def test_a_failure_of_an_unknown_call_is_a_mistake_of_the_test(arm: RecordingArm) -> None:
    with pytest.raises(ValueError, match="flollow"):
        arm.fail_on("flollow", 1, RuntimeError())


def test_grips_settle_by_script_and_then_by_the_model() -> None:
    part = 44.0
    arm = RecordingArm(ARM, VirtualClock(), grip_model=lambda before, wanted: (wanted < part, max(wanted, part)))
    arm.open()
    arm.energise()
    arm.grip_result(contact=False, opening=70.0)
    assert (arm.grip(60.0).opening, arm.grip(60.0).contact) == (70.0, False)
    report = arm.grip(36.0, effort=0.6)
    assert (report.contact, report.opening, report.load) == (True, 44.0, 0.6)
    assert arm.state().gripper_load == 0.6
    with pytest.raises(ValueError, match="effort"):
        arm.grip(40.0, effort=0.0)


def test_commands_stream_to_a_file_as_they_are_given(tmp_path: Path) -> None:
    seen_during_move: list[Command] = []
    with CommandFile(tmp_path / "moves.jsonl") as record:

        def watch(command: Command) -> None:
            record(command)
            lines = record.path.read_text(encoding="utf-8").splitlines()
            seen_during_move.append(json.loads(lines[-1]))

        arm = RecordingArm(ARM, VirtualClock(), on_command=watch)
        arm.open()
        arm.energise()
        arm.follow(move((0.4, 0.1)))
    assert seen_during_move == arm.commands
    lines = (tmp_path / "moves.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line) for line in lines] == arm.commands


def test_a_file_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="folder that can be written"):
        CommandFile(tmp_path / "none" / "moves.jsonl")

"""Jogging: what a line means, bounded steps, the heartbeat, and bins taught at the jogged pose."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.config.taught import load_taught, with_taught
from controller.domain import ArmState, Array
from controller.errors import ConfigError, InputError, LimitViolation
from controller.motion.kinematics import points
from controller.motion.manual import REDUCED_SPEED, ManualPlanner
from controller.service.jogging import HEARTBEAT, Command, DeadMan, HeartbeatLost, Jogger, parse
from controller.service.manual import ManualCell, by_ruler
from sim_backends.recording_arm import RecordingArm
from sim_backends.virtual_clock import VirtualClock
from tests.unit.motion.scene import RX150

CELL = load_cell(shipped("sim.toml"))


class WatchedClock(VirtualClock):
    """Time that somebody looks at whenever it passes."""

    def __init__(self) -> None:
        super().__init__()
        self.watch: Callable[[float], None] = lambda elapsed: None

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        self.watch(seconds)


class Bench:
    """A recording arm at its ready pose, jogged under a heartbeat that a test beats."""

    def __init__(self, taught: Path | None = None, arm: type[RecordingArm] = RecordingArm) -> None:
        self.clock = WatchedClock()
        self.arm = arm(RX150, self.clock)
        calibration = by_ruler(CELL)
        planner = ManualPlanner(RX150, calibration, CELL.bin_values())
        cell = ManualCell(CELL, self.arm, self.clock, calibration, planner)
        self.dead_man = DeadMan(self.arm.request_stop)
        self.dead_man.beat()
        self.jogger = Jogger(cell, self.dead_man, taught)
        self.arm.open()
        self.arm.energise()
        self.do("home")

    def do(self, line: str) -> str:
        return self.jogger.do(parse(line, 5))

    def tool(self) -> Array:
        return self.jogger.cell.planner.tool(self.arm.state().positions)


def test_lines_become_commands() -> None:
    assert parse("x+ 10", 5) == Command("shift", 0, 10.0)
    assert parse(" Z-2.5 ", 5) == Command("shift", 2, -2.5)
    assert parse("j1- 2", 5) == Command("turn", 0, -2.0)
    assert parse("j5+", 5) == Command("turn", 4, 2.0)
    assert parse("jaws 40", 5) == Command("jaws", amount=40.0)
    assert parse("jaws- 5", 5) == Command("open", amount=-5.0)
    assert parse("set my bin", 5) == Command("set", name="my bin")
    assert parse("q", 5) == Command("quit")


@pytest.mark.parametrize(
    "line", ["", "x", "x+ ten", "x+ .", "x+ 51", "x+ 0", "j1+ 21", "j6+ 1", "set", "jaws", "jaws nan", "x+ nan"]
)
def test_anything_else_is_refused(line: str) -> None:
    with pytest.raises(InputError):
        parse(line, 5)


def test_steps_go_where_they_say() -> None:
    bench = Bench()
    before = bench.tool()
    for line, axis, amount in (("x+ 20", 0, 20.0), ("y- 15", 1, -15.0), ("z- 30", 2, -30.0)):
        bench.do(line)
        moved = np.zeros(3)
        moved[axis] = amount
        # The recording arm is perfect: what is left is the spline between the knots of a path.
        assert np.abs(bench.tool() - before - moved).max() < 1e-3
        before = bench.tool()
    angles = bench.arm.state().positions
    bench.do("j5+ 10")
    assert np.degrees(bench.arm.state().positions - angles) == pytest.approx([0, 0, 0, 0, 10], abs=1e-6)


@pytest.mark.safety("SR-17")
def test_straight_steps_are_straight_and_slow() -> None:
    planner = ManualPlanner(RX150, by_ruler(CELL), CELL.bin_values())
    posture = np.array(RX150.ready)
    move = planner.shifted(posture, np.array([50.0, 0.0, 0.0]), 74.0)
    way = points(RX150, move.positions)[:, 3]
    assert np.abs(way[:, 1:] - way[0, 1:]).max() < 0.01
    for fast in (move, planner.turned(posture, 0, 0.35, 74.0), planner.park(posture)):
        steps = np.linalg.norm(np.diff(points(RX150, fast.positions)[:, 3], axis=0), axis=1)
        assert steps.max() / fast.period <= REDUCED_SPEED


@pytest.mark.safety("SR-17")
def test_never_below_the_table() -> None:
    bench = Bench()
    while bench.tool()[2] - RX150.gripper.jaw_depth > 21.0:
        bench.do("z- 20")
    commands = len(bench.arm.commands)
    with pytest.raises(LimitViolation, match="over the table"):
        bench.do("z- 20")
    assert len(bench.arm.commands) == commands
    assert bench.tool()[2] - RX150.gripper.jaw_depth > 1.0


class SaggingArm(RecordingArm):
    """Stands lower than it was told."""

    def state(self) -> ArmState:
        found = super().state()
        return replace(found, positions=found.positions + np.array([0.0, 0.005, 0.005, 0.0, 0.0]))


def test_sag_does_not_add_up() -> None:
    """Steps begin where the last was to end, not where the arm has sagged to."""
    bench = Bench(arm=SaggingArm)
    bench.do("z- 20")
    first = bench.tool()
    for _ in range(5):
        bench.do("x+ 5")
        bench.do("x- 5")
    # Each step would else come 1 to 2 mm lower than the last.
    assert bench.tool() == pytest.approx(first, abs=1e-3)


@pytest.mark.safety("SR-17")
def test_a_missing_heartbeat_stops_the_arm_on_its_path() -> None:
    bench = Bench()
    bench.dead_man.tick(0.0)
    began = bench.clock.now()
    bench.clock.watch = bench.dead_man.tick
    assert bench.do("j1+ 20") == "stopped on the way"
    # The arm looks at the stop once a period of 10 ms.
    assert bench.clock.now() - began <= HEARTBEAT + 0.01
    turned = float(bench.arm.state().positions[0])
    assert 0.0 < turned < np.radians(20.0)


@pytest.mark.safety("SR-17")
def test_after_a_loss_the_arm_waits_for_a_new_command_and_a_heartbeat() -> None:
    bench = Bench()
    bench.clock.watch = bench.dead_man.tick
    bench.do("j1+ 20")
    angle = bench.arm.state().positions[0]
    with pytest.raises(HeartbeatLost):
        bench.do("j1+ 1")
    assert bench.arm.state().positions[0] == angle
    bench.clock.watch = lambda elapsed: bench.dead_man.beat()
    bench.dead_man.beat()
    bench.dead_man.tick(0.01)
    assert bench.do("j1+ 1") == ""
    assert bench.arm.state().positions[0] == pytest.approx(angle + np.radians(1.0))


def test_beats_keep_it_going_and_a_suspended_watcher_is_not_a_lost_client() -> None:
    stops: list[str] = []
    dead_man = DeadMan(lambda: stops.append("stop"))
    for _ in range(50):
        dead_man.beat()
        dead_man.tick(0.02)
        for _ in range(8):
            dead_man.tick(0.02)
    dead_man.beat()
    dead_man.tick(0.02)
    dead_man.tick(10.0)
    assert not stops
    for _ in range(9):
        dead_man.tick(0.02)
    assert stops == ["stop"]


def test_the_watching_thread_stops_the_arm() -> None:
    stopped = threading.Event()
    dead_man = DeadMan(stopped.set)
    with dead_man.watching():
        dead_man.beat()
        assert stopped.wait(10.0)


def test_teaching_writes_a_file_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "bins.toml"
    bench = Bench(path)
    for line in (*["j1+ 20"] * 4, "x+ 40", "y+ 50", "y+ 50"):
        bench.do(line)
    x, y, _ = bench.tool()
    assert bench.do("set squares").startswith("squares stands at")
    assert load_taught(path)["squares"] == pytest.approx((x, y), abs=0.01)
    taught = with_taught(CELL, path)
    assert taught.bins[0].center_mm == load_taught(path)["squares"]
    assert taught.bins[1:] == CELL.bins[1:]
    assert taught.digest != CELL.digest


def test_teaching_refuses_what_cannot_be(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "bins.toml")
    with pytest.raises(ConfigError, match="did you mean squares"):
        bench.do("set square")
    assert not (tmp_path / "bins.toml").exists()
    with pytest.raises(InputError, match="no file"):
        Bench().do("set squares")


def test_taught_bins_of_another_cell_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bins.toml"
    path.write_text('[[bins]]\nname = "nuts"\ncenter_mm = [1.0, 2.0]\n')
    with pytest.raises(ConfigError, match="nuts"):
        with_taught(CELL, path)
    path.write_text('[[bins]]\nname = "squares"\ncenter_mm = [1.0]\n')
    with pytest.raises(ConfigError, match="center_mm"):
        with_taught(CELL, path)

"""The arm driver among late cycles and faults: it says why it stops, invents nothing and never jumps."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from controller.domain import ArmState, Trajectory
from controller.errors import ArmError, BusError, LimitViolation, MotionTimeout, ServoFault
from drivers.arm.body import WATCHDOG
from drivers.arm.conversions import TICKS_PER_RAD
from drivers.arm.following import FOLLOWING_LIMIT
from sim_backends.virtual_dynamixel.faults import Fault
from tests.benchmarks.bad_line import study
from tests.contract.arm_suite import STANDS, quintic
from tests.unit.drivers.bench import ELBOW, JAW, SHOULDER, WAIST, WRIST, ArmBench, a_move, goals_told

# --- late cycles ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("stall", [0.02, 0.05, 0.1, 0.15, 0.2, 0.5])
@pytest.mark.safety("SR-14")
def test_a_stalled_sender_slips_and_never_jumps(stall: float) -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        move = a_move(bench)
        bench.stream.goals.clear()
        largest = np.abs(np.diff(move.goals[:, 0])).max() * TICKS_PER_RAD
        bench.later(0.5, lambda: setattr(bench.clock, "stall", stall))
        began = bench.plant.now()
        report = arm.follow(move)
        assert report.finished
        assert np.abs(report.state.positions - move.positions[-1]).max() < STANDS
        assert bench.plant.now() - began > 1.0 + stall - 0.03
        _, ticks = goals_told(bench)
    # At most two periods are caught up. A tripped watchdog has stopped the joint behind its goal, where it goes on
    # from: that is a step back of no more than the lag (45 ms at 1.5 rad/s), and never one ahead.
    assert np.diff(ticks).max() <= 2 * largest + 1
    lag = 0.0 if stall < WATCHDOG - 0.02 else 0.045 * 1.5 * TICKS_PER_RAD
    assert np.diff(ticks).min() >= -lag - 1


def test_a_watchdog_that_tripped_between_moves_is_cleared() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        assert arm.follow(a_move(bench)).finished
        assert bench.register(WAIST, "Bus_Watchdog") == 0
        for servo_id in (WAIST, JAW):
            bench.bus.servo(servo_id).trip()
        assert arm.follow(a_move(bench)).finished
        assert arm.grip(60.0).finished


@pytest.mark.safety("SR-25")
def test_the_watchdog_is_armed_only_while_moving() -> None:
    bench = ArmBench()
    seen: list[int] = []
    with bench.ready() as arm:
        bench.later(0.5, lambda: seen.append(bench.register(ELBOW, "Bus_Watchdog")))
        arm.follow(a_move(bench))
        assert seen == [10]
        assert bench.register(ELBOW, "Bus_Watchdog") == 0


# --- faults in mid-move --------------------------------------------------------------------------------


@pytest.mark.safety("SR-25", "SR-27")
def test_unplugged_in_mid_move() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        bench.later(0.5, lambda: bench.bus.strike(Fault.DISCONNECT))
        began = bench.plant.now()
        with pytest.raises(BusError) as caught:
            arm.follow(a_move(bench))
        assert caught.value.code == "lost"
        assert bench.plant.now() - began < 0.6
        # The servos stop by themselves: within the watchdog's time and the physics' next look.
        bench.plant.advance(0.25)
        there = bench.positions()
        assert bench.register(WAIST, "Bus_Watchdog") == -1
        bench.plant.advance(1.0)
        assert np.abs(bench.positions() - there).max() < STANDS
        with pytest.raises(BusError):
            arm.state()
        bench.bus.heal()
        arm.open()
        assert np.abs(arm.state().positions - there).max() < STANDS
        arm.energise()
        assert arm.follow(a_move(bench)).finished


@pytest.mark.parametrize("servo_id", [WAIST, WRIST, JAW])
@pytest.mark.parametrize("fault", [Fault.OVERLOAD, Fault.OVERHEAT, Fault.UNDERVOLTAGE, Fault.ENCODER])
def test_a_hardware_error_stops_the_move_and_names_the_joint(servo_id: int, fault: Fault) -> None:
    bits = {Fault.OVERLOAD: 0x20, Fault.OVERHEAT: 0x04, Fault.UNDERVOLTAGE: 0x01, Fault.ENCODER: 0x08}[fault]
    bench = ArmBench()
    with bench.ready() as arm:
        move = a_move(bench, 2.0)
        bench.later(0.6, lambda: bench.bus.strike(fault, servo_id))
        bench.stream.goals.clear()
        with pytest.raises(ServoFault) as caught:
            arm.follow(move)
        assert caught.value.bits == bits
        assert caught.value.joint == dict(zip(range(1, 7), [*bench.description.joint_names, "gripper"], strict=True))[
            servo_id
        ]
        assert caught.value.remedy
        assert 0.6 < bench.plant.now() < 1.4
        assert np.diff(goals_told(bench)[1]).min() >= 0


@pytest.mark.safety("SR-27")
def test_a_silent_servo_stops_the_move() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        bench.later(0.5, lambda: bench.bus.strike(Fault.SILENT, ELBOW))
        with pytest.raises(BusError, match="elbow") as caught:
            arm.follow(a_move(bench, 2.0))
        assert caught.value.code == "timeout"
        assert bench.plant.now() < 1.2


@pytest.mark.safety("SR-27")
def test_jaws_that_fall_silent_before_they_are_told_to_open_slow_the_arm_down() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        move = a_move(bench, 2.0)
        bench.later(0.99, lambda: bench.bus.strike(Fault.SILENT, JAW))
        bench.stream.goals.clear()
        with pytest.raises(BusError, match="no answer"):
            arm.follow(move, opening=50.0, after=1.0)
        steps = np.diff(goals_told(bench)[1])
    # Of the speed at half of the way, the last goal shows next to nothing.
    assert steps[-1] < 0.2 * steps.max()


@pytest.mark.safety("SR-15")
def test_a_servo_that_restarts_in_mid_move_ends_it() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        bench.later(0.5, lambda: bench.bus.strike(Fault.REBOOT, SHOULDER))
        with pytest.raises(ArmError, match="shoulder"):
            arm.follow(a_move(bench, 2.0))
        bench.plant.advance(0.5)
        with pytest.raises(ServoFault, match="restarted"):
            arm.follow(quintic(arm.state().positions, arm.state().positions, 0.1))
        arm.open()
        arm.energise()
        assert arm.follow(a_move(bench)).finished


@pytest.mark.safety("SR-15")
def test_a_blocked_joint_ends_the_move_and_is_let_go() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        stuck = bench.plant.shaft(WAIST).angle
        bench.plant.block(WAIST, high=stuck + 0.1)
        bench.stream.goals.clear()
        with pytest.raises(MotionTimeout, match="waist"):
            arm.follow(a_move(bench, 2.0))
        _, ticks = goals_told(bench)
        # Five cycles at the move's top speed of 0.75 rad/s beyond the limit.
        assert (ticks.max() - ticks[0]) / TICKS_PER_RAD < 0.1 + FOLLOWING_LIMIT + 6 * 0.0075
        # In the end it is told to stay where it is: no overload while somebody comes to look.
        assert (ticks[-1] - ticks[0]) / TICKS_PER_RAD == pytest.approx(0.1, abs=STANDS)
        bench.plant.advance(3.0)
        here = arm.state().positions
        assert arm.follow(quintic(here, here - np.array([0.1, 0.0, 0.0, 0.0, 0.0]), 0.5)).finished


@pytest.mark.safety("SR-15", "SR-27")
def test_a_joint_that_does_not_arrive_is_no_success() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        move = a_move(bench)
        bench.plant.block(WAIST, high=bench.plant.shaft(WAIST).angle + 0.6)  # 0.2 rad before the end
        with pytest.raises(MotionTimeout, match="waist"):
            arm.follow(move)


@pytest.mark.safety("SR-32")
def test_a_bad_line_gives_no_wrong_value_and_moves_nothing_unasked() -> None:
    """1 % each of lost, dropped, corrupted, truncated, late and noisy packets; `bad_line` itself runs 10 000 cycles."""
    found = study(500, 0.01, 2000)
    assert found.holds, (found.wrong, found.outside, found.unasked)
    assert found.missed > 100
    assert found.cycles >= 500


# --- refusals ------------------------------------------------------------------------------------------


@pytest.mark.safety("SR-11")
def test_unsafe_trajectories_are_refused() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        good = a_move(bench)
        before = len(bench.stream.goals)
        nan = good.goals.copy()
        nan[50, 2] = np.nan
        far = good.goals.copy()
        far[50, 1] = 4.0
        jump = good.goals + 0.2
        for goals in (nan, far, jump):
            with pytest.raises(LimitViolation):
                arm.follow(Trajectory("bad", 0.01, good.positions, goals))
        for bad in (nan, good.goals[:-1]):
            with pytest.raises(LimitViolation):
                arm.follow(replace(good, resting=bad))
            with pytest.raises(LimitViolation):
                arm.follow(replace(good, braking=bad))
        with pytest.raises(LimitViolation):
            arm.follow(Trajectory("bad", 0.0, good.positions, good.goals))
        assert len(bench.stream.goals) == before


def test_an_offset_in_the_first_goal_is_led_in_gently() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        still = np.repeat(arm.state().positions[None], 60, axis=0)
        bench.stream.goals.clear()
        arm.follow(Trajectory("offset", 0.01, still, still + 0.08))
        _, ticks = goals_told(bench)
    assert ticks[-1] - ticks[0] == pytest.approx(0.08 * TICKS_PER_RAD, abs=1)
    # A raised cosine of 0.25 s has its steepest step at pi/2 times the mean.
    assert np.diff(ticks).max() <= 0.08 * TICKS_PER_RAD * np.pi / 2 * 0.01 / 0.25 + 1


def test_one_move_at_a_time_and_state_from_other_threads() -> None:
    bench = ArmBench()
    states: list[ArmState] = []
    errors: list[ArmError] = []

    def from_a_thread() -> None:
        def ask() -> None:
            states.append(bench.arm.state())
            try:
                bench.arm.grip(50.0)
            except ArmError as error:
                errors.append(error)

        thread = threading.Thread(target=ask)
        thread.start()
        thread.join()

    with bench.ready() as arm:
        bench.later(0.5, from_a_thread)
        assert arm.follow(a_move(bench)).finished
    (state,), (error,) = states, errors
    assert 0.4 < state.at < 0.7
    assert "busy" in str(error)

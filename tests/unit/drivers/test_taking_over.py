"""The arm driver takes over servos as something left them: a crash, a tripped watchdog, another program."""

from __future__ import annotations

import math

import numpy as np
import pytest

from controller.errors import ServoFault
from drivers.arm.gripping import RATED_PWM
from sim_backends.virtual_dynamixel.faults import Fault
from tests.contract.arm_suite import JAWS
from tests.unit.drivers.bench import JAW, SHOULDER, WAIST, ArmBench, a_move, goals_told


def _part(bench: ArmBench) -> None:
    """Something rigid between the jaws, which close with a falling angle, 0.3 rad from here."""
    angle = bench.plant.shaft(JAW).angle
    bench.plant.block(JAW, angle - 0.3, math.inf)


@pytest.mark.safety("SR-01")
def test_a_new_start_squeezes_no_harder_what_the_jaws_hold() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        arm.grip(70.0)
        _part(bench)
        assert arm.grip(32.0).contact
        squeezes = abs(bench.plant.shaft(JAW).torque)
        arm.open()
        bench.plant.advance(0.1)
        assert bench.register(JAW, "Goal_PWM") == RATED_PWM
        assert abs(bench.plant.shaft(JAW).torque) == pytest.approx(squeezes, rel=0.05)


@pytest.mark.safety("SR-01", "SR-25")
def test_goals_from_before_a_crash_never_come_into_force_again() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        bench.later(0.5, lambda: bench.bus.strike(Fault.DISCONNECT))
        with pytest.raises(Exception, match="unplugged"):
            arm.follow(a_move(bench))
        bench.plant.advance(0.5)
        there = 2048 + bench.plant.shaft(WAIST).angle * 4096 / (2.0 * math.pi)
        bench.bus.heal()
        arm.open()
        # A servo that would take up its last goal as soon as the watchdog is cleared does not get to.
        assert bench.register(WAIST, "Bus_Watchdog") == -1
        arm.energise()
        bench.stream.goals.clear()
        assert arm.follow(a_move(bench)).finished
        assert bench.register(WAIST, "Bus_Watchdog") == 0
        _, ticks = goals_told(bench)
    # It had been told 44 ticks ahead of where it stands: 45 ms at 1.5 rad/s.
    assert np.abs(ticks[:2] - there).max() <= 3


def test_a_watchdog_that_tripped_does_not_keep_torque_off() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        bench.bus.servo(WAIST).trip()
        arm.relax()
        arm.open()
        arm.energise()
        assert arm.follow(a_move(bench)).finished


def test_jaws_that_the_watchdog_stopped_go_on_holding() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        arm.grip(70.0)
        _part(bench)
        arm.grip(32.0)
        squeezes = bench.plant.shaft(JAW).torque
        bench.later(0.5, lambda: setattr(bench.clock, "stall", 0.5))
        assert arm.follow(a_move(bench)).finished
        assert bench.plant.shaft(JAW).torque == pytest.approx(squeezes, rel=0.05)


@pytest.mark.parametrize(("before", "opening"), [(70.0, 32.0), (32.0, 70.0)])
def test_jaws_that_the_watchdog_stops_in_mid_grip_have_met_nothing(before: float, opening: float) -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        arm.grip(before)
        bench.later(0.06, lambda: setattr(bench.clock, "stall", 0.5))
        report = arm.grip(opening)
        assert report.finished
        assert not report.contact
        assert report.opening == pytest.approx(opening, abs=JAWS)


@pytest.mark.safety("SR-22")
def test_a_second_servo_that_holds_is_not_restarted_through_its_partner() -> None:
    bench = ArmBench("widowx_250")
    partner, shadow = SHOULDER, SHOULDER + 1
    with bench.ready() as arm:
        bench.bus.strike(Fault.OVERLOAD, partner)
        with pytest.raises(ServoFault, match="second servo"):
            arm.open(restart=True)
        assert bench.register(shadow, "Torque_Enable") == 1
        bench.bus.strike(Fault.OVERLOAD, shadow)
        arm.open(restart=True)
        arm.energise()
        assert arm.follow(a_move(bench)).finished


def test_servos_told_to_answer_nothing_but_pings_answer_again() -> None:
    bench = ArmBench()
    for servo_id in range(1, 7):
        bench.bus.servo(servo_id).table.set("Status_Return_Level", 0)
    with bench.ready() as arm:
        assert arm.follow(a_move(bench)).finished

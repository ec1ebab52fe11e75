"""The arm driver at start and end: settings, inventory, torque and second servos of a joint."""

from __future__ import annotations

import numpy as np
import pytest

from controller.errors import ArmError, BusError, ServoFault
from sim_backends.virtual_dynamixel.bench import IdealPlant
from sim_backends.virtual_dynamixel.bus import VirtualBus
from sim_backends.virtual_dynamixel.faults import Fault
from sim_backends.virtual_dynamixel.servo import ServoSpec
from tests.contract.arm_suite import STANDS
from tests.unit.drivers.bench import ELBOW, JAW, SHOULDER, WAIST, WRIST, ArmBench, a_move

# --- start and end -------------------------------------------------------------------------------------


def test_settings_are_written_only_where_they_differ() -> None:
    bench = ArmBench()
    bench.arm.open()
    assert any("Return_Delay_Time 250 -> 0" in line for line in bench.arm.changed)
    assert bench.register(SHOULDER, "Drive_Mode") == 1
    assert bench.register(WAIST, "Drive_Mode") == 0
    assert bench.register(WRIST, "Position_D_Gain") == 0
    low, high = bench.register(ELBOW, "Min_Position_Limit"), bench.register(ELBOW, "Max_Position_Limit")
    # The elbow's limits of -102 and 95 degrees, and 5 for the offsets.
    assert (low, high) == tuple(2048 + round(degrees * 4096 / 360) for degrees in (-107.0, 100.0))
    assert bench.register(WAIST, "Torque_Enable") == 0
    bench.arm.open()
    assert bench.arm.changed == ()
    bench.arm.close()


@pytest.mark.parametrize(
    ("register", "value"), [("Operating_Mode", 4), ("Homing_Offset", 300), ("Drive_Mode", 5), ("Secondary_ID", 3)]
)
def test_foreign_settings_are_put_right(register: str, value: int) -> None:
    bench = ArmBench(settings={SHOULDER: ((register, value),)})
    with bench.ready() as arm:
        assert np.abs(arm.state().positions - bench.description.rest).max() < STANDS
        assert arm.follow(a_move(bench)).finished


@pytest.mark.safety("SR-06")
def test_a_bus_that_only_garbles_points_at_shared_ids() -> None:
    bench = ArmBench()
    bench.bus.faults.once(Fault.CORRUPT, ELBOW, count=3)
    with pytest.raises(BusError, match="elbow") as caught:
        bench.arm.open()
    assert caught.value.code == "corrupt"
    assert "same ID" in caught.value.remedy


@pytest.mark.safety("SR-06")
def test_missing_servos_are_all_named() -> None:
    bench = ArmBench()
    for servo_id in (ELBOW, JAW):
        bench.bus.strike(Fault.SILENT, servo_id)
    with pytest.raises(BusError) as caught:
        bench.arm.open()
    assert "servo 3 (elbow)" in str(caught.value)
    assert "servo 6 (gripper)" in str(caught.value)


@pytest.mark.safety("SR-06")
def test_another_model_is_named() -> None:
    bench = ArmBench()
    specs = [ServoSpec(i, "XL430-W250") for i in range(1, 7)]
    other = VirtualBus(IdealPlant(range(1, 7)), specs)
    bench.stream._bus = other
    bench.stream._plant = other.plant
    with pytest.raises(BusError, match="XL430-W250, not XM430-W350"):
        bench.arm.open()


@pytest.mark.safety("SR-25")
def test_firmware_without_a_bus_watchdog_is_named() -> None:
    bench = ArmBench()
    for servo_id, version in ((SHOULDER, 37), (WRIST, 38)):
        bench.bus.servo(servo_id).table.set("Firmware_Version", version)
    with pytest.raises(BusError, match=r"servo 2 \(shoulder\) has firmware 37, older than 38.*: renew it") as caught:
        bench.arm.open()
    assert "wrist" not in str(caught.value)


@pytest.mark.safety("SR-06")
def test_a_fault_at_start_is_told_and_not_taken_for_absence() -> None:
    bench = ArmBench()
    bench.bus.strike(Fault.OVERLOAD, SHOULDER)
    with pytest.raises(ServoFault) as caught:
        bench.arm.open()
    assert caught.value.joint == "shoulder"


@pytest.mark.parametrize("keeps_goal", [False, True])
@pytest.mark.safety("SR-02")
def test_torque_on_does_not_jump_to_an_old_goal(keeps_goal: bool) -> None:
    bench = ArmBench()
    plant = IdealPlant(range(1, 7))
    joints = bench.description.joints
    specs = [ServoSpec(joint.servo_id, joint.model, keeps_goal=keeps_goal) for joint in joints]
    bus = VirtualBus(plant, [*specs, ServoSpec(JAW, "XL430-W250", keeps_goal=keeps_goal)])
    bench.stream._bus, bench.stream._plant, bench.clock._plant = bus, plant, plant
    bench.arm.open()
    for joint in joints:
        bus.servo(joint.servo_id).table.set("Goal_Position", 2500)
    bench.arm.energise()
    plant.advance(0.5)
    assert max(abs(plant.shaft(joint.servo_id).angle) for joint in joints) < STANDS
    bench.arm.close()


@pytest.mark.safety("SR-21")
def test_an_arm_that_holds_is_not_dropped_by_a_new_start() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        arm.follow(a_move(bench))
        there = bench.positions()
        arm.open()
        assert all(bench.register(i, "Torque_Enable") == 1 for i in range(1, 7))
        arm.energise()
        bench.plant.advance(0.3)
        assert np.abs(bench.positions() - there).max() < STANDS
        assert arm.follow(a_move(bench)).finished


@pytest.mark.safety("SR-02")
def test_a_joint_outside_its_limits_is_not_pulled_in() -> None:
    bench = ArmBench()
    bench.plant.place(WRIST, 2.0)
    bench.arm.open()
    with pytest.raises(ArmError, match="wrist_angle"):
        bench.arm.energise()
    assert all(bench.register(i, "Torque_Enable") == 0 for i in range(1, 7))
    bench.arm.close()


def test_relax_reaches_every_servo_and_names_the_doubtful() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        bench.bus.strike(Fault.SILENT, SHOULDER)
        bench.bus.strike(Fault.OVERLOAD, ELBOW)
        with pytest.raises(BusError, match="shoulder") as caught:
            arm.relax()
        assert "elbow" not in str(caught.value)
        assert [i for i in range(1, 7) if bench.register(i, "Torque_Enable")] == [SHOULDER]


@pytest.mark.safety("SR-22")
def test_restarting_a_faulted_servo_gives_it_back() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        bench.bus.strike(Fault.OVERLOAD, WRIST)
        with pytest.raises(ServoFault):
            arm.state()
        with pytest.raises(ServoFault):
            arm.open()
        arm.open(restart=True)
        assert [i for i in range(1, 7) if bench.register(i, "Torque_Enable") == 0] == [WRIST]
        assert bench.register(WRIST, "Position_D_Gain") == 0
        arm.energise()
        assert arm.follow(a_move(bench)).finished


def test_a_fault_that_comes_back_stays_a_fault() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        bench.bus.strike(Fault.OVERHEAT, WRIST)
        bench.plant.advance(0.1)
        with pytest.raises(ServoFault) as caught:
            arm.open(restart=True)
        assert caught.value.bits == 0x04


@pytest.mark.safety("SR-22")
def test_a_servo_that_reports_an_error_and_holds_is_not_restarted() -> None:
    bench = ArmBench()
    with bench.ready() as arm:
        bench.bus.strike(Fault.UNDERVOLTAGE, SHOULDER)
        bench.plant.advance(0.1)
        bench.bus.heal()
        with pytest.raises(ServoFault, match="voltage"):
            arm.open(restart=True)
        assert all(bench.register(i, "Torque_Enable") == 1 for i in range(1, 7))


# --- second servos of a joint --------------------------------------------------------------------------


def test_shadows_move_with_their_partners() -> None:
    bench = ArmBench("widowx_250")
    with bench.ready() as arm:
        assert (bench.register(3, "Secondary_ID"), bench.register(5, "Secondary_ID")) == (2, 4)
        assert bench.register(3, "Drive_Mode") != bench.register(2, "Drive_Mode")
        assert arm.follow(a_move(bench)).finished
        for partner, shadow in ((2, 3), (4, 5)):
            assert bench.plant.shaft(partner).angle == pytest.approx(-bench.plant.shaft(shadow).angle, abs=STANDS)
        bench.bus.strike(Fault.OVERLOAD, 5)
        with pytest.raises(ServoFault, match="elbow shadow"):
            arm.state()
        arm.open(restart=True)
        arm.energise()
        assert arm.follow(a_move(bench)).finished
        arm.relax()
        assert not any(bench.register(i, "Torque_Enable") for i in range(1, 9))


def test_a_crooked_shadow_is_aligned_or_refused() -> None:
    bench = ArmBench("widowx_250")
    angle = bench.plant.shaft(3).angle
    bench.plant.place(3, angle + 0.1)
    with bench.ready() as arm:
        assert any("Homing_Offset" in line for line in arm.changed)
        before = bench.plant.shaft(3).angle
        assert arm.follow(a_move(bench)).finished
        assert bench.plant.shaft(3).angle + bench.plant.shaft(2).angle == pytest.approx(0.1, abs=STANDS)
        assert before != bench.plant.shaft(3).angle
    bench = ArmBench("widowx_250")
    bench.plant.place(3, bench.plant.shaft(3).angle - 1.7)
    with pytest.raises(BusError, match="partner"):
        bench.arm.open()

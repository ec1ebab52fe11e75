"""How the simulated servo moves, against the manual's promises: over the bus, on a world of ideal shafts."""

from __future__ import annotations

import math

import pytest

from sim_backends.virtual_dynamixel import BusStream, Fault, ServoSpec, VirtualBus
from sim_backends.virtual_dynamixel.bench import IdealPlant

from .bus_client import Client, rig

TICK = 2 * math.pi / 4096


def test_a_goal_is_reached_and_reported() -> None:
    client, plant, _ = rig()
    client.write("Torque_Enable", 1)
    client.write("Goal_Position", 3072)
    plant.advance(1.0)
    assert client.read("Present_Position") == 3072
    assert plant.shaft(1).angle == pytest.approx(math.pi / 2, abs=TICK)
    assert client.read("Moving") == 0
    assert client.read("Moving_Status") & 1


def test_reverse_mode_turns_the_shaft_the_other_way() -> None:
    client, plant, _ = rig(Drive_Mode=1)
    client.write("Torque_Enable", 1)
    client.write("Goal_Position", 3072)
    plant.advance(1.0)
    assert plant.shaft(1).angle == pytest.approx(-math.pi / 2, abs=TICK)
    assert client.read("Present_Position") == 3072


def test_torque_on_holds_where_the_shaft_stands() -> None:
    client, plant, _ = rig()
    client.write("Goal_Position", 1000)
    plant.place(1, 0.5)
    client.write("Torque_Enable", 1)
    plant.advance(0.5)
    assert plant.shaft(1).angle == pytest.approx(0.5, abs=TICK)
    assert client.read("Goal_Position") == round(2048 + 0.5 / TICK)


def test_a_servo_that_keeps_its_goal_jumps_at_torque_on() -> None:
    plant = IdealPlant([1])
    bus = VirtualBus(plant, [ServoSpec(1, "XM430-W350", (("Return_Delay_Time", 0),), keeps_goal=True)])
    stream = BusStream(bus)
    stream.open(1_000_000)
    client = Client(stream)
    client.write("Goal_Position", 2500)
    client.write("Torque_Enable", 1)
    plant.advance(1.0)
    assert client.read("Present_Position") == 2500


def test_a_velocity_profile_takes_its_time() -> None:
    client, plant, _ = rig()
    client.write("Torque_Enable", 1)
    client.write("Profile_Velocity", 64)  # 64 * 15.63 = 1000.5 ticks/s
    client.write("Profile_Acceleration", 16)  # 16 * 244.14 = 3906 ticks/s^2
    start = plant.now()
    client.write("Goal_Position", 4048)  # 2000 ticks: 0.256 s of ramps at each end, 1.743 s at speed
    plant.advance(start + 1.0 - plant.now())
    expected = 2048 + 1000.5 * (1.0 - 0.256 / 2)
    assert client.read("Position_Trajectory") == pytest.approx(expected, abs=3)  # one step of 2 ms at speed
    assert client.read("Velocity_Trajectory") == pytest.approx(64, abs=1)
    assert client.read("Moving_Status") >> 4 == 3  # trapezoid
    assert client.read("Moving") == 1
    plant.advance(1.5)
    assert client.read("Present_Position") == pytest.approx(4048, abs=1)
    assert client.read("Moving") == 0


def test_a_time_based_profile_ends_on_time_at_every_distance() -> None:
    for goal in (2100, 4000):
        client, plant, _ = rig(Drive_Mode=4)
        client.write("Torque_Enable", 1)
        client.write("Profile_Velocity", 800)
        client.write("Profile_Acceleration", 200)
        start = plant.now()
        client.write("Goal_Position", goal)
        plant.advance(start + 0.4 - plant.now())
        assert client.read("Position_Trajectory") == pytest.approx((2048 + goal) / 2, abs=8)  # 2 ms at speed
        plant.advance(start + 0.79 - plant.now())
        assert client.read("Moving_Status") & 2
        plant.advance(0.02)
        assert not client.read("Moving_Status") & 2


def test_goal_pwm_limits_the_force_of_the_position_loop() -> None:
    client, plant, _ = rig("XL430-W250", Shutdown=0)
    plant.block(1, high=0.2)
    client.write("Position_D_Gain", 0)
    client.write("Torque_Enable", 1)
    client.write("Goal_PWM", 250)
    client.write("Goal_Position", 4000)
    plant.advance(1.0)
    assert plant.shaft(1).torque == pytest.approx(1.5 * 250 / 885, rel=1e-6)
    assert client.read("Present_PWM") == 250
    assert client.read("Present_Load") == round(1000 * 250 / 885)


def test_lower_supply_makes_a_weaker_servo() -> None:
    client, plant, bus = rig("XL430-W250", Shutdown=0)
    plant.block(1, high=0.2)
    client.write("Position_D_Gain", 0)
    client.write("Torque_Enable", 1)
    bus.servo(1).set_supply(9.0)
    client.write("Goal_Position", 4000)
    plant.advance(1.0)
    assert plant.shaft(1).torque == pytest.approx(1.5 * 9 / 12, rel=1e-6)
    assert client.read("Present_Input_Voltage") == 90


def test_the_integral_gain_removes_what_a_spring_leaves() -> None:
    offsets = []
    for gain in (0, 2000):
        client, plant, _ = rig()
        client.write("Torque_Enable", 1)
        client.write("Position_I_Gain", gain)
        client.write("Goal_Position", 2148)
        plant.load(1, -1.0)
        plant.advance(4.0)
        offsets.append(client.read("Present_Position") - 2148)
    # 1 Nm against 18.9 Nm/rad is 34 ticks.
    assert offsets[0] == pytest.approx(-1.0 / 18.87 / TICK, abs=1)
    assert abs(offsets[1]) <= 2


def test_velocity_mode_turns_at_the_goal_velocity_with_a_ramp() -> None:
    client, plant, _ = rig(Operating_Mode=1)
    client.write("Torque_Enable", 1)
    client.write("Goal_Velocity", -100)
    plant.advance(2.0)
    assert client.read("Present_Velocity") == pytest.approx(-100, abs=2)


def test_velocity_mode_accelerates_as_told() -> None:
    client, plant, _ = rig(Operating_Mode=1)
    client.write("Torque_Enable", 1)
    client.write("Profile_Acceleration", 10)  # 10 * 0.3745 rad/s^2
    start = plant.now()
    client.write("Goal_Velocity", 200)
    plant.advance(start + 0.8 - plant.now())
    # The ramp is at 3.0 rad/s. The integral part lags by what the back-EMF asks of it per second:
    # 0.851 Nm s/rad * 3.745 rad/s^2 / (1920 / 65536 / ms per unit of 0.02398 rad/s = 5.66 Nm/rad).
    assert plant.shaft(1).velocity == pytest.approx(3.0 - 0.851 * 3.745 / 5.66, abs=0.05)


@pytest.mark.parametrize(("mode", "goal"), [(3, ("Goal_Position", 2500)), (16, ("Goal_PWM", 300))])
def test_a_goal_wakes_the_servo_where_drive_mode_says_so(mode: int, goal: tuple[str, int]) -> None:
    client, plant, bus = rig(Drive_Mode=8, Operating_Mode=mode)
    assert client.read("Torque_Enable") == 0
    client.write(*goal)
    assert client.read("Torque_Enable") == 1
    assert client.read(goal[0]) == goal[1]
    plant.advance(0.1)
    assert plant.shaft(1).angle > 0.1
    bus.strike(Fault.OVERLOAD, 1)
    client.write(*goal)
    assert client.read("Torque_Enable") == 0


def test_a_derivative_gain_brakes_as_its_scaling_says() -> None:
    client, plant, _ = rig("XL430-W250")
    client.write("Torque_Enable", 1)
    client.write("Profile_Velocity", 30)  # 469 ticks/s
    client.write("Position_D_Gain", 4000)
    client.write("Position_P_Gain", 640)
    client.write("Goal_Position", 4000)
    plant.advance(1.0)
    # At constant speed the derivative of the error vanishes; P makes up for the back-EMF alone:
    # 0.235 Nm s/rad * 0.719 rad/s / 5.52 Nm/rad = 20 ticks of lag.
    lag = client.read("Position_Trajectory") - client.read("Present_Position")
    assert lag == pytest.approx(0.2348 * 0.7194 / 5.522 / TICK, abs=2)


def test_pwm_mode_reaches_the_no_load_speed() -> None:
    client, plant, _ = rig("XL430-W250", Operating_Mode=16)
    client.write("Torque_Enable", 1)
    plant.advance(0.5)
    assert client.read("Present_Velocity") == 0
    client.write("Goal_PWM", 885)
    plant.advance(1.0)
    assert plant.shaft(1).velocity == pytest.approx(61 * 2 * math.pi / 60, rel=0.01)


def test_current_mode_gives_the_same_torque_at_any_speed() -> None:
    client, plant, _ = rig(Operating_Mode=0)
    client.write("Torque_Enable", 1)
    client.write("Goal_Current", 100)
    plant.advance(0.05)
    torque = 0.269 * 4.1 / 2.3
    # The loop sees the speed one step of 2 ms late: back-EMF * dt / inertia = 0.85 * 0.002 / 0.02 = 8.5 %.
    assert plant.shaft(1).torque == pytest.approx(torque, rel=0.09)
    assert client.read("Present_Current") == pytest.approx(100, abs=9)


def test_current_based_position_holds_with_the_goal_current() -> None:
    client, plant, _ = rig(Operating_Mode=5, Shutdown=0)
    plant.block(1, high=0.1)
    client.write("Torque_Enable", 1)
    client.write("Goal_Current", 200)
    client.write("Goal_Position", 4000)
    plant.advance(1.0)
    assert client.read("Present_Current") == 200


def test_homing_offset_shifts_what_the_bus_sees() -> None:
    client, plant, _ = rig(Homing_Offset=500)
    assert client.read("Present_Position") == 2548
    client.write("Torque_Enable", 1)
    client.write("Goal_Position", 2548)
    plant.advance(0.5)
    assert plant.shaft(1).angle == pytest.approx(0.0, abs=TICK)


def test_position_mode_starts_within_one_turn_and_extended_mode_counts() -> None:
    client, plant, _ = rig(Operating_Mode=4)
    client.write("Torque_Enable", 1)
    client.write("Goal_Position", 2048 + 2 * 4096)
    plant.advance(6.0)
    assert client.read("Present_Position") == pytest.approx(2048 + 2 * 4096, abs=1)
    client.write("Torque_Enable", 0)
    client.write("Operating_Mode", 3)
    assert client.read("Present_Position") == pytest.approx(2048, abs=1)

"""The simulated servo against the manual's promises, over the bus and on a world of ideal shafts."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest

from sim_backends.virtual_dynamixel import BusStream, Fault, ServoSpec, VirtualBus
from sim_backends.virtual_dynamixel.bench import IdealPlant
from sim_backends.virtual_dynamixel.models import MODELS, ServoModel
from sim_backends.virtual_dynamixel.registers import register_table

from .bus_client import ACCESS, DATA_LIMIT, DATA_RANGE, Client

TICK = 2 * math.pi / 4096


def rig(model: str = "XM430-W350", **settings: int) -> tuple[Client, IdealPlant, VirtualBus]:
    plant = IdealPlant([1])
    registers = tuple({"Return_Delay_Time": 0, **settings}.items())
    bus = VirtualBus(plant, [ServoSpec(1, model, registers)])
    stream = BusStream(bus)
    stream.open(1_000_000)
    return Client(stream), plant, bus


# --- registers ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda model: model.name)
def test_registers_do_not_overlap_and_start_within_their_range(model: ServoModel) -> None:
    taken: dict[int, str] = {}
    for register in register_table(model):
        for address in range(register.address, register.end):
            assert address not in taken, f"{register.name} overlaps {taken.get(address)}"
            taken[address] = register.name
        if register.low is not None and register.high is not None:
            assert register.low <= register.initial <= register.high or register.name == "Secondary_ID"


def test_the_table_agrees_with_the_published_facts(shared: Path) -> None:
    lines = (shared / "facts" / "x_series_control_table.yaml").read_text().splitlines()
    table = register_table(MODELS["XM540-W270"])
    known = {register.name.lower(): register for register in table}
    compared = 0
    for line in lines:
        name, _, rest = line.strip().partition(":")
        if not rest.strip().startswith("[") or not line.startswith("  "):
            continue
        fields = rest.strip()[1:].split(",")
        if name not in known or len(fields) < 4:
            continue
        address, size, access = int(fields[0]), int(fields[1]), fields[2].strip()
        register = known[name]
        assert (register.address, register.size) == (address, size), name
        assert register.access == access[0], name
        assert register.signed == access.endswith("s"), name
        compared += 1
    assert compared >= 50  # the facts list 56 rows, two of them per model


def test_factory_values_are_read_back() -> None:
    client, _, _ = rig()
    assert client.read("Model_Number") == 1020
    assert client.read("Position_P_Gain") == 800
    assert client.read("Goal_PWM") == 885
    assert client.read("Goal_Current") == 1193
    assert client.read("Temperature_Limit") == 80


def test_a_model_without_current_sensor_has_no_goal_current() -> None:
    client, _, _ = rig("XL430-W250")
    assert client.write_raw(102, struct.pack("<h", 100)) == ACCESS


def test_eeprom_is_locked_while_torque_is_on() -> None:
    client, _, _ = rig()
    assert client.write("Return_Delay_Time", 10) == 0
    client.write("Torque_Enable", 1)
    assert client.write("Return_Delay_Time", 20) == ACCESS
    assert client.read("Return_Delay_Time") == 10
    client.write("Torque_Enable", 0)
    assert client.write("Return_Delay_Time", 20) == 0


def test_read_only_registers_refuse_a_write() -> None:
    client, _, _ = rig()
    assert client.write("Present_Position", 0) == ACCESS


def test_ranges_and_limits_are_kept() -> None:
    client, _, _ = rig(Min_Position_Limit=1000, Max_Position_Limit=3000)
    assert client.write("PWM_Limit", 886) == DATA_RANGE
    assert client.write("Operating_Mode", 2) == DATA_RANGE
    client.write("PWM_Limit", 500)
    assert client.write("Goal_PWM", 501) == DATA_LIMIT
    assert client.write("Goal_PWM", -500) == 0
    client.write("Torque_Enable", 1)
    assert client.write("Goal_Position", 3001) == DATA_LIMIT
    assert client.write("Goal_Position", 3000) == 0


def test_nothing_of_a_write_is_stored_when_one_register_refuses() -> None:
    client, _, _ = rig(Max_Position_Limit=3000)
    client.write("Torque_Enable", 1)
    block = struct.pack("<iii", 20, 100, 3500)  # profile acceleration, profile velocity, goal position
    assert client.write_raw(108, block) == DATA_LIMIT
    assert client.read("Profile_Velocity") == 0


def test_part_of_a_register_is_a_length_error() -> None:
    client, _, _ = rig()
    assert client.write_raw(116, b"\x00\x08") == 5


# --- motion -------------------------------------------------------------------------------------------------


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


# --- watchdog, errors ---------------------------------------------------------------------------------------


@pytest.mark.safety("SR-25")
def test_the_bus_watchdog_stops_the_servo_and_refuses_goals_until_cleared() -> None:
    client, plant, _ = rig()
    client.write("Torque_Enable", 1)
    client.write("Profile_Velocity", 32)
    client.write("Bus_Watchdog", 10)  # 200 ms
    client.write("Goal_Position", 4000)
    plant.advance(0.19)
    assert client.read("Bus_Watchdog") == 10
    plant.advance(0.5)
    assert client.read("Bus_Watchdog") == -1
    stopped = client.read("Present_Position")
    # 500 ticks/s for 0.4 s: the profile stopped, the shaft swung back to where it was at that moment.
    assert 2200 < stopped < 2260
    plant.advance(0.5)
    assert client.read("Present_Position") == pytest.approx(stopped, abs=2)
    assert client.write("Goal_Position", 2100) == DATA_RANGE
    client.write("Bus_Watchdog", 0)
    assert client.write("Goal_Position", 2100) == 0


def test_the_bus_watchdog_rests_while_torque_is_off() -> None:
    client, plant, _ = rig()
    client.write("Bus_Watchdog", 1)
    plant.advance(1.0)
    assert client.read("Bus_Watchdog") == 1


def test_a_blocked_servo_overloads_shuts_down_and_needs_a_reboot() -> None:
    client, plant, _ = rig("XL430-W250")
    plant.block(1, high=0.2)
    client.write("Torque_Enable", 1)
    client.write("Profile_Velocity", 100)
    client.write("Goal_Position", 4000)
    plant.advance(1.0)
    assert client.read("Hardware_Error_Status") == 0
    plant.advance(2.5)
    assert client.read("Hardware_Error_Status") == 0x20
    assert client.last_error == 0x80
    assert client.read("Torque_Enable") == 0
    assert plant.shaft(1).torque == pytest.approx(0.0, abs=1e-9)
    assert client.write("Torque_Enable", 1) == 0x80 | ACCESS
    client.reboot()
    with pytest.raises(TimeoutError):
        client.read("Present_Position")
    plant.advance(0.4)
    assert client.read("Hardware_Error_Status") == 0
    assert client.last_error == 0
    assert client.read("Profile_Velocity") == 0
    assert client.write("Torque_Enable", 1) == 0


def test_a_gentle_grip_does_not_overload() -> None:
    client, plant, _ = rig("XL430-W250")
    plant.block(1, high=0.2)
    client.write("Torque_Enable", 1)
    client.write("Goal_PWM", 350)
    client.write("Goal_Position", 4000)
    plant.advance(10.0)
    assert client.read("Hardware_Error_Status") == 0


def test_undervoltage_alerts_but_shuts_down_only_where_shutdown_says_so() -> None:
    for model, torque in (("XM430-W350", 1), ("XL330-M288", 0)):
        client, plant, bus = rig(model)
        client.write("Torque_Enable", 1)
        bus.strike(Fault.UNDERVOLTAGE, 1)
        plant.advance(0.05)
        assert client.read("Hardware_Error_Status") & 1
        assert client.last_error == 0x80
        assert client.read("Torque_Enable") == torque


def test_a_hot_servo_shuts_down_and_again_until_it_has_cooled() -> None:
    client, plant, bus = rig()
    client.write("Torque_Enable", 1)
    bus.strike(Fault.OVERHEAT, 1)
    assert client.read("Torque_Enable") == 0
    assert client.read("Hardware_Error_Status") == 0x04
    assert client.read("Present_Temperature") > 80
    bus.heal()
    assert client.read("Hardware_Error_Status") == 0x04
    client.reboot()
    plant.advance(0.4)
    assert client.read("Hardware_Error_Status") == 0


# --- the rest of the table ----------------------------------------------------------------------------------


def test_indirect_data_mirror_what_they_map() -> None:
    client, _, _ = rig()
    for n, address in enumerate((132, 133, 134, 135, 146, 116, 117, 118, 119)):
        assert client.write(f"Indirect_Address_{n + 1}", address) == 0
    raw = client.read_raw(224, 5)
    assert struct.unpack("<iB", raw) == (2048, 30)
    client.write("Torque_Enable", 1)
    assert client.write_raw(229, struct.pack("<i", 2100)) == 0
    assert client.read("Goal_Position") == 2100


def test_xl330_has_its_indirect_data_elsewhere() -> None:
    client, _, _ = rig("XL330-M288")
    assert client.read("Indirect_Address_1") == 208


def test_a_shadow_obeys_but_never_answers() -> None:
    plant = IdealPlant([2, 3])
    quick = ("Return_Delay_Time", 0)
    main = ServoSpec(2, "XM430-W350", (quick,))
    shadow = ServoSpec(3, "XM430-W350", (quick, ("Secondary_ID", 2), ("Drive_Mode", 1)))
    bus = VirtualBus(plant, [main, shadow])
    stream = BusStream(bus)
    stream.open(1_000_000)
    client = Client(stream, servo_id=2)
    client.write("Torque_Enable", 1)
    client.write("Goal_Position", 2500)
    plant.advance(1.0)
    assert plant.shaft(2).angle == pytest.approx(-plant.shaft(3).angle, abs=1e-6)
    assert Client(stream, servo_id=3).read("Torque_Enable") == 1


def test_factory_reset_keeps_what_it_is_asked_to_keep() -> None:
    client, plant, bus = rig(Drive_Mode=1)
    client.instruct(0x06, b"\x02")
    plant.advance(0.4)
    assert client.read("Drive_Mode") == 0
    assert bus.servo_ids == [1]


def test_registered_writes_wait_for_the_action() -> None:
    client, plant, _ = rig()
    client.write("Torque_Enable", 1)
    assert client.instruct(0x04, struct.pack("<Hi", 116, 2500))[0] == 0
    assert client.read("Registered_Instruction") == 1
    plant.advance(0.5)
    assert client.read("Present_Position") == 2048
    client.broadcast(0x05)
    plant.advance(1.0)
    assert client.read("Present_Position") == 2500
    assert client.read("Registered_Instruction") == 0

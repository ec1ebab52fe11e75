"""The simulated servo's control table, against the manual's promises and the published facts."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from sim_backends.virtual_dynamixel import BusStream, ServoSpec, VirtualBus
from sim_backends.virtual_dynamixel.bench import IdealPlant
from sim_backends.virtual_dynamixel.models import MODELS, ServoModel
from sim_backends.virtual_dynamixel.registers import register_table

from .bus_client import ACCESS, DATA_LIMIT, DATA_RANGE, Client, rig


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

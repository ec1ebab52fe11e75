"""When the simulated servo stops by itself: its watchdog, overload, supply and heat, as the manual has them."""

from __future__ import annotations

import pytest

from sim_backends.virtual_dynamixel import Fault

from .bus_client import ACCESS, DATA_RANGE, rig


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

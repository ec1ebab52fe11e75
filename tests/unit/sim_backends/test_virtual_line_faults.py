"""What injected faults do to the answers of the simulated servos."""

from __future__ import annotations

import pytest

from sim_backends.virtual_dynamixel import Fault

from .bus_client import Client, crc, packet
from .wire import BYTE, IDS, drain, rig, sync_read


@pytest.mark.parametrize("fault", [Fault.DROP, Fault.CORRUPT, Fault.TRUNCATE, Fault.WRONG_ID, Fault.NOISE, Fault.LOST])
def test_a_fault_strikes_once_where_it_was_aimed(fault: Fault) -> None:
    bus, stream, _ = rig()
    good = packet(2, 0x01)
    stream.write(good)
    expected = drain(stream)
    bus.faults.once(fault, servo_id=None if fault is Fault.LOST else 2)
    stream.write(good)
    assert drain(stream) != expected
    stream.write(good)
    assert drain(stream) == expected
    assert bus.faults.counts[fault] == 1


@pytest.mark.parametrize("fault", [Fault.SILENT, Fault.REBOOT, Fault.OVERLOAD, Fault.UNDERVOLTAGE, Fault.OVERHEAT])
def test_a_fault_of_a_servo_shows_on_the_bus(fault: Fault) -> None:
    bus, stream, plant = rig()
    bus.faults.once(fault, servo_id=3)
    stream.write(packet(3, 0x01))
    drain(stream)
    plant.advance(0.05)
    stream.write(packet(3, 0x01))
    answer = drain(stream)
    if fault in (Fault.SILENT, Fault.REBOOT):
        assert answer == b""
    else:
        assert answer[8] == 0x80
    stream.write(packet(2, 0x01))
    assert drain(stream)[8] == 0


def test_servos_fail_at_a_rate() -> None:
    bus, stream, _ = rig(seed=3)
    bus.faults.set_rate(Fault.ENCODER, 0.05)
    for _ in range(200):
        stream.write(packet(1, 0x01))
        drain(stream, 0.001)
    # 200 draws at 5 %: standard deviation 3.1, so three of them.
    assert bus.faults.counts[Fault.ENCODER] == pytest.approx(10, abs=9.4)
    assert any(bus.servo(servo_id).alert for servo_id in IDS)


def test_two_servos_with_one_id_garble_each_other() -> None:
    _, stream, _ = rig()
    assert Client(stream, servo_id=2).write("ID", 1) == 0
    stream.write(packet(1, 0x01))
    answer = drain(stream)
    assert len(answer) == 14
    assert crc(answer[:-2]) != int.from_bytes(answer[-2:], "little")
    assert Client(stream, servo_id=3).read("ID") == 3


def test_a_delayed_answer_comes_whole_but_late() -> None:
    bus, stream, plant = rig()
    bus.faults.once(Fault.DELAY, 1)
    stream.write(packet(1, 0x01))
    start = plant.now()
    assert len(stream.read(100, 0.1)) == 14
    assert 24 * BYTE < plant.now() - start <= 24 * BYTE + 0.05


def test_rates_are_met_and_repeat_with_the_seed() -> None:
    def answers(seed: int) -> list[int]:
        bus, stream, _ = rig((1,), seed=seed)
        bus.faults.set_rate(Fault.DROP, 0.1)
        out = []
        for _ in range(1000):
            stream.write(packet(1, 0x01))
            out.append(len(stream.read(100, 0.001)))
        return out

    first = answers(1)
    assert first == answers(1)
    assert first != answers(2)
    # 1000 draws at 10 %: standard deviation 9.5, so five of them.
    assert first.count(0) == pytest.approx(100, abs=48)


def test_a_silent_servo_answers_again_when_healed() -> None:
    bus, stream, _ = rig()
    bus.strike(Fault.SILENT, 3)
    stream.write(sync_read())
    assert len(drain(stream)) == 42
    bus.heal()
    stream.write(sync_read())
    assert len(drain(stream)) == 105

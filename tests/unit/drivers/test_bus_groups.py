"""Reads and writes of several servos at once: what one of them does hides nothing of the others.

Numbers are those of the table in `test_bus`.
"""

from __future__ import annotations

import pytest

from drivers.arm import protocol
from drivers.arm.servos import TELEMETRY
from sim_backends.virtual_dynamixel.faults import Fault
from sim_backends.virtual_dynamixel.protocol import status_packet
from tests.unit.drivers.bench import scripted_bus, virtual_bus

POSITION = (132, 4)
FEEDBACK = 126, 10
IDS = [1, 2, 3, 4, 5]


@pytest.mark.parametrize("baud", [57_600, 1_000_000, 4_000_000])
@pytest.mark.parametrize("fast", [False, True])
def test_sync_read_of_all(baud: int, fast: bool) -> None:
    bus, _, plant = virtual_bus(5, baud)
    for servo_id in IDS:
        plant.place(servo_id, 0.1 * servo_id)
    assert bus.probe_fast(IDS, *POSITION)
    bus.fast = fast
    values = bus.sync_read_register(IDS, "Present_Position")
    assert values == {i: 2048 + round(0.1 * i * 4096 / 6.283185307) for i in IDS}
    assert bus.statistics.timeouts == 0


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("baud", [57_600, 1_000_000])
@pytest.mark.parametrize("missing", IDS)
def test_a_missing_servo_is_none_and_hides_no_other(missing: int, baud: int, fast: bool) -> None:
    """(6) The SDK fails the whole group and then reads 0. The issue allows 12 ms for the gap."""
    bus, bench, plant = virtual_bus(5, baud)
    bus.fast = fast
    began = plant.now()
    bus.sync_read(IDS, *FEEDBACK)
    usual = plant.now() - began
    bench.strike(Fault.SILENT, missing)
    for _ in range(9):
        began = plant.now()
        replies = bus.sync_read(IDS, *FEEDBACK)
        assert [servo_id for servo_id in IDS if replies[servo_id] is None] == [missing]
        assert plant.now() - began - usual <= 0.012


def test_two_missing_servos_hide_no_other() -> None:
    bus, bench, _ = virtual_bus(5)
    for servo_id in (1, 3):
        bench.strike(Fault.SILENT, servo_id)
    replies = bus.sync_read(IDS, *TELEMETRY)
    assert [servo_id for servo_id in IDS if replies[servo_id] is not None] == [2, 4, 5]


@pytest.mark.parametrize("fast", [False, True])
def test_group_reads_keep_every_alert(fast: bool) -> None:
    """(5) The SDK's group reads drop the error byte. (11) Its easy layer raises ValueError on an alert."""
    bus, bench, _ = virtual_bus(5)
    bus.fast = fast
    bench.strike(Fault.OVERLOAD, 3)
    replies = bus.sync_read(IDS, *TELEMETRY)
    assert [i for i in IDS if (reply := replies[i]) is not None and reply.alert] == [3]
    assert all(reply is not None and len(reply.data) == TELEMETRY[1] for reply in replies.values())


@pytest.mark.parametrize("fault", [Fault.DROP, Fault.CORRUPT, Fault.TRUNCATE, Fault.WRONG_ID])
@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.safety("SR-32")
def test_a_spoilt_answer_is_none_and_the_next_read_is_clean(fault: Fault, fast: bool) -> None:
    """(7) The SDK returns at once and collides with the answers still on the line. (8) Inner checksums count."""
    bus, bench, _ = virtual_bus(5)
    bus.fast = fast
    bench.faults.once(fault, None if fast else 2)
    replies = bus.sync_read(IDS, *TELEMETRY)
    assert sum(reply is None for reply in replies.values()) == 1
    assert None not in bus.sync_read(IDS, *TELEMETRY).values()


def test_noise_before_an_answer_does_not_spoil_it() -> None:
    bus, bench, _ = virtual_bus(5)
    bench.faults.once(Fault.NOISE, 2)
    assert None not in bus.sync_read(IDS, *TELEMETRY).values()
    assert bus.statistics.skipped_bytes > 0


def test_a_header_among_the_values_reaches_the_servo() -> None:
    """(2) The SDK sends it unstuffed, and a strict receiver drops the packet, in a sync write for all servos."""
    bus, bench, _ = virtual_bus(2)
    # Servo 253 does not exist; its ID behind the bytes of -1 makes the header FF FF FD.
    bus.sync_write("Homing_Offset", {1: -1, 253: 0, 2: 7})
    assert bench.servo(1).table.get("Homing_Offset") == -1
    assert bench.servo(2).table.get("Homing_Offset") == 7


@pytest.mark.safety("SR-32")
def test_two_answers_under_one_id_are_none() -> None:
    """Nobody can say which of the two is the servo that was meant."""

    def answer(packet: bytes) -> list[tuple[float, bytes]]:
        ids = packet[12:-2]
        return [(0.001, status_packet(2 if servo_id == 1 else servo_id, 0, bytes(4))) for servo_id in ids]

    bus, _ = scripted_bus(answer)
    replies = bus.sync_read([1, 2, 3], *POSITION)
    assert replies[1] is None
    assert replies[3] is not None


def test_fast_read_is_given_up_when_it_keeps_failing() -> None:
    bus, bench, _ = virtual_bus(5)
    assert bus.probe_fast(IDS, *TELEMETRY)
    for _ in range(3):
        bench.faults.once(Fault.CORRUPT)
        bus.sync_read(IDS, *TELEMETRY)
    # One plain read shows that the servos themselves are well.
    assert None not in bus.sync_read(IDS, *TELEMETRY).values()
    assert not bus.fast
    assert bus.statistics.fast_fallbacks == 1
    assert None not in bus.sync_read(IDS, *TELEMETRY).values()


def test_fast_read_is_kept_while_a_servo_is_silent_either_way() -> None:
    bus, bench, _ = virtual_bus(5)
    assert bus.probe_fast(IDS, *TELEMETRY)
    bench.strike(Fault.SILENT, 4)
    for _ in range(10):
        assert [i for i, reply in bus.sync_read(IDS, *TELEMETRY).items() if reply is None] == [4]
    assert bus.fast


def test_firmware_without_fast_read_is_found_out_once() -> None:
    def answer(packet: bytes) -> list[tuple[float, bytes]]:
        if packet[7] != protocol.SYNC_READ:
            return []
        return [(0.001, status_packet(servo_id, 0, bytes(packet[10]))) for servo_id in packet[12:-2]]

    bus, _ = scripted_bus(answer)
    assert not bus.probe_fast(IDS, *TELEMETRY)
    assert None not in bus.sync_read(IDS, *TELEMETRY).values()


def test_an_unanswered_write_is_on_the_wire_before_the_deadline_starts() -> None:
    """At 57 600 bit/s a sync write takes longer than the latency margin."""
    bus, _, _ = virtual_bus(5, 57_600)
    for _ in range(3):
        bus.sync_write("Goal_Position", dict.fromkeys(IDS, 2048))
    assert None not in bus.sync_read(IDS, *TELEMETRY).values()

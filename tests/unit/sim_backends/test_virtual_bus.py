"""The wire: who answers, when, and what garbage does (nothing)."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from controller.errors import BusError
from controller.ports import ByteStream
from sim_backends.virtual_dynamixel import BusStream, Fault, ServoSpec, VirtualBus
from sim_backends.virtual_dynamixel.bench import IdealPlant
from sim_backends.virtual_dynamixel.protocol import InstructionParser, crc16, status_packet, stuff, unstuff

from .bus_client import Client, crc, packet
from .wire import BYTE, IDS, drain, rig, sync_read

# --- golden bytes -------------------------------------------------------------------------------------------


def test_crc_of_the_published_check_string() -> None:
    assert crc16(b"123456789") == 0xFEE8


def test_manual_examples_are_understood_and_answered() -> None:
    # Source: e-Manual, Protocol 2.0, "Ping" and "Read": ID 1 is an XM430-W210 with firmware 38 there.
    parser = InstructionParser()
    (ping,) = parser.feed(bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e"))
    assert (ping.servo_id, ping.instruction, ping.params) == (1, 1, b"")
    (read,) = parser.feed(bytes.fromhex("ff ff fd 00 01 07 00 02 84 00 04 00 1d 15"))
    assert (read.instruction, read.params) == (2, bytes.fromhex("84 00 04 00"))
    pong = bytes.fromhex("ff ff fd 00 01 07 00 55 00 06 04 26 65 5d")
    assert status_packet(1, 0, bytes.fromhex("06 04 26")) == pong
    answer = bytes.fromhex("ff ff fd 00 01 08 00 55 00 a6 00 00 00 8c c0")
    assert status_packet(1, 0, bytes.fromhex("a6 00 00 00")) == answer


# --- properties of the codec --------------------------------------------------------------------------------

pieces = [b"\xff", b"\xff\xff\xfd", b"\xff\xff\xfd\xfd", b"\xff\xff\xfd\x00", b"\x00", b"\x55"]
awkward = st.binary(max_size=40) | st.lists(st.sampled_from(pieces), max_size=12).map(b"".join)
chunk = st.binary(max_size=60) | st.builds(packet, st.integers(0, 255), st.integers(0, 255), awkward)


@given(awkward)
def test_stuffing_hides_every_header_and_is_undone(body: bytes) -> None:
    stuffed = stuff(body)
    assert b"\xff\xff\xfd\x00" not in stuffed
    assert unstuff(stuffed) == body


@given(awkward, st.integers(0, 252), awkward, st.data())
def test_packets_are_found_behind_garbage_and_across_cuts(
    noise: bytes, servo_id: int, params: bytes, data: st.DataObject
) -> None:
    stream = noise + packet(servo_id, 0x03, params)
    # A false header may promise a packet long enough to swallow the true one.
    assume(stream.find(b"\xff\xff\xfd\x00") == len(noise))
    cut = data.draw(st.integers(0, len(stream)))
    parser = InstructionParser()
    found = parser.feed(stream[:cut]) + parser.feed(stream[cut:])
    assert (servo_id, 0x03, params) in [(p.servo_id, p.instruction, p.params) for p in found]


@given(st.integers(0, 252), st.binary(max_size=30), st.data())
def test_a_damaged_packet_is_not_understood(servo_id: int, params: bytes, data: st.DataObject) -> None:
    raw = bytearray(packet(servo_id, 0x03, params))
    index = data.draw(st.integers(4, len(raw) - 1))
    raw[index] ^= data.draw(st.integers(1, 255))
    for found in InstructionParser().feed(bytes(raw)):
        assert (found.servo_id, found.params) != (servo_id, params)


@settings(max_examples=300)
@given(st.lists(chunk, max_size=8))
def test_no_bytes_make_the_bus_fail(chunks: list[bytes]) -> None:
    bus, _, plant = rig()
    for chunk in chunks:
        for arrival, data in bus.handle(chunk, plant.now()):
            assert arrival > plant.now()
            assert data[:4] == b"\xff\xff\xfd\x00"
        plant.advance(0.01)


def test_an_unfinished_packet_is_forgotten_after_a_silence() -> None:
    _, stream, plant = rig()
    stream.write(packet(1, 0x01)[:7])
    plant.advance(0.2)
    stream.write(packet(2, 0x01))
    assert drain(stream)[4] == 2


# --- time ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("baud", "delay"), [(1_000_000, 0), (57_600, 0), (1_000_000, 250)])
def test_a_sync_read_takes_its_wire_time(baud: int, delay: int) -> None:
    _, stream, plant = rig(delay=delay, baud=baud)
    stream.close()
    stream.open(baud)
    request = sync_read()
    start = plant.now()
    stream.write(request)
    answer = b"".join(stream.read(4096, 0.1) for _ in IDS)
    assert len(answer) == 5 * 21
    expected = (len(request) + len(answer)) * 10 / baud + 5 * delay * 2e-6
    assert plant.now() - start == pytest.approx(expected, abs=1e-9)


def test_a_fast_sync_read_pays_the_return_delay_once() -> None:
    _, stream, plant = rig(delay=250)
    request = sync_read(fast=True)
    start = plant.now()
    stream.write(request)
    answer = b"".join(stream.read(4096, 0.1) for _ in range(2))  # handed over 62 bytes at a time
    assert len(answer) == 8 + 5 * 14
    assert plant.now() - start == pytest.approx((len(request) + len(answer)) * BYTE + 500e-6, abs=1e-9)


def test_the_latency_timer_hands_over_only_at_its_ticks() -> None:
    _, stream, plant = rig(latency_timer_ms=16)
    stream.write(sync_read())
    assert len(stream.read(4096, 0.1)) == 105
    assert plant.now() == pytest.approx(0.016)


def test_writes_queue_behind_each_other_on_the_wire() -> None:
    _, stream, plant = rig()
    silent = packet(0xFE, 0x83, struct.pack("<HHBi", 116, 4, 1, 2048))
    stream.write(silent)
    stream.write(packet(1, 0x01))
    stream.read(4096, 0.1)
    assert plant.now() == pytest.approx((len(silent) + 10 + 14) * BYTE, abs=1e-9)


def test_an_instruction_sent_into_an_answer_is_lost() -> None:
    _, stream, plant = rig()
    stream.write(sync_read())
    plant.advance(40 * BYTE)
    stream.write(packet(1, 0x01))
    assert len(drain(stream)) == 105


# --- who answers --------------------------------------------------------------------------------------------


def test_servos_behind_a_missing_one_stay_silent() -> None:
    _, stream, _ = rig()
    stream.write(sync_read((1, 2, 9, 3)))
    answer = drain(stream)
    assert (len(answer), answer[4], answer[25]) == (42, 1, 2)
    stream.write(sync_read((1, 9, 3), fast=True))
    answer = drain(stream)
    assert answer[5:7] == (1 + 3 * 14).to_bytes(2, "little")
    assert len(answer) == 8 + 14


def test_fast_reads_carry_cumulative_checksums_and_no_stuffing() -> None:
    _, stream, _ = rig((1, 2))
    client = Client(stream, servo_id=2)
    client.write("Goal_PWM", -1)
    client.write("Goal_Current", 253)
    stream.write(packet(0xFE, 0x8A, struct.pack("<HH", 100, 4) + b"\x01\x02"))
    answer = drain(stream)
    assert len(answer) == 8 + 2 * 8
    assert crc(answer[:14]) == int.from_bytes(answer[14:16], "little")
    assert crc(answer[:-2]) == int.from_bytes(answer[-2:], "little")
    assert answer[16:22] == b"\x00\x02\xff\xff\xfd\x00"


def test_answers_are_stuffed() -> None:
    _, stream, _ = rig()
    client = Client(stream)
    assert client.write_raw(100, b"\xff\xff\xfd\x00") == 0
    assert client.read_raw(100, 4) == b"\xff\xff\xfd\x00"


def test_a_wrong_baud_rate_is_answered_with_silence() -> None:
    _, stream, _ = rig()
    stream.close()
    stream.open(57_600)
    stream.write(packet(1, 0x01))
    assert drain(stream) == b""


def test_a_new_baud_rate_counts_after_the_answer() -> None:
    _, stream, _ = rig()
    client = Client(stream)
    assert client.write("Baud_Rate", 1) == 0
    with pytest.raises(TimeoutError):
        client.read("ID")
    stream.close()
    stream.open(57_600)
    assert client.read("ID") == 1


def test_the_status_return_level_is_obeyed() -> None:
    _, stream, _ = rig()
    client = Client(stream)
    client.write("Status_Return_Level", 1)
    with pytest.raises(TimeoutError):
        client.write("LED", 1)
    assert client.read("LED") == 1


def test_everyone_answers_a_broadcast_ping_in_order() -> None:
    _, stream, _ = rig((3, 1, 2))
    stream.write(packet(0xFE, 0x01))
    answer = drain(stream, 0.1)
    assert [answer[n + 4] for n in (0, 14, 28)] == [1, 2, 3]


def test_bulk_instructions_reach_different_registers() -> None:
    _, stream, _ = rig()
    write = struct.pack("<BHHB", 1, 65, 1, 1) + struct.pack("<BHHi", 2, 112, 4, 77)
    stream.write(packet(0xFE, 0x93, write))
    stream.write(packet(0xFE, 0x92, struct.pack("<BHHBHH", 1, 65, 1, 2, 112, 4)))
    answer = drain(stream)
    assert answer[9] == 1
    assert int.from_bytes(answer[12 + 9 : 12 + 13], "little") == 77
    stream.write(packet(0xFE, 0x9A, struct.pack("<BHHBHH", 1, 65, 1, 2, 112, 4)))
    answer = drain(stream)
    assert len(answer) == 8 + 5 + 8
    assert answer[10] == 1
    assert answer[15:19] == (77).to_bytes(4, "little")


# --- the stream -------------------------------------------------------------------------------------------


def test_an_unplugged_adapter_is_a_typed_error_and_can_be_reopened() -> None:
    bus, stream, _ = rig()
    bus.strike(Fault.DISCONNECT)
    with pytest.raises(BusError, match="unplugged") as caught:
        stream.write(b"x")
    assert caught.value.code == "lost"
    with pytest.raises(BusError, match="unplugged"):
        stream.read(1, 0.01)
    with pytest.raises(BusError, match="unplugged"):
        stream.discard_input()
    stream.close()
    with pytest.raises(BusError, match="unplugged"):
        stream.open(1_000_000)
    bus.heal()
    stream.open(1_000_000)
    assert Client(stream).read("ID") == 1


def test_the_stream_is_a_byte_stream_and_exclusive() -> None:
    _, stream, _ = rig()
    assert isinstance(stream, ByteStream)
    with pytest.raises(BusError) as caught:
        stream.open(1_000_000)
    assert caught.value.code == "busy"
    stream.close()
    with pytest.raises(BusError) as caught:
        stream.open(1234)
    assert caught.value.code == "refused"


class CoarsePlant(IdealPlant):
    """Tells the time in whole steps of 2 ms, like a physics engine."""

    def now(self) -> float:
        return math.floor(super().now() / 0.002 + 1e-9) * 0.002


def test_a_coarse_plant_still_has_a_fine_wire() -> None:
    plant = CoarsePlant(IDS)
    bus = VirtualBus(plant, [ServoSpec(servo_id, "XM430-W350", (("Return_Delay_Time", 0),)) for servo_id in IDS])
    stream = BusStream(bus)
    stream.open(1_000_000)
    for _ in range(50):
        stream.write(sync_read())
        assert len(b"".join(stream.read(4096, 0.01) for _ in IDS)) == 105
    # 50 requests of 19 and answers of 105 bytes; the plant has seen all whole steps in it.
    assert IdealPlant.now(plant) == pytest.approx(50 * 124 * BYTE, abs=1e-6)


def test_reading_nothing_takes_exactly_the_timeout() -> None:
    _, stream, plant = rig()
    assert stream.read(10, 0.0123) == b""
    assert plant.now() == pytest.approx(0.0123)

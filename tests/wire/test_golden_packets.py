"""Bytes as they are on the wire, from the manual's own examples, and against the SDK's arithmetic."""

from __future__ import annotations

import pytest
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from drivers.arm import protocol
from drivers.arm.protocol import StatusParser, crc16, fast_blocks, instruction_packet
from sim_backends.virtual_dynamixel.protocol import InstructionParser, status_packet


def _hex(text: str) -> bytes:
    return bytes.fromhex(text)


# Source: ROBOTIS e-Manual, dxl/protocol2, the examples of section "Instruction Details".
INSTRUCTIONS = {
    "ping 1": (1, protocol.PING, "", "FF FF FD 00 01 03 00 01 19 4E"),
    "ping all": (254, protocol.PING, "", "FF FF FD 00 FE 03 00 01 31 42"),
    "read Present_Position": (1, protocol.READ, "84 00 04 00", "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    "write Goal_Position 512": (
        1, protocol.WRITE, "74 00 00 02 00 00", "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89",
    ),
    "reboot 1": (1, protocol.REBOOT, "", "FF FF FD 00 01 03 00 08 2F 4E"),
    "sync read": (
        254, protocol.SYNC_READ, "84 00 04 00 01 02", "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
    ),
    "sync write": (
        254, protocol.SYNC_WRITE, "74 00 04 00 01 96 00 00 00 02 AA 00 00 00",
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
}  # fmt: skip

STATUSES = {
    "ping, model 1030": ("FF FF FD 00 01 07 00 55 00 06 04 26 65 5D", 1, 0, "06 04 26"),
    "ping, servo 2": ("FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D", 2, 0, "06 04 26"),
    "Present_Position 166": ("FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0", 1, 0, "A6 00 00 00"),
    "Present_Position 2079": ("FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE", 2, 0, "1F 08 00 00"),
    "written": ("FF FF FD 00 01 04 00 55 00 A1 0C", 1, 0, ""),
}


def test_crc_check_value() -> None:
    assert crc16(b"123456789") == 0xFEE8


@given(st.binary(max_size=300))
def test_crc_equals_the_sdks(data: bytes) -> None:
    assert crc16(data) == Protocol2PacketHandler().updateCRC(0, data, len(data))


@pytest.mark.parametrize("example", INSTRUCTIONS)
def test_instruction_examples(example: str) -> None:
    servo_id, instruction, parameters, packet = INSTRUCTIONS[example]
    assert instruction_packet(servo_id, instruction, _hex(parameters)) == _hex(packet)


@pytest.mark.parametrize("example", STATUSES)
def test_status_examples(example: str) -> None:
    packet, servo_id, error, data = STATUSES[example]
    (status,) = StatusParser(20).feed(_hex(packet))
    assert (status.servo_id, status.error, status.data) == (servo_id, error, _hex(data))


def test_header_in_the_parameters_is_stuffed() -> None:
    # Goal_Current -1 and Goal_Velocity 253, which the SDK sends as a header in mid-packet.
    packet = instruction_packet(1, protocol.WRITE, _hex("66 00 FF FF FD 00 00 00"))
    assert packet[:-2] == _hex("FF FF FD 00 01 0C 00 03 66 00 FF FF FD FD 00 00 00")
    assert crc16(packet[:-2]).to_bytes(2, "little") == packet[-2:]


# Payloads rich in the bytes that make up a header.
_TRICKY = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55, 0x7F]), max_size=40).map(bytes)


@given(st.integers(0, 252), st.integers(0, 0xFF), _TRICKY)
def test_statuses_of_the_simulated_bus_are_understood(servo_id: int, error: int, data: bytes) -> None:
    (status,) = StatusParser(80).feed(status_packet(servo_id, error, data))
    assert (status.servo_id, status.error, status.data) == (servo_id, error, data)


@given(st.integers(0, 252), _TRICKY)
def test_the_simulated_bus_understands_our_instructions(servo_id: int, parameters: bytes) -> None:
    (packet,) = InstructionParser().feed(instruction_packet(servo_id, protocol.WRITE, parameters))
    assert (packet.servo_id, packet.instruction, packet.params) == (servo_id, protocol.WRITE, parameters)


def _fast_packet(blocks: list[tuple[int, int, bytes]], announced: int | None = None) -> bytes:
    """A fast sync read's reply, built from the manual's description alone, bit by bit."""
    size = len(blocks[0][2])
    length = 1 + (announced or len(blocks)) * (size + 4)
    raw = _hex("FF FF FD 00 FE") + length.to_bytes(2, "little") + b"\x55"
    for servo_id, error, data in blocks:
        raw += bytes((error, servo_id)) + data
        crc = 0
        for byte in raw:
            for bit in range(7, -1, -1):
                top = crc >> 15 ^ byte >> bit & 1
                crc = (crc << 1 & 0xFFFF) ^ (0x8005 if top else 0)
        raw += crc.to_bytes(2, "little")
    return raw


@given(st.lists(st.tuples(st.integers(0, 252), st.integers(0, 255), st.binary(min_size=4, max_size=4)), min_size=1))
def test_fast_sync_read_blocks(blocks: list[tuple[int, int, bytes]]) -> None:
    found = fast_blocks(_fast_packet(blocks), 4)
    assert [(s.servo_id, s.error, s.data) for s in found] == blocks


def test_fast_sync_read_keeps_what_precedes_a_broken_block() -> None:
    packet = bytearray(_fast_packet([(1, 0, b"abcd"), (2, 0x80, b"efgh"), (3, 0, b"ijkl")]))
    packet[8 + 8 + 3] ^= 0x10
    assert [s.servo_id for s in fast_blocks(bytes(packet), 4)] == [1]
    cut = _fast_packet([(1, 0, b"abcd"), (2, 0, b"efgh")], announced=3)
    assert [s.servo_id for s in fast_blocks(cut, 4)] == [1, 2]

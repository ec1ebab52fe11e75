"""The parser against anything a line can deliver."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.arm.control_table import HARDWARE_ERRORS, MODELS, REGISTERS, hardware_error_text
from drivers.arm.protocol import ALERT, Status, StatusParser, crc16, error_text, fast_blocks, instruction_packet
from sim_backends.virtual_dynamixel.models import MODELS as SIMULATED_MODELS
from sim_backends.virtual_dynamixel.protocol import status_packet
from sim_backends.virtual_dynamixel.registers import register_table

LONGEST = 60

# Garbage that looks like packets: headers, plausible IDs and lengths among random bytes.
_PIECES = st.one_of(
    st.binary(max_size=12),
    st.sampled_from([b"\xff\xff\xfd\x00", b"\xff\xff\xfd", b"\xff", b"\xff\xff\xfd\x00\x01\x08\x00\x55"]),
)
_GARBAGE = st.lists(_PIECES, max_size=12).map(b"".join)
_STATUS = st.builds(Status, st.integers(0, 252), st.integers(0, 255), st.binary(max_size=25))


def _packet(status: Status) -> bytes:
    return status_packet(status.servo_id, status.error, status.data)


def _parse(chunks: list[bytes]) -> list[Status]:
    parser = StatusParser(LONGEST)
    found = [status for chunk in chunks for status in parser.feed(chunk)]
    return found + parser.flush()


@given(_GARBAGE)
def test_whatever_is_found_has_a_right_checksum(data: bytes) -> None:
    for status in _parse([data]):
        # The packet found must be somewhere in the bytes, whole, with the checksum it would be sent with.
        assert _packet(status) in data


@given(st.lists(st.one_of(_GARBAGE, _STATUS.map(_packet)), max_size=6), st.data())
def test_cutting_the_stream_differently_changes_nothing(parts: list[bytes], draw: st.DataObject) -> None:
    data = b"".join(parts)
    cuts = sorted(draw.draw(st.lists(st.integers(0, len(data)), max_size=8)))
    chunks = [data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]
    assert _parse(chunks) == _parse([data])


@given(_GARBAGE, _STATUS)
@example(b"\xff\xff\xfd\x00\x01\x30\x00\x55", Status(1, 0, b"abcd"))  # a header that swallows the packet behind it
@example(b"\xff\xff\xfd", Status(1, 0, b""))
def test_a_good_packet_behind_garbage_is_found(garbage: bytes, status: Status) -> None:
    assert status in _parse([garbage + _packet(status)])


@given(_STATUS, st.data())
@pytest.mark.safety("SR-32")
def test_a_damaged_packet_is_no_packet(status: Status, draw: st.DataObject) -> None:
    packet = bytearray(_packet(status))
    index = draw.draw(st.integers(0, len(packet) - 1))
    packet[index] ^= draw.draw(st.integers(1, 255))  # a burst of at most eight bits: a CRC-16 finds every one
    assert status not in _parse([bytes(packet)])


@given(_STATUS, st.integers(1, 10))
@pytest.mark.safety("SR-32")
def test_a_truncated_packet_is_no_packet(status: Status, lost: int) -> None:
    assert _parse([_packet(status)[:-lost]]) == []


def test_echo_of_the_instruction_is_passed_over() -> None:
    echo = instruction_packet(1, 0x02, b"\x84\x00\x04\x00")
    assert _parse([echo + status_packet(1, 0, b"abcd")]) == [Status(1, 0, b"abcd")]


@given(st.binary(max_size=80), st.integers(0, 30))
def test_fast_blocks_never_raise_and_never_invent(data: bytes, size: int) -> None:
    for block in fast_blocks(data, size):
        assert len(block.data) == size
        assert bytes((block.error, block.servo_id)) + block.data in data


def test_resynchronisation_is_counted() -> None:
    parser = StatusParser(LONGEST)
    broken = bytearray(status_packet(1, 0, b"abcd"))
    broken[-1] ^= 1
    assert parser.feed(bytes(broken) + status_packet(2, 0, b"")) == [Status(2, 0, b"")]
    assert parser.bad_checksums == 1
    assert parser.skipped == len(broken)


def test_error_words_are_the_sdks() -> None:
    assert error_text(0x04) == "The data value is out of range"
    assert error_text(ALERT) == ""
    assert error_text(ALERT | 0x07) == error_text(0x07) != ""


def test_registers_agree_with_the_simulated_servos() -> None:
    """Two tables typed in apart from each other."""
    table = register_table(SIMULATED_MODELS["XM430-W350"])
    for name, register in REGISTERS.items():
        other = table["Present_Current" if name == "Present_Load" else name]
        assert (register.address, register.size, register.signed) == (other.address, other.size, other.signed), name


def test_models_agree_with_the_simulated_servos() -> None:
    for name, model in MODELS.items():
        other = SIMULATED_MODELS.get(name)
        if other is not None:
            told = other.number, other.shutdown, other.position_gains
            assert (model.number, model.shutdown, model.position_gains) == told


def test_every_hardware_error_has_words() -> None:
    for bit in HARDWARE_ERRORS:
        cause, remedy = hardware_error_text(1 << bit)
        assert cause
        assert remedy
    assert hardware_error_text(0x24)[0] == "overheated, overloaded for too long"
    assert "0x40" in hardware_error_text(0x40)[0]


def test_crc_continues() -> None:
    assert crc16(b"6789", crc16(b"12345")) == crc16(b"123456789")

"""The servos' side of DYNAMIXEL Protocol 2.0: finding instruction packets in bytes, building status packets.

Strict on purpose: what a real servo would not understand is not understood here either.

Source: ROBOTIS e-Manual, `dxl/protocol2` (packet layout, byte stuffing, CRC-16 with polynomial 0x8005).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cache

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
STATUS = 0x55
ALERT = 0x80
"""Bit of a status packet's error byte: Hardware_Error_Status is not zero."""

MAX_LENGTH = 1024
"""Longest LEN field a servo waits for. Assumption: a larger one is taken for noise."""


class Instruction(IntEnum):
    """Instruction codes."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class Fail(IntEnum):
    """Error numbers of a status packet."""

    NONE = 0
    RESULT = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


@dataclass(frozen=True, slots=True)
class Packet:
    """One valid instruction packet, stuffing removed.

    Attributes:
        servo_id: Address, 0..252 or BROADCAST.
        instruction: Instruction code, known or not.
        params: Parameters.
        end: Number of bytes of the fed data up to and including the packet's last one.
    """

    servo_id: int
    instruction: int
    params: bytes
    end: int


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1) ^ 0x8005 if value & 0x8000 else value << 1
        table.append(value & 0xFFFF)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes, crc: int = 0) -> int:
    """CRC-16 of `data` (polynomial 0x8005, not reflected), continued from `crc`; b"123456789" gives 0xFEE8."""
    table = _CRC_TABLE
    for byte in data:
        crc = ((crc << 8) & 0xFF00) ^ table[crc >> 8 ^ byte]
    return crc


def stuff(body: bytes) -> bytes:
    """Byte stuffing: FF FF FD within a packet's body is followed by one more FD."""
    return body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd") if b"\xff\xff\xfd" in body else body


def unstuff(body: bytes) -> bytes | None:
    """The body without its stuffing, or None when it holds a header that is not stuffed."""
    if b"\xff\xff\xfd" not in body:
        return body
    plain = body.replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
    return plain if stuff(plain) == body else None


@cache
def _prefix(servo_id: int, length: int) -> tuple[bytes, int]:
    head = HEADER + bytes((servo_id, length & 0xFF, length >> 8, STATUS))
    return head, crc16(head)


def status_packet(servo_id: int, error: int, data: bytes = b"") -> bytes:
    """A status packet ready for the wire."""
    body = bytes((error,)) + data
    if b"\xff\xff\xfd" in body:
        body = stuff(body)
    head, crc = _prefix(servo_id, len(body) + 3)
    return head + body + crc16(body, crc).to_bytes(2, "little")


def fast_status_head(total_length: int) -> bytes:
    """First bytes of the one reply to a fast read; `total_length` is its LEN field."""
    return HEADER + bytes((BROADCAST, total_length & 0xFF, total_length >> 8, STATUS))


class InstructionParser:
    """Cuts a byte stream into instruction packets; never raises, whatever it is fed.

    Assumption: packets with a wrong CRC are ignored (no status packet with error 3), as are packets whose
    body holds an unstuffed header; the search goes on behind the false header. Status packets on the line
    (INST 0x55) are skipped.
    """

    def __init__(self) -> None:
        self._held = b""

    def reset(self) -> None:
        """Forget a packet begun but not finished."""
        self._held = b""

    @property
    def pending(self) -> bool:
        """A packet has begun but not ended."""
        return bool(self._held)

    def feed(self, data: bytes) -> list[Packet]:
        """The packets completed by `data`."""
        carried = len(self._held)
        if carried:
            data = self._held + data
        packets: list[Packet] = []
        start = 0
        size = len(data)
        while True:
            start = data.find(HEADER, start)
            if start < 0:
                # Keep what could be the first bytes of a header.
                tail = next((n for n in (3, 2, 1) if data.endswith(HEADER[:n])), 0)
                self._held = data[size - tail :] if tail else b""
                return packets
            if size - start < 7:
                break
            length = data[start + 5] | data[start + 6] << 8
            end = start + 7 + length
            if not 3 <= length <= MAX_LENGTH:
                start += 1
                continue
            if end > size:
                break
            body = data[start + 7 : end - 2]
            sound = crc16(data[start : end - 2]) == data[end - 2] | data[end - 1] << 8
            plain = unstuff(body) if sound else None
            if plain is None:
                start += 1
                continue
            if plain[0] != STATUS:
                packets.append(Packet(data[start + 4], plain[0], plain[1:], end - carried))
            start = end
        self._held = data[start:]
        return packets

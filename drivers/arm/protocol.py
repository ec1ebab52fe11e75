"""Protocol 2.0 as pure functions: bytes to packets and back, no port and no time.

Own framing in place of the one in `dynamixel_sdk.Protocol2PacketHandler`, whose `txPacket` sends headers in
the parameters unstuffed (a strict receiver then drops the packet), whose `removeStuffing` can lose a byte, and
whose read functions take the bytes of the checksum for data when a status carries an error only. Instruction
numbers and the wording of errors are the SDK's, and the tests compare the rest with it.

Source: ROBOTIS e-Manual, `dxl/protocol2`, sections "Packet Details", "Status Packet", "Fast Sync Read" and the
page `dxl/crc`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from dynamixel_sdk import robotis_def
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler

PING: int = robotis_def.INST_PING
READ: int = robotis_def.INST_READ
WRITE: int = robotis_def.INST_WRITE
REBOOT: int = robotis_def.INST_REBOOT
SYNC_READ: int = robotis_def.INST_SYNC_READ
FAST_SYNC_READ: int = robotis_def.INST_FAST_SYNC_READ
SYNC_WRITE: int = robotis_def.INST_SYNC_WRITE
BROADCAST: int = robotis_def.BROADCAST_ID
STATUS: int = robotis_def.INST_STATUS

ALERT = 0x80
"""Error bit: Hardware_Error_Status is not zero; the reply itself is good."""

STATUS_OVERHEAD = 11
"""Bytes of a status packet around its data: header 4, ID, length 2, instruction, error, checksum 2."""

_HEADER = b"\xff\xff\xfd\x00"
_PATTERN, _STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"
_PREFIX = 7  # header, ID, length


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC = _crc_table()


def crc16(data: bytes, crc: int = 0) -> int:
    """Checksum of `data` continued from `crc`: polynomial 0x8005, start 0, not reflected.

    Source: e-Manual, `dxl/crc`; "123456789" gives 0xFEE8.
    """
    table = _CRC
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ byte]
    return crc


@lru_cache(maxsize=128)  # a control loop asks the same question every cycle
def instruction_packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Complete instruction packet, stuffed and with its checksum."""
    body = (bytes((instruction,)) + parameters).replace(_PATTERN, _STUFFED)
    packet = _HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


def error_text(error: int) -> str:
    """What the low seven bits of an error byte say, in the SDK's words; empty for none."""
    code = error & ~ALERT
    text: str = Protocol2PacketHandler().getRxPacketError(code) if code else ""
    return text.removeprefix("[RxPacketError] ").rstrip("!")


class Status(NamedTuple):
    """One status packet whose checksum is right.

    Attributes:
        servo_id: Who answers.
        error: The error byte, alert bit included.
        data: Parameters after the error byte, stuffing removed.
    """

    servo_id: int
    error: int
    data: bytes


class StatusParser:
    """Finds status packets in a stream of bytes; anything else is skipped and counted.

    A packet that turns out wrong costs one byte only: the search goes on right behind its first byte, so that a
    good packet inside a false one is still found. Packets that are not status packets (an adapter's echo of the
    instruction) are passed over.

    Args:
        longest: Largest value of the length field to believe; a larger one is noise, and is not waited for.
    """

    def __init__(self, longest: int) -> None:
        self._buffer = bytearray()
        self._longest = longest
        self.bad_checksums = 0
        self.skipped = 0

    def feed(self, data: bytes) -> list[Status]:
        """Packets completed by `data`, in order."""
        self._buffer += data
        return self._scan(wait=True)

    def flush(self) -> list[Status]:
        """Packets behind one that will never be completed; call when no more bytes are expected."""
        return self._scan(wait=False)

    def _scan(self, wait: bool) -> list[Status]:
        found: list[Status] = []
        buffer = self._buffer
        while True:
            start = buffer.find(_HEADER)
            if start < 0:
                # A header may have begun at the very end.
                self._skip(max(0, len(buffer) - (len(_HEADER) - 1)) if wait else len(buffer))
                return found
            self._skip(start)
            if len(buffer) < _PREFIX:
                if not wait:
                    self._skip(1)
                    continue
                return found
            length = buffer[5] | buffer[6] << 8
            end = _PREFIX + length
            if not 3 <= length <= self._longest:
                self._skip(1)
                continue
            if len(buffer) < end:
                if not wait:
                    self._skip(1)
                    continue
                return found
            packet = bytes(buffer[:end])
            if crc16(packet[:-2]) != packet[-2] | packet[-1] << 8:
                self.bad_checksums += 1
                self._skip(1)
                continue
            del buffer[:end]
            # An instruction has another number in this place and no error byte; a status is at least 4 long.
            if packet[_PREFIX] == STATUS and length >= 4:
                body = packet[_PREFIX + 1 : -2]
                if packet[4] != BROADCAST:
                    body = packet[_PREFIX:-2].replace(_STUFFED, _PATTERN)[1:]
                found.append(Status(packet[4], body[0], body[1:]))

    def _skip(self, count: int) -> None:
        del self._buffer[:count]
        self.skipped += count


def fast_length(servos: int, size: int) -> int:
    """Length field of a complete reply to a fast sync read of `size` bytes from `servos` servos."""
    return 1 + servos * (size + 4)


def fast_blocks(packet: bytes, size: int) -> list[Status]:
    """Blocks of a fast sync read's reply, whole or cut short, as far as each block's own checksum is right.

    The reply is one packet from the broadcast ID, not stuffed: error, ID, data, checksum of everything before,
    once per servo. A servo that stays silent ends it early; the blocks before it are good.

    Args:
        packet: From its header on.
        size: Bytes read from each servo.
    """
    found: list[Status] = []
    crc = summed = 0
    for start in range(_PREFIX + 1, len(packet) - size - 3, size + 4):
        end = start + size + 2
        crc = crc16(packet[summed:end], crc)
        if crc != packet[end] | packet[end + 1] << 8:
            break
        found.append(Status(packet[start + 1], packet[start], packet[start + 2 : end]))
        summed = end
    return found


def find_fast(buffer: bytes, servos: int, size: int) -> int:
    """Index of the header of a fast sync read's reply in `buffer`, or -1."""
    return buffer.find(_fast_head(fast_length(servos, size)))


@lru_cache(maxsize=16)  # a control loop looks for the same one every cycle
def _fast_head(length: int) -> bytes:
    return _HEADER + bytes((BROADCAST,)) + length.to_bytes(2, "little") + bytes((STATUS,))

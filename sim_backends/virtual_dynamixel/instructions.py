"""What servos do with an instruction, and what each of them answers; when it is heard is the bus's affair.

Source: ROBOTIS e-Manual, `dxl/protocol2`, sections "Instruction Details" and "Response Policy".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from sim_backends.virtual_dynamixel.protocol import (
    BROADCAST,
    Fail,
    Instruction,
    Packet,
    crc16,
    fast_status_head,
    status_packet,
)
from sim_backends.virtual_dynamixel.servo import VirtualServo

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Bit rates by Baud_Rate code."""
PING_SLOT = 0.003
"""s per ID between the answers to a broadcast ping. Assumption, from the time the vendor's SDK waits."""


class Answer(NamedTuple):
    """A status packet on its way to the line.

    Attributes:
        servo_id: ID it is sent under.
        servo: Who sends it, and whose return delay counts.
        packet: Its bytes.
        slot: s after the instruction before which it does not begin.
    """

    servo_id: int
    servo: VirtualServo
    packet: bytes
    slot: float = 0.0


class Listeners:
    """The servos of one bus: who has which ID, and what an instruction makes them do.

    Args:
        servos: All of them.
        baud: Bit rate of the line; servos set to another hear nothing.

    Attributes:
        baud: May be changed.
        by_id: Owner of each ID.
        ids: Those that have an owner, ascending.
        doubled: IDs that more than one servo has.
    """

    def __init__(self, servos: Sequence[VirtualServo], baud: int) -> None:
        self._servos = tuple(servos)
        self.baud = baud
        self.by_id: dict[int, VirtualServo] = {}
        self.ids: list[int] = []
        self.doubled: set[int] = set()
        self._also: dict[int, list[VirtualServo]] = {}
        self._execute: dict[int, Callable[[Packet, float], list[Answer]]] = {
            Instruction.PING: self._ping,
            Instruction.SYNC_READ: self._sync_read,
            Instruction.SYNC_WRITE: self._sync_write,
            Instruction.FAST_SYNC_READ: self._fast_sync_read,
            Instruction.BULK_READ: self._bulk_read,
            Instruction.BULK_WRITE: self._bulk_write,
            Instruction.FAST_BULK_READ: self._fast_bulk_read,
        }
        self.survey()

    def survey(self) -> None:
        """Note who has which ID; to be called when one has changed."""
        self.by_id = {}
        self.doubled = set()
        self._also = {}
        for servo in self._servos:
            own, secondary = servo.table.get("ID"), servo.table.get("Secondary_ID")
            if self.by_id.setdefault(own, servo) is not servo:
                self.doubled.add(own)
                self._also.setdefault(own, []).append(servo)
            if secondary <= 252 and secondary != own:
                self._also.setdefault(secondary, []).append(servo)
        self.ids = sorted(self.by_id)

    def execute(self, packet: Packet, now: float) -> list[Answer]:
        """Carry out an instruction; the answers in the order of the line."""
        return self._execute.get(packet.instruction, self._single)(packet, now)

    def _listening(self, servo_id: int, now: float) -> VirtualServo | None:
        servo = self.by_id.get(servo_id)
        if servo is None or BAUD_RATES[servo.table.memory[8]] != self.baud or not servo.awake(now):
            return None
        return servo

    def _targets(self, servo_id: int, now: float) -> list[VirtualServo]:
        """Everyone who obeys a write to this ID: its owner, its shadows, or all."""
        if servo_id not in self._also and servo_id != BROADCAST:
            owner = self._listening(servo_id, now)
            return [owner] if owner else []
        if servo_id == BROADCAST:
            candidates: list[VirtualServo] = list(self._servos)
        else:
            owner = self.by_id.get(servo_id)
            candidates = [owner] if owner else []
            candidates += self._also.get(servo_id, [])
        baud = self.baud
        return [s for s in candidates if s.awake(now) and BAUD_RATES[s.table.memory[8]] == baud]


    def _single(self, packet: Packet, now: float) -> list[Answer]:
        """Instructions to one servo, its shadows, or all; only an owner of the ID answers."""
        params = packet.params
        owner = self._listening(packet.servo_id, now)
        if packet.instruction == Instruction.READ:
            if owner is None or owner.answer_level < 1:
                return []
            error, data = Fail.DATA_LENGTH | owner.alert, b""
            if len(params) == 4:
                error, data = owner.read(params[0] | params[1] << 8, params[2] | params[3] << 8)
            return [Answer(packet.servo_id, owner, status_packet(packet.servo_id, error, data))]
        level = owner.answer_level if owner else 0
        error = Fail.NONE
        for servo in self._targets(packet.servo_id, now):
            result = self._order(servo, packet.instruction, params, now)
            error = result if servo is owner else error
        if owner is None or level < 2:
            return []
        return [Answer(packet.servo_id, owner, status_packet(packet.servo_id, error))]

    @staticmethod
    def _order(servo: VirtualServo, instruction: int, params: bytes, now: float) -> int:
        """Carry out an instruction without data in the answer; the error byte."""
        alert = servo.alert
        if instruction in (Instruction.WRITE, Instruction.REG_WRITE):
            if len(params) < 3:
                return Fail.DATA_LENGTH | alert
            address = params[0] | params[1] << 8
            if instruction == Instruction.WRITE:
                return servo.write(address, params[2:])
            return servo.register_write(address, params[2:])
        if instruction == Instruction.ACTION:
            servo.action()
            return servo.alert
        if instruction == Instruction.REBOOT:
            servo.reboot(now)
            return alert
        if instruction == Instruction.FACTORY_RESET:
            if params not in (b"\xff", b"\x01", b"\x02"):
                return Fail.DATA_RANGE | alert
            servo.factory_reset(keep_id=params != b"\xff", keep_baud=params == b"\x02", now=now)
            return alert
        if instruction == Instruction.CLEAR:
            if params != b"\x01\x44\x58\x4c\x22":
                return Fail.DATA_RANGE | alert
            return servo.clear_turns() | alert
        return Fail.INSTRUCTION | alert

    def _ping(self, packet: Packet, now: float) -> list[Answer]:
        everyone = packet.servo_id == BROADCAST
        answers = []
        for servo_id in self.ids if everyone else (packet.servo_id,):
            servo = self._listening(servo_id, now)
            if servo:
                memory = servo.table.memory
                pong = status_packet(servo_id, servo.alert, bytes(memory[0:2] + memory[6:7]))
                answers.append(Answer(servo_id, servo, pong, PING_SLOT * servo_id if everyone else 0.0))
        return answers

    def _sync_read(self, packet: Packet, now: float) -> list[Answer]:
        params = packet.params
        if len(params) < 5:
            return []
        address, length = params[0] | params[1] << 8, params[2] | params[3] << 8
        return self._read_in_turn([(servo_id, address, length) for servo_id in params[4:]], now)

    def _bulk_read(self, packet: Packet, now: float) -> list[Answer]:
        return self._read_in_turn(_bulk_items(packet.params), now)

    def _read_in_turn(self, items: list[tuple[int, int, int]], now: float) -> list[Answer]:
        """One status packet per servo. Assumption: behind a missing servo the others wait for ever."""
        answers: list[Answer] = []
        for servo_id, address, length in items:
            servo = self._listening(servo_id, now)
            if servo is None or servo.answer_level < 1:
                break
            error, data = servo.read(address, length)
            answers.append(Answer(servo_id, servo, status_packet(servo_id, error, data)))
        return answers

    def _fast_sync_read(self, packet: Packet, now: float) -> list[Answer]:
        params = packet.params
        if packet.servo_id != BROADCAST or len(params) < 5:
            return []
        address, length = params[0] | params[1] << 8, params[2] | params[3] << 8
        return self._read_at_once([(servo_id, address, length) for servo_id in params[4:]], now)

    def _fast_bulk_read(self, packet: Packet, now: float) -> list[Answer]:
        if packet.servo_id != BROADCAST:
            return []
        return self._read_at_once(_bulk_items(packet.params), now)

    def _read_at_once(self, items: list[tuple[int, int, int]], now: float) -> list[Answer]:
        """One unstuffed packet for all servos, ending early at the first that is missing.

        Each block is ERR ID DATA CRC; every CRC covers all bytes before it. Assumption: a servo that cannot
        read the address fills its data with zeros.
        """
        raw = tail = b""
        crc = 0
        first: VirtualServo | None = None
        for servo_id, address, length in items:
            servo = self._listening(servo_id, now)
            if servo is None or servo.answer_level < 1:
                break
            error, data = servo.read(address, length)
            block = bytes((error, servo_id)) + (data or bytes(length))
            if first is None:
                first = servo
                block = fast_status_head(1 + sum(4 + item[2] for item in items)) + block
            crc = crc16(tail + block, crc)
            tail = crc.to_bytes(2, "little")
            raw += block + tail
        return [Answer(BROADCAST, first, raw)] if first else []

    def _sync_write(self, packet: Packet, now: float) -> list[Answer]:
        params = packet.params
        if packet.servo_id != BROADCAST or len(params) < 4:
            return []
        address, length = params[0] | params[1] << 8, params[2] | params[3] << 8
        stride = length + 1
        if not length or (len(params) - 4) % stride:
            return []
        for at in range(4, len(params), stride):
            for servo in self._targets(params[at], now):
                servo.write(address, params[at + 1 : at + stride])
        return []

    def _bulk_write(self, packet: Packet, now: float) -> list[Answer]:
        params = packet.params
        at = 0
        while packet.servo_id == BROADCAST and at + 5 <= len(params):
            length = params[at + 3] | params[at + 4] << 8
            data = params[at + 5 : at + 5 + length]
            if not length or len(data) < length:
                break
            for servo in self._targets(params[at], now):
                servo.write(params[at + 1] | params[at + 2] << 8, data)
            at += 5 + length
        return []


def _bulk_items(params: bytes) -> list[tuple[int, int, int]]:
    """(ID, address, length) entries of a bulk read."""
    return [
        (params[at], params[at + 1] | params[at + 2] << 8, params[at + 3] | params[at + 4] << 8)
        for at in range(0, len(params) - 4, 5)
    ]

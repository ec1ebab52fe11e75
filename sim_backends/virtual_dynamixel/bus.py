"""The wire between the adapter and the servos: who hears what, who answers when.

`handle` takes the bytes the host sends and says which bytes come back at what time; it neither waits nor
moves the clock. An instruction takes effect at the moment it is handed over, up to its own time on the wire
(below 1 ms at 1 Mbaud) early.

Source: ROBOTIS e-Manual, `dxl/protocol2`, sections "Instruction Details" and "Response Policy".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from sim_backends.plant import Plant
from sim_backends.virtual_dynamixel.faults import Fault, FaultInjector
from sim_backends.virtual_dynamixel.health import ERROR_ENCODER, ERROR_OVERHEAT, ERROR_OVERLOAD
from sim_backends.virtual_dynamixel.protocol import (
    BROADCAST,
    Fail,
    Instruction,
    InstructionParser,
    Packet,
    crc16,
    fast_status_head,
    status_packet,
)
from sim_backends.virtual_dynamixel.servo import HOUSEKEEPING, ServoSpec, VirtualServo

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Bit rates by Baud_Rate code."""
PATIENCE = 0.1
"""s of silence after which servos forget an unfinished packet. Assumption."""
PING_SLOT = 0.003
"""s per ID between the answers to a broadcast ping. Assumption, from the time the vendor's SDK waits."""

Replies = list[tuple[float, bytes]]


class VirtualBus:
    """A half-duplex bus with servos on it.

    Args:
        plant: The mechanical world; the bus asks to be called before every physics step.
        servos: What is mounted. Two servos with one ID are refused.
        baud: Rate all servos are set to, bit/s.
        latency_timer_ms: The adapter hands bytes over only so often, ms; 0 is an ideal adapter.
        seed: Of the injected faults.
    """

    def __init__(
        self,
        plant: Plant,
        servos: Sequence[ServoSpec],
        *,
        baud: int = 1_000_000,
        latency_timer_ms: float = 0,
        seed: int = 0,
    ) -> None:
        if len({spec.servo_id for spec in servos}) != len(servos):
            raise ValueError("two servos share one ID")
        self.plant = plant
        self.faults = FaultInjector(seed)
        self.connected = True
        """The adapter is plugged in."""
        self.host_baud = baud
        """Bit rate the host's port is set to; servos set to another hear and say nothing."""
        self._latency = latency_timer_ms * 1e-3
        self._parser = InstructionParser()
        self._host_free = self._line_free = self._last_byte = -math.inf
        self._last_instruction = plant.now()
        self._next_housekeeping = plant.now() + HOUSEKEEPING
        self._servos = [VirtualServo(spec, plant, BAUD_RATES.index(baud)) for spec in servos]
        self._survey()
        for servo in self._servos:
            servo.on_change = self._survey
        self._execute: dict[int, Callable[[Packet, float], Replies]] = {
            Instruction.PING: self._ping,
            Instruction.SYNC_READ: self._sync_read,
            Instruction.SYNC_WRITE: self._sync_write,
            Instruction.FAST_SYNC_READ: self._fast_sync_read,
            Instruction.BULK_READ: self._bulk_read,
            Instruction.BULK_WRITE: self._bulk_write,
            Instruction.FAST_BULK_READ: self._fast_bulk_read,
        }
        plant.on_step(self._on_step)

    def servo(self, servo_id: int) -> VirtualServo:
        """The servo that has this ID now.

        Raises:
            KeyError: There is none.
        """
        return self._by_id[servo_id]

    @property
    def servo_ids(self) -> list[int]:
        """IDs on the bus, ascending."""
        return sorted(self._by_id)

    # --- faults -------------------------------------------------------------------------------------------

    def strike(self, fault: Fault, servo_id: int | None = None) -> None:
        """Let a fault of a servo, or of the adapter, happen now.

        Args:
            fault: One of the servo's faults, or DISCONNECT.
            servo_id: Which servo; not needed for DISCONNECT.
        """
        if fault is Fault.DISCONNECT:
            self.connected = False
            return
        if servo_id is None:
            raise ValueError(f"{fault} needs a servo")
        servo = self._by_id[servo_id]
        if fault is Fault.SILENT:
            servo.silent = True
        elif fault is Fault.REBOOT:
            servo.reboot(self.plant.now())
        elif fault is Fault.OVERLOAD:
            servo.fail(ERROR_OVERLOAD)
        elif fault is Fault.OVERHEAT:
            servo.health.temperature = servo.table.get("Temperature_Limit") + 1.0
            servo.fail(ERROR_OVERHEAT)
        elif fault is Fault.UNDERVOLTAGE:
            servo.set_supply(servo.table.get("Min_Voltage_Limit") / 10 - 0.5)
        elif fault is Fault.ENCODER:
            servo.fail(ERROR_ENCODER)
        else:
            raise ValueError(f"{fault} strikes packets: use faults.once")

    def heal(self) -> None:
        """Plug in, feed and cool everything again. Latched errors need a reboot, as on metal."""
        self.connected = True
        for servo in self._servos:
            servo.heal()

    # --- time ---------------------------------------------------------------------------------------------

    def _survey(self) -> None:
        """Note who has which ID and who needs attention; called when a servo has changed."""
        self._by_id: dict[int, VirtualServo] = {}
        self._shadows: dict[int, list[VirtualServo]] = {}
        self._doubled: set[int] = set()
        for servo in self._servos:
            own, secondary = servo.table.get("ID"), servo.table.get("Secondary_ID")
            if self._by_id.setdefault(own, servo) is not servo:
                self._doubled.add(own)
                self._shadows.setdefault(own, []).append(servo)
            if secondary <= 252 and secondary != own:
                self._shadows.setdefault(secondary, []).append(servo)
        self._busy = [servo for servo in self._servos if servo.busy]
        self._watch = min((servo.watch for servo in self._servos if servo.watch), default=math.inf)

    def _on_step(self, dt: float) -> None:
        now = self.plant.now()
        for servo in self._busy:
            servo.step(dt, now)
        silence = now - self._last_instruction
        if silence >= self._watch:
            for servo in self._servos:
                if servo.watch and silence >= servo.watch:
                    servo.trip()
        if now >= self._next_housekeeping:
            self._next_housekeeping = now + HOUSEKEEPING
            for servo in self._servos:
                servo.housekeeping(HOUSEKEEPING, now)

    # --- the wire -----------------------------------------------------------------------------------------

    def handle(self, data: bytes, at: float) -> Replies:
        """The host sends bytes.

        Assumption: bytes sent while servos still answer collide; the servos understand none of them.

        Args:
            data: Any bytes: packets, parts of packets, garbage.
            at: Now, s of the plant's time.

        Returns:
            (arrival time at the host, bytes) of what comes back, in order of the wire.
        """
        if not self.connected or not data:
            return []
        byte_time = 10.0 / self.host_baud
        start = max(at, self._host_free)
        self._host_free = start + len(data) * byte_time
        if start - self._last_byte > PATIENCE:
            self._parser.reset()
        self._last_byte = self._host_free
        replies: Replies = []
        begin = start
        for packet in self._parser.feed(data):
            end = start + packet.end * byte_time
            if begin >= self._line_free:
                replies += self._obey(packet, end)
            begin = end
        return replies

    def clear_line(self) -> None:
        """Forget what is on the wire: the plant's time has been set anew."""
        self._host_free = self._line_free = -math.inf

    def _obey(self, packet: Packet, end: float) -> Replies:
        if self.faults.active:
            lost, befalls = self.faults.on_instruction(self.servo_ids)
            for fault, servo_id in befalls:
                self.strike(fault, servo_id)
            if lost or not self.connected:
                return []
        self._last_instruction = end
        self._line_free = end
        execute = self._execute.get(packet.instruction)
        return execute(packet, end) if execute else self._single(packet, end)

    def _listening(self, servo_id: int, now: float) -> VirtualServo | None:
        servo = self._by_id.get(servo_id)
        return servo if servo and servo.awake(now) and BAUD_RATES[servo.table.memory[8]] == self.host_baud else None

    def _targets(self, servo_id: int, now: float) -> list[VirtualServo]:
        """Everyone who obeys a write to this ID: its owner, its shadows, or all."""
        if servo_id not in self._shadows and servo_id != BROADCAST:
            owner = self._listening(servo_id, now)
            return [owner] if owner else []
        if servo_id == BROADCAST:
            candidates: list[VirtualServo] = list(self._servos)
        else:
            owner = self._by_id.get(servo_id)
            candidates = [owner] if owner else []
            candidates += self._shadows.get(servo_id, [])
        baud = self.host_baud
        return [s for s in candidates if s.awake(now) and BAUD_RATES[s.table.memory[8]] == baud]

    def _send(self, servo_id: int, servo: VirtualServo, packet: bytes) -> Replies:
        """Put a status packet on the line after the servo's return delay."""
        begin = self._line_free + servo.table.memory[9] * 2e-6
        self._line_free = begin + len(packet) * 10.0 / self.host_baud
        arrival = self._line_free
        if servo_id in self._doubled:
            # Two servos talk at once; nobody can read the end of it.
            packet = packet[:-2] + bytes(byte ^ 0xFF for byte in packet[-2:])
        if self._latency:
            arrival = math.ceil(arrival / self._latency) * self._latency
        if self.faults.active:
            arrival, packet = self.faults.on_status(servo_id, packet, arrival)
        return [(arrival, packet)] if packet else []

    # --- instructions -------------------------------------------------------------------------------------

    def _single(self, packet: Packet, end: float) -> Replies:
        """Instructions to one servo, its shadows, or all; only an owner of the ID answers."""
        params = packet.params
        owner = self._listening(packet.servo_id, end)
        if packet.instruction == Instruction.READ:
            if owner is None or owner.answer_level < 1:
                return []
            error, data = Fail.DATA_LENGTH | owner.alert, b""
            if len(params) == 4:
                error, data = owner.read(params[0] | params[1] << 8, params[2] | params[3] << 8)
            return self._send(packet.servo_id, owner, status_packet(packet.servo_id, error, data))
        level = owner.answer_level if owner else 0
        error = Fail.NONE
        for servo in self._targets(packet.servo_id, end):
            result = self._order(servo, packet.instruction, params, end)
            error = result if servo is owner else error
        if owner is None or level < 2:
            return []
        return self._send(packet.servo_id, owner, status_packet(packet.servo_id, error))

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

    def _ping(self, packet: Packet, end: float) -> Replies:
        if packet.servo_id != BROADCAST:
            servo = self._listening(packet.servo_id, end)
            return self._pong(packet.servo_id, servo) if servo else []
        replies: Replies = []
        for servo_id in self.servo_ids:
            servo = self._listening(servo_id, end)
            if servo:
                self._line_free = max(self._line_free, end + PING_SLOT * servo_id)
                replies += self._pong(servo_id, servo)
        return replies

    def _pong(self, servo_id: int, servo: VirtualServo) -> Replies:
        memory = servo.table.memory
        return self._send(servo_id, servo, status_packet(servo_id, servo.alert, bytes(memory[0:2] + memory[6:7])))

    def _sync_read(self, packet: Packet, end: float) -> Replies:
        params = packet.params
        if len(params) < 5:
            return []
        address, length = params[0] | params[1] << 8, params[2] | params[3] << 8
        return self._read_in_turn([(servo_id, address, length) for servo_id in params[4:]], end)

    def _bulk_read(self, packet: Packet, end: float) -> Replies:
        return self._read_in_turn(_bulk_items(packet.params), end)

    def _read_in_turn(self, items: list[tuple[int, int, int]], end: float) -> Replies:
        """One status packet per servo. Assumption: behind a missing servo the others wait for ever."""
        replies: Replies = []
        for servo_id, address, length in items:
            servo = self._listening(servo_id, end)
            if servo is None or servo.answer_level < 1:
                break
            error, data = servo.read(address, length)
            replies += self._send(servo_id, servo, status_packet(servo_id, error, data))
        return replies

    def _fast_sync_read(self, packet: Packet, end: float) -> Replies:
        params = packet.params
        if packet.servo_id != BROADCAST or len(params) < 5:
            return []
        address, length = params[0] | params[1] << 8, params[2] | params[3] << 8
        return self._read_at_once([(servo_id, address, length) for servo_id in params[4:]], end)

    def _fast_bulk_read(self, packet: Packet, end: float) -> Replies:
        if packet.servo_id != BROADCAST:
            return []
        return self._read_at_once(_bulk_items(packet.params), end)

    def _read_at_once(self, items: list[tuple[int, int, int]], end: float) -> Replies:
        """One unstuffed packet for all servos, ending early at the first that is missing.

        Each block is ERR ID DATA CRC; every CRC covers all bytes before it. Assumption: a servo that cannot
        read the address fills its data with zeros.
        """
        raw = b""
        crc = 0
        first: VirtualServo | None = None
        for servo_id, address, length in items:
            servo = self._listening(servo_id, end)
            if servo is None or servo.answer_level < 1:
                break
            error, data = servo.read(address, length)
            block = bytes((error, servo_id)) + (data or bytes(length))
            if first is None:
                first = servo
                block = fast_status_head(1 + sum(4 + item[2] for item in items)) + block
            crc = crc16(block, crc)
            tail = crc.to_bytes(2, "little")
            crc = crc16(tail, crc)
            raw += block + tail
        return self._send(BROADCAST, first, raw) if first else []

    def _sync_write(self, packet: Packet, end: float) -> Replies:
        params = packet.params
        if packet.servo_id != BROADCAST or len(params) < 4:
            return []
        address, length = params[0] | params[1] << 8, params[2] | params[3] << 8
        stride = length + 1
        if not length or (len(params) - 4) % stride:
            return []
        for at in range(4, len(params), stride):
            for servo in self._targets(params[at], end):
                servo.write(address, params[at + 1 : at + stride])
        return []

    def _bulk_write(self, packet: Packet, end: float) -> Replies:
        params = packet.params
        at = 0
        while packet.servo_id == BROADCAST and at + 5 <= len(params):
            length = params[at + 3] | params[at + 4] << 8
            data = params[at + 5 : at + 5 + length]
            if not length or len(data) < length:
                break
            for servo in self._targets(params[at], end):
                servo.write(params[at + 1] | params[at + 2] << 8, data)
            at += 5 + length
        return []


def _bulk_items(params: bytes) -> list[tuple[int, int, int]]:
    """(ID, address, length) entries of a bulk read."""
    return [
        (params[at], params[at + 1] | params[at + 2] << 8, params[at + 3] | params[at + 4] << 8)
        for at in range(0, len(params) - 4, 5)
    ]

"""The wire between the adapter and the servos: who hears what, who answers when.

`handle` takes the bytes the host sends and says which bytes come back at what time; it neither waits nor
moves the clock. An instruction takes effect at the moment it is handed over, up to its own time on the wire
(below 1 ms at 1 Mbaud) early.

Source: ROBOTIS e-Manual, `dxl/protocol2`, "Response Policy"; `dxl/x/xm430-w350`, "Return Delay Time".
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from sim_backends.plant import Plant
from sim_backends.virtual_dynamixel.faults import Fault, FaultInjector
from sim_backends.virtual_dynamixel.health import ERROR_ENCODER, ERROR_OVERHEAT, ERROR_OVERLOAD, ERROR_SHOCK
from sim_backends.virtual_dynamixel.instructions import BAUD_RATES, Answer, Listeners
from sim_backends.virtual_dynamixel.protocol import BROADCAST, InstructionParser, Packet
from sim_backends.virtual_dynamixel.servo import HOUSEKEEPING, ServoSpec, VirtualServo

PATIENCE = 0.1
"""s of silence after which servos forget an unfinished packet. Assumption."""
_USB_PACKET, _FLUSH = 62, 1e-3
"""Bytes that an adapter hands over together at most, and how long it waits for so many at most, s: a packet of 64 less
its two of status, and the shortest latency timer.

Source: FTDI AN232B-04, "Data Throughput, Latency and Handshaking".
"""
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
        self._latency = latency_timer_ms * 1e-3
        self._parser = InstructionParser()
        self._host_free = self._line_free = self._last_byte = -math.inf
        self._last_instruction = plant.now()
        self._next_housekeeping = plant.now() + HOUSEKEEPING
        self._servos = [VirtualServo(spec, plant, BAUD_RATES.index(baud)) for spec in servos]
        self._listeners = Listeners(self._servos, baud)
        self._busy: list[VirtualServo] = []
        self._watch = math.inf
        for servo in self._servos:
            servo.on_change = self._attend
            servo.on_address = self._listeners.survey
        plant.on_step(self._on_step)

    @property
    def host_baud(self) -> int:
        """Bit rate the host's port is set to; servos set to another hear and say nothing."""
        return self._listeners.baud

    @host_baud.setter
    def host_baud(self, baud: int) -> None:
        self._listeners.baud = baud

    def servo(self, servo_id: int) -> VirtualServo:
        """The servo that has this ID now.

        Raises:
            KeyError: There is none.
        """
        return self._listeners.by_id[servo_id]

    @property
    def servo_ids(self) -> list[int]:
        """IDs on the bus, ascending."""
        return list(self._listeners.ids)

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
        servo = self._listeners.by_id[servo_id]
        if fault is Fault.SILENT:
            servo.silent = True
        elif fault is Fault.REBOOT:
            servo.reboot(self.plant.now())
        elif fault is Fault.OVERLOAD:
            servo.fail(ERROR_OVERLOAD)
        elif fault is Fault.SHOCK:
            servo.fail(ERROR_SHOCK)
        elif fault is Fault.OVERHEAT:
            servo.health.temperature = servo.table.get("Temperature_Limit") + 1.0
            servo.fail(ERROR_OVERHEAT)
        elif fault is Fault.UNDERVOLTAGE:
            servo.set_supply(servo.table.get("Min_Voltage_Limit") / 10 - 0.5)
        elif fault is Fault.ENCODER:
            servo.fail(ERROR_ENCODER)
        else:
            raise ValueError(f"{fault} strikes packets: use faults.once")

    def feed(self, volts: float) -> None:
        """Feed every servo with another voltage."""
        for servo in self._servos:
            servo.set_supply(volts)

    def heal(self) -> None:
        """Plug in, feed and cool everything again. Latched errors need a reboot, as on metal."""
        self.connected = True
        for servo in self._servos:
            servo.heal()

    # --- time ---------------------------------------------------------------------------------------------

    def _attend(self) -> None:
        """Note who needs attention; called when a servo has changed."""
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
            lost, befalls = self.faults.on_instruction(self._listeners.ids)
            for fault, servo_id in befalls:
                self.strike(fault, servo_id)
            if lost or not self.connected:
                return []
        self._last_instruction = end
        self._line_free = end
        replies: Replies = []
        for answer in self._listeners.execute(packet, end):
            replies += self._send(answer, end)
        return replies

    def _send(self, answer: Answer, end: float) -> Replies:
        """Put a status packet on the line, after the servo's return delay and in its slot."""
        servo_id, servo, packet, slot = answer
        begin = max(self._line_free, end + slot) + servo.table.memory[9] * 2e-6
        arrival = self._line_free = begin + len(packet) * 10.0 / self._listeners.baud
        if servo_id in self._listeners.doubled:
            # Two servos talk at once; nobody can read the end of it.
            packet = packet[:-2] + bytes(byte ^ 0xFF for byte in packet[-2:])
        if self.faults.active:
            arrival, packet = self.faults.on_status(servo_id, packet, arrival)
        if servo_id != BROADCAST:
            return [(self._handed_over(arrival), packet)] if packet else []
        # An adapter does not wait for the end of a packet that many servos talk into.
        byte_time = 10.0 / self._listeners.baud
        piece = max(1, min(_USB_PACKET, int(_FLUSH / byte_time)))
        ends = [min(start + piece, len(packet)) for start in range(0, len(packet), piece)]
        return [
            (self._handed_over(arrival - (len(packet) - end) * byte_time), packet[start:end])
            for start, end in zip(range(0, len(packet), piece), ends, strict=True)
        ]

    def _handed_over(self, arrival: float) -> float:
        """When the host gets what has arrived at the adapter, s."""
        return math.ceil(arrival / self._latency) * self._latency if self._latency else arrival

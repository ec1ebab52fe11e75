"""Faults on demand: what goes wrong on a servo bus, by rate or once, the same again for the same seed."""

from __future__ import annotations

import random
from collections import Counter
from enum import StrEnum

from sim_backends.virtual_dynamixel.protocol import crc16


class Fault(StrEnum):
    """Everything that can be made to go wrong.

    The first group happens to status packets, `LOST` to an instruction packet (no servo hears it), the last
    group to a servo, `DISCONNECT` to the adapter.
    """

    DROP = "drop"
    CORRUPT = "corrupt"
    TRUNCATE = "truncate"
    DELAY = "delay"
    NOISE = "noise"
    WRONG_ID = "wrong_id"
    LOST = "lost"
    SILENT = "silent"
    REBOOT = "reboot"
    OVERLOAD = "overload"
    SHOCK = "shock"
    UNDERVOLTAGE = "undervoltage"
    OVERHEAT = "overheat"
    ENCODER = "encoder"
    DISCONNECT = "disconnect"


ON_SERVO = (Fault.SILENT, Fault.REBOOT, Fault.OVERLOAD, Fault.SHOCK, Fault.UNDERVOLTAGE, Fault.OVERHEAT, Fault.ENCODER)
_ON_INSTRUCTION = frozenset((*ON_SERVO, Fault.DISCONNECT, Fault.LOST))


class FaultInjector:
    """Decides, packet by packet, what goes wrong.

    Rates are probabilities: per status packet for faults of status packets, per instruction packet for the
    others (which then hit a random servo).

    Args:
        seed: Of the random choices.
    """

    def __init__(self, seed: int = 0) -> None:
        self._random = random.Random(seed)
        self._rates: dict[Fault, float] = {}
        self._due: list[tuple[Fault, int | None, int]] = []
        self.longest_delay = 0.05
        """s; a delayed packet comes up to so much late."""
        self.counts: Counter[Fault] = Counter()
        """How often each fault has struck."""

    @property
    def active(self) -> bool:
        """Something may go wrong."""
        return bool(self._rates or self._due)

    def set_rate(self, fault: Fault, rate: float) -> None:
        """Let a fault strike with probability `rate` from now on; 0 ends it."""
        self._rates.pop(fault, None)
        if rate > 0.0:
            self._rates[fault] = rate

    def once(self, fault: Fault, servo_id: int | None = None, count: int = 1) -> None:
        """Let a fault strike at the next `count` opportunities.

        Args:
            fault: Which.
            servo_id: Only packets of this servo, or only this servo; None is any.
            count: How often.
        """
        self._due.append((fault, servo_id, count))

    def clear(self) -> None:
        """No more faults; what has already happened to a servo stays (see `VirtualBus.heal`)."""
        self._rates.clear()
        self._due.clear()

    def _strikes(self, fault: Fault, servo_id: int | None) -> bool:
        for index, (due, wanted, count) in enumerate(self._due):
            if due is fault and wanted in (None, servo_id):
                self._due[index : index + 1] = [(due, wanted, count - 1)] if count > 1 else []
                self.counts[fault] += 1
                return True
        rate = self._rates.get(fault)
        if rate is not None and self._random.random() < rate:
            self.counts[fault] += 1
            return True
        return False

    def on_instruction(self, servo_ids: list[int]) -> tuple[bool, list[tuple[Fault, int]]]:
        """(the packet is lost, what befalls which servo before it is heard)."""
        befalls: list[tuple[Fault, int]] = []
        if not self._due and self._rates.keys().isdisjoint(_ON_INSTRUCTION):
            return False, befalls
        for fault in (*ON_SERVO, Fault.DISCONNECT):
            for due, wanted, _ in list(self._due):
                if due is fault and self._strikes(fault, wanted):
                    befalls.append((fault, self._random.choice(servo_ids) if wanted is None else wanted))
            if fault in self._rates and self._strikes(fault, None):
                befalls.append((fault, self._random.choice(servo_ids)))
        return self._strikes(Fault.LOST, None), befalls

    def on_status(self, servo_id: int, packet: bytes, arrival: float) -> tuple[float, bytes]:
        """When and how a status packet arrives; empty when it does not."""
        random_ = self._random
        if self._strikes(Fault.WRONG_ID, servo_id):
            other = (servo_id + random_.randint(1, 252)) % 253
            changed = packet[:4] + bytes((other,)) + packet[5:-2]
            packet = changed + crc16(changed).to_bytes(2, "little")
        if self._strikes(Fault.CORRUPT, servo_id):
            # A burst of at most 16 bits, which a CRC-16 always detects.
            index = random_.randrange(len(packet) - 1)
            burst = random_.randint(1, 0xFFFF).to_bytes(2, "little")
            damaged = bytes(a ^ b for a, b in zip(packet[index : index + 2], burst, strict=True))
            packet = packet[:index] + damaged + packet[index + 2 :]
        if self._strikes(Fault.TRUNCATE, servo_id):
            packet = packet[: random_.randrange(1, len(packet))]
        if self._strikes(Fault.NOISE, servo_id):
            packet = random_.randbytes(random_.randint(1, 12)) + packet
        if self._strikes(Fault.DELAY, servo_id):
            arrival += random_.uniform(0.0, self.longest_delay)
        if self._strikes(Fault.DROP, servo_id):
            packet = b""
        return arrival, packet

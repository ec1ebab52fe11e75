"""The simulated bus as a serial port in the same process, on simulated time.

A plant may tell the time in whole steps only. The stream keeps the time on the line itself, so that bytes
follow each other by microseconds however coarse the plant is.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

from controller.errors import BusError
from sim_backends.virtual_dynamixel.bus import VirtualBus
from sim_backends.virtual_dynamixel.instructions import BAUD_RATES

_UNPLUGGED = "check the USB cable and the adapter"


class BusStream:
    """A `ByteStream` whose reads let simulated time pass until bytes arrive. For one thread.

    Args:
        bus: The bus behind it.
        name: For messages.
    """

    def __init__(self, bus: VirtualBus, name: str = "sim-bus") -> None:
        self._bus = bus
        self._plant = bus.plant
        self._name = name
        self._open = False
        self._coming: deque[tuple[float, bytes]] = deque()
        self._arrived = b""
        self._time = -math.inf

    @property
    def name(self) -> str:
        """For messages."""
        return self._name

    def open(self, baud: int) -> None:
        """Set the host's bit rate.

        Raises:
            BusError: code `lost` (unplugged), `busy` (opened before) or `refused` (no such bit rate).
        """
        if not self._bus.connected:
            raise BusError(self._name, "open", "lost", "the adapter is unplugged", _UNPLUGGED)
        if self._open:
            raise BusError(self._name, "open", "busy", "the port is open already", "close it first")
        if baud not in BAUD_RATES:
            raise BusError(self._name, "open", "refused", f"{baud} bit/s is not possible", f"use one of {BAUD_RATES}")
        self._bus.host_baud = baud
        self._open = True
        self._forget()

    def close(self) -> None:
        """Forget what is under way; harmless when not open."""
        self._open = False
        self._forget()

    def write(self, data: bytes) -> None:
        """Hand bytes over to the adapter; takes no time.

        Raises:
            BusError: code `lost`.
        """
        self._check("write")
        replies = self._bus.handle(data, self._now())
        if replies:
            in_order = all(early[0] <= late[0] for early, late in pairwise(replies))
            in_order = in_order and (not self._coming or self._coming[-1][0] <= replies[0][0])
            self._coming.extend(replies)
            if not in_order:
                self._coming = deque(sorted(self._coming, key=lambda reply: reply[0]))

    def read(self, size: int, timeout: float) -> bytes:
        """Up to `size` bytes as soon as any have arrived; lets up to `timeout` s of simulated time pass.

        Raises:
            BusError: code `lost`.
        """
        self._check("read")
        self._take(self._now())
        if not self._arrived and timeout > 0.0:
            arrival = self._coming[0][0] if self._coming else math.inf
            until = min(arrival, self._time + timeout)
            self._plant.advance(until - self._time)
            self._time = until
            self._check("read")
            self._take(until)
        data, self._arrived = self._arrived[:size], self._arrived[size:]
        return data

    def discard_input(self) -> None:
        """Drop what has arrived by now; what is still on the wire will arrive.

        Raises:
            BusError: code `lost`.
        """
        self._check("discard input")
        self._take(self._now())
        self._arrived = b""

    def _now(self) -> float:
        self._time = max(self._time, self._plant.now())
        return self._time

    def _take(self, now: float) -> None:
        coming = self._coming
        while coming and coming[0][0] <= now:
            self._arrived += coming.popleft()[1]

    def _forget(self) -> None:
        self._coming.clear()
        self._arrived = b""

    def _check(self, operation: str) -> None:
        if not self._bus.connected:
            raise BusError(self._name, operation, "lost", "the adapter has been unplugged", _UNPLUGGED)
        if not self._open:
            raise BusError(self._name, operation, "lost", "the port is not open", "open it first")

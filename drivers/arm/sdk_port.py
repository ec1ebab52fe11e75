"""The stock Dynamixel SDK over our byte stream: for its tools, and as the reference in tests.

The SDK's own port spins on a non-blocking read, measures time by the wall clock and is not exclusive. This
subclass blocks, uses the cell's clock and inherits whatever the stream guarantees. The packet handler above it
keeps its own defects; see `protocol` and `bus`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from dynamixel_sdk import PortHandler

from controller.errors import BusError
from controller.ports import ByteStream, Clock

_T = TypeVar("_T")
_LATENCY_MS = 8.0
_ROUNDING_MS = 1e-6


class SdkPort(PortHandler):  # type: ignore[misc]  # the SDK has no types
    """A `dynamixel_sdk.PortHandler` over a `ByteStream`. Raises BusError where the stream does.

    Args:
        stream: The line.
        clock: Time for deadlines.
        baud: bit/s.
    """

    def __init__(self, stream: ByteStream, clock: Clock, baud: int) -> None:
        super().__init__(stream.name)
        self._stream = stream
        self._clock = clock
        self.baudrate = baud
        self.tx_time_per_byte = 10_000.0 / baud
        self._sent = 0

    def setBaudRate(self, baudrate: int) -> bool:
        """Open (again) at `baudrate`."""
        self.baudrate = baudrate
        self.tx_time_per_byte = 10_000.0 / baudrate
        self._stream.open(baudrate)
        self.is_open = True
        self.is_using = False
        return True

    def closePort(self) -> None:
        """Release the line."""
        self._stream.close()
        self.is_open = False
        self.is_using = False

    def clearPort(self) -> None:
        """Drop what has arrived."""
        self._on_line(self._stream.discard_input)

    def getBytesAvailable(self) -> int:
        """Not known to a stream."""
        return 0

    def readPort(self, length: int) -> list[int]:
        """Bytes as soon as any arrive, or none when the packet's time is over."""
        left = max(0.0, self.packet_timeout - self.getTimeSinceStart()) / 1000.0
        return list(self._on_line(lambda: self._stream.read(length, left)))

    def writePort(self, packet: list[int]) -> int:
        """Send; returns how many bytes were."""
        data = bytes(packet)
        self._on_line(lambda: self._stream.write(data))
        self._sent = len(data)
        return len(data)

    def setPacketTimeout(self, packet_length: int) -> None:
        """Start the deadline of a reply, the instruction's own wire time included."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * (self._sent + packet_length) + _LATENCY_MS)

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Start a deadline of `msec` ms."""
        self.packet_start_time = self.getCurrentTime()
        self.packet_timeout = msec

    def getCurrentTime(self) -> float:
        """Milliseconds of the cell's clock."""
        return self._clock.now() * 1000.0

    def isPacketTimeout(self) -> bool:
        """The deadline has been reached; a read that ran out of time ends exactly there."""
        return bool(self.getTimeSinceStart() >= self.packet_timeout - _ROUNDING_MS)

    def _on_line(self, action: Callable[[], _T]) -> _T:
        try:
            return action()
        except BusError:
            self.is_using = False
            raise

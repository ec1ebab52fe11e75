"""What comes back from the bus: one servo's answer, who it says it is, and how often things went wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from drivers.arm.protocol import ALERT


class Reply(NamedTuple):
    """What one servo answered.

    Attributes:
        error: The error byte; bit 7 (`alert`) leaves the data good.
        data: Exactly the bytes asked for, or nothing when the low seven bits of `error` are not zero.
    """

    error: int
    data: bytes

    @property
    def alert(self) -> bool:
        """Hardware_Error_Status is not zero."""
        return bool(self.error & ALERT)


@dataclass(frozen=True, slots=True)
class Identity:
    """What a servo says to a ping."""

    model_number: int
    firmware: int
    alert: bool


@dataclass(slots=True)
class BusStatistics:
    """Counts since the bus was made.

    Attributes:
        transactions: Instructions sent.
        replies: Replies accepted.
        timeouts: Servos that did not answer in time.
        corrupt: Packets whose checksum was wrong.
        strays: Good packets nobody had asked for: wrong ID, wrong length, late.
        skipped_bytes: Bytes that belonged to no packet.
        retries: Reads repeated.
        fast_fallbacks: Times the fast sync read was given up.
    """

    transactions: int = 0
    replies: int = 0
    timeouts: int = 0
    corrupt: int = 0
    strays: int = 0
    skipped_bytes: int = 0
    retries: int = 0
    fast_fallbacks: int = 0

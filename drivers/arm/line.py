"""One question on the servo bus and its answers: wire time, deadlines, and replies that come too late.

Replies carry no sequence number. After a miss, one that is late by up to `LATE_REPLY` is kept from being taken for
the next answer: single transactions wait it out, sync reads ask for a byte more.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from controller.ports import ByteStream, Clock
from drivers.arm import protocol
from drivers.arm.protocol import Status, StatusParser
from drivers.arm.replies import BusStatistics

LATE_REPLY = 0.060
"""How long after a miss its reply may still arrive, s: the longest delays seen on USB adapters are 50 ms."""

_BITS_PER_BYTE = 10  # start, eight, stop
_RETURN_DELAY = 254 * 2e-6  # largest Return_Delay_Time, s: a servo fresh from its box waits 250 units
_LATENCY_AGAIN = 0.0025  # of a servo silent a moment ago: what comes later is told by its length
_PADS = 8  # lengths by which the answers to one sync read are told from those to the one before


class Line:
    """Sends instruction packets and collects what is answered.

    Args:
        stream: The line.
        clock: Time for deadlines.
        baud: bit/s.
        latency: How long a reply may take beyond wire time and return delay, s.

    Attributes:
        statistics: What has been sent, heard and missed.
        latency: As given.
    """

    def __init__(self, stream: ByteStream, clock: Clock, baud: int, latency: float) -> None:
        self.statistics = BusStatistics()
        self.latency = latency
        self._stream = stream
        self._clock = clock
        self._baud = baud
        self._byte_time = _BITS_PER_BYTE / baud
        self._free = 0.0
        self._late: dict[int, float] = {}
        self._pad = 0

    @property
    def name(self) -> str:
        """The stream's name, for messages."""
        return self._stream.name

    def open(self) -> None:
        """Open it. Raises BusError."""
        self._stream.open(self._baud)
        self._late.clear()
        self._free = self._clock.now()

    def close(self) -> None:
        """Release it; harmless when not open."""
        self._stream.close()

    def tell(self, servo_id: int, instruction: int, parameters: bytes) -> None:
        """Send an instruction that nobody answers. Raises BusError, code `lost`."""
        packet = protocol.instruction_packet(servo_id, instruction, parameters)
        self._stream.write(packet)
        # What was sent without waiting for an answer may still be on its way out.
        self._free = max(self._clock.now(), self._free) + len(packet) * self._byte_time
        self.statistics.transactions += 1

    def ask(self, servo_id: int, instruction: int, parameters: bytes, size: int, latency: float) -> Status | None:
        """One servo's reply with `size` bytes of data (or an error and none), or None. Raises BusError, code `lost`."""
        self.wait_out_late((servo_id,))
        self._stream.discard_input()
        self.tell(servo_id, instruction, parameters)
        found = self._collect([servo_id], size, latency)
        return found[0] if found else None

    def ask_all(self, servo_ids: Sequence[int], address: int, size: int, fast: bool) -> list[Status]:
        """The replies to one sync read, plain or fast, as far as there are any. Raises BusError, code `lost`."""
        padded = size + self._pad
        head = address.to_bytes(2, "little") + padded.to_bytes(2, "little")
        self._stream.discard_input()
        if not fast:
            self.tell(protocol.BROADCAST, protocol.SYNC_READ, head + bytes(servo_ids))
            return self._collect(servo_ids, padded, self.latency)
        self.tell(protocol.BROADCAST, protocol.FAST_SYNC_READ, head + bytes(servo_ids))
        return self._collect_fast(servo_ids, padded)

    # --- late replies ---------------------------------------------------------------------------------

    def missed(self, *servo_ids: int) -> None:
        """Somebody did not answer: the reply may still come."""
        until = self._clock.now() + LATE_REPLY
        self._pad = (self._pad + 1) % _PADS
        for servo_id in servo_ids:
            self._late[servo_id] = until

    def by_silence(self, servo_ids: Sequence[int]) -> list[int]:
        """Those silent a moment ago last, where they cannot hold the others up."""
        if self._late:
            now = self._clock.now()
            self._late = {servo_id: until for servo_id, until in self._late.items() if until > now}
        if not self._late:
            self._pad = 0
            return list(servo_ids)
        return sorted(servo_ids, key=self._late.__contains__)

    def wait_out_late(self, servo_ids: Iterable[int]) -> None:
        """Let the time pass in which a reply missed before could still be taken for the next one."""
        until = max((self._late.get(servo_id, 0.0) for servo_id in servo_ids), default=0.0)
        wait = until - self._clock.now()
        if wait > 0.0:
            self._clock.sleep(wait)

    # --- inside ---------------------------------------------------------------------------------------

    def _collect(self, servo_ids: Sequence[int], size: int, latency: float) -> list[Status]:
        """Replies of these servos with `size` bytes of data (or an error and none), until all or silence."""
        longest = 4 + size + (size + 2) // 3 + _PADS  # with every possible stuffed byte
        parser = StatusParser(longest)
        conflicts = 0
        window = _RETURN_DELAY + (protocol.STATUS_OVERHEAD + size) * self._byte_time
        patience, impatience = window + latency, window + min(latency, _LATENCY_AGAIN)
        pending = set(servo_ids)
        lately_silent = self._late.keys()
        found: dict[int, Status] = {}
        deadline = max(self._clock.now(), self._free) + patience
        while pending:
            chunk = self._stream.read(
                len(pending) * (protocol.STATUS_OVERHEAD + size), max(0.0, deadline - self._clock.now())
            )
            for status in parser.feed(chunk) if chunk else parser.flush():
                fits = len(status.data) == size or (not status.data and status.error & ~protocol.ALERT)
                if status.servo_id in pending and fits:
                    pending.discard(status.servo_id)
                    found[status.servo_id] = status
                    deadline = self._clock.now() + (impatience if pending <= lately_silent else patience)
                    continue
                self.statistics.strays += 1
                if fits and found.pop(status.servo_id, None) is not None:
                    # Two different servos under one ID: nobody can say whose value is whose.
                    conflicts += 1
            if not chunk:
                break
        self._account(len(found), len(pending) + conflicts)
        self.statistics.corrupt += parser.bad_checksums
        self.statistics.skipped_bytes += parser.skipped
        return list(found.values())

    def _collect_fast(self, servo_ids: Sequence[int], size: int) -> list[Status]:
        total = 7 + protocol.fast_length(len(servo_ids), size)
        # The servos talk without a pause: when no block comes in its time, none will.
        block_time = (size + 4) * self._byte_time
        deadline = max(self._clock.now(), self._free) + _RETURN_DELAY + block_time + self.latency
        buffer = b""
        start = -1
        while True:
            chunk = self._stream.read(total, max(0.0, deadline - self._clock.now()))
            buffer += chunk
            start = protocol.find_fast(buffer, len(servo_ids), size)
            if not chunk or (start >= 0 and len(buffer) - start >= total):
                break
            heard = max(0, len(buffer) - start - 8) // (size + 4) if start >= 0 else 0
            known = all(servo_id in self._late for servo_id in servo_ids[heard:])
            deadline = self._clock.now() + block_time
            deadline += min(self.latency, _LATENCY_AGAIN) if known else self.latency
        blocks = protocol.fast_blocks(buffer[start : start + total], size) if start >= 0 else []
        found = []
        for wanted, block in zip(servo_ids, blocks, strict=False):
            if block.servo_id != wanted:
                self.statistics.strays += 1
                break
            found.append(block)
        self._account(len(found), len(servo_ids) - len(found))
        if start >= 0 and len(buffer) - start >= total and len(found) < len(servo_ids):
            self.statistics.corrupt += 1
        self.statistics.skipped_bytes += len(buffer) if start < 0 else len(buffer) - min(total, len(buffer) - start)
        return found

    def _account(self, found: int, missing: int) -> None:
        self.statistics.replies += found
        self.statistics.timeouts += missing
        self._free = self._clock.now()

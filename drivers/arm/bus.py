"""The servo bus: transactions with deadlines over a byte stream, one reply per servo, never an invented value.

Stands where `dynamixel_sdk`'s packet handler and group classes would, because those drop what an honest arm
needs: group reads lose every servo's error byte and all servos when one is missing, `getData` then gives 0; a
failed transaction returns while replies are still on the line; time is the wall clock with at least 34 ms for a
silent servo; an unplugged adapter surfaces as `termios.error` and leaves the port busy for ever.

Rules kept here:

- A reply counts only when checksum, ID and length fit the question. A servo that did not answer is `None`.
- Reads may be repeated (and are counted); writes never are.
- Replies carry no sequence number. After a miss, one that is late by up to `LATE_REPLY` is kept from being
  taken for the next answer: single transactions wait it out, sync reads ask for a byte more.
- In a sync read servos answer in turn, so those behind a silent one stay silent. They are asked again at once,
  and a servo that has just been silent is asked last.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence

from controller.errors import BusError
from controller.ports import ByteStream, Clock
from drivers.arm import protocol
from drivers.arm.control_table import REGISTERS, Register
from drivers.arm.protocol import Status, StatusParser
from drivers.arm.replies import BusStatistics, Identity, Reply

LATE_REPLY = 0.060
"""How long after a miss its reply may still arrive, s: the longest delays seen on USB adapters are 50 ms."""

READ_RETRIES = 2

_BITS_PER_BYTE = 10  # start, eight, stop
_RETURN_DELAY = 254 * 2e-6  # largest Return_Delay_Time, s: a servo fresh from its box waits 250 units
_LATENCY = 0.0065  # adapter and scheduler; a silent servo costs this and its wire time
_LATENCY_AGAIN = 0.0025  # of a servo silent a moment ago: what comes later is told by its length
_PADS = 8  # lengths by which the answers to one sync read are told from those to the one before
_FAST_FAILURES = 3  # in a row, after which one plain sync read shows whose fault it is
_TRIAL_EVERY = 100  # failures until it is asked again


class Bus:
    """Protocol 2.0 master. Every method blocks until its deadline at most; threads take turns.

    Args:
        stream: The line.
        clock: Time for deadlines.
        baud: bit/s.
        latency: How long a reply may take beyond wire time and return delay, s.
    """

    def __init__(self, stream: ByteStream, clock: Clock, *, baud: int, latency: float = _LATENCY) -> None:
        self.statistics = BusStatistics()
        self.fast = False
        self._stream = stream
        self._clock = clock
        self._baud = baud
        self._byte_time = _BITS_PER_BYTE / baud
        self._latency = latency
        self._lock = threading.RLock()
        self._line_free = 0.0
        self._late: dict[int, float] = {}
        self._pad = 0
        self._fast_failures = 0

    @property
    def name(self) -> str:
        """The line's name, for messages."""
        return self._stream.name

    def open(self) -> None:
        """Open the line. Raises BusError."""
        with self._lock:
            self._stream.open(self._baud)
            self._late.clear()
            self._line_free = self._clock.now()

    def close(self) -> None:
        """Release the line; harmless when not open."""
        with self._lock:
            self._stream.close()

    # --- one servo ------------------------------------------------------------------------------------

    def ping(self, servo_id: int, retries: int = READ_RETRIES) -> Identity:
        """Ask a servo who it is.

        Raises:
            BusError: code `timeout`, `corrupt` or `lost`.
        """
        reply = self._ask(servo_id, protocol.PING, b"", 3, f"ping servo {servo_id}", retries)
        return Identity(reply.data[0] | reply.data[1] << 8, reply.data[2], reply.alert)

    def read(self, servo_id: int, address: int, size: int, retries: int = READ_RETRIES) -> Reply:
        """Read `size` bytes.

        Raises:
            BusError: code `timeout`, `corrupt`, `refused` or `lost`.
        """
        parameters = address.to_bytes(2, "little") + size.to_bytes(2, "little")
        return self._ask(servo_id, protocol.READ, parameters, size, f"read {address} of servo {servo_id}", retries)

    def read_register(self, servo_id: int, name: str) -> int:
        """Value of a register. Raises BusError as `read`."""
        register = REGISTERS[name]
        reply = self._ask(
            servo_id,
            protocol.READ,
            register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little"),
            register.size,
            f"read {name} of servo {servo_id}",
            READ_RETRIES,
        )
        return register.decode(reply.data)

    def write_register(self, servo_id: int, name: str, value: int) -> Reply:
        """Write a register, once, and wait for the servo's word.

        Raises:
            BusError: code `timeout` or `corrupt` (it may have been written), `refused` (it was not) or `lost`.
        """
        register = REGISTERS[name]
        parameters = register.address.to_bytes(2, "little") + register.encode(value)
        return self._ask(servo_id, protocol.WRITE, parameters, 0, f"write {name} = {value} to servo {servo_id}", 0)

    def reboot(self, servo_id: int) -> None:
        """Restart a servo: its torque goes off and its RAM is reset. Answers to nothing for a while after.

        Raises:
            BusError: As `write_register`.
        """
        self._ask(servo_id, protocol.REBOOT, b"", 0, f"reboot servo {servo_id}", 0)

    # --- several servos -------------------------------------------------------------------------------

    def sync_write(self, name: str, values: Mapping[int, int]) -> None:
        """Write one register of several servos in one packet, which none of them answers.

        Raises:
            BusError: code `lost`.
        """
        register = REGISTERS[name]
        head = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        body = b"".join(bytes((servo_id,)) + register.encode(value) for servo_id, value in values.items())
        with self._lock:
            self._send(protocol.BROADCAST, protocol.SYNC_WRITE, head + body)

    def sync_read(self, servo_ids: Sequence[int], address: int, size: int) -> dict[int, Reply | None]:
        """Read the same bytes of several servos; one that does not answer is None and hides no other.

        Args:
            servo_ids: Whom to ask.
            address: First byte.
            size: Bytes of each. After a miss up to seven more are asked for, and dropped again.

        Raises:
            BusError: code `lost`.
        """
        with self._lock:
            now = self._clock.now()
            self._late = {servo_id: until for servo_id, until in self._late.items() if until > now}
            if not self._late:
                self._pad = 0
            replies: dict[int, Reply | None] = dict.fromkeys(servo_ids)
            # Those silent a moment ago are asked last, where they cannot hold the others up.
            waiting = sorted(servo_ids, key=self._late.__contains__)
            fast = self.fast and self._fast_failures < _FAST_FAILURES
            passes = 0
            while waiting:
                for status in self._sync_pass(waiting, address, size + self._pad, fast):
                    replies[status.servo_id] = Reply(status.error, status.data[:size])
                missing = [servo_id for servo_id in waiting if replies[servo_id] is None]
                if self.fast and passes == 0:
                    self._judge_fast(fast, complete=not missing)
                if not missing:
                    break
                if fast and passes > 0:
                    # A second gap may be the fast read's own fault: ask plainly before giving anybody up.
                    fast, waiting = False, missing
                else:
                    self._missed(missing[0])
                    waiting = missing[1:]
                self.statistics.retries += bool(waiting)
                passes += 1
            return replies

    def sync_read_register(self, servo_ids: Sequence[int], name: str) -> dict[int, int | None]:
        """Value of one register of several servos; None where there is no answer or an error instead of data."""
        register: Register = REGISTERS[name]
        replies = self.sync_read(servo_ids, register.address, register.size)
        return {
            servo_id: register.decode(reply.data) if reply is not None and reply.data else None
            for servo_id, reply in replies.items()
        }

    def probe_fast(self, servo_ids: Sequence[int], address: int, size: int) -> bool:
        """Find out once whether every servo knows the fast sync read, and use it from now on if so.

        Raises:
            BusError: code `lost`.
        """
        with self._lock:
            self._wait_out_late(servo_ids)
            found = self._sync_pass(list(servo_ids), address, size, fast=True)
            self.fast = len(found) == len(servo_ids)
            if not self.fast:
                # Servos that do not know it may answer something else, late.
                self._missed(*servo_ids)
            return self.fast

    # --- inside ---------------------------------------------------------------------------------------

    def _ask(
        self, servo_id: int, instruction: int, parameters: bytes, size: int, operation: str, retries: int
    ) -> Reply:
        with self._lock:
            garbage = self.statistics.skipped_bytes
            for attempt in range(1 + retries):
                self.statistics.retries += attempt > 0
                self._wait_out_late((servo_id,))
                self._send(servo_id, instruction, parameters)
                # A machine that is too busy to hear an answer in time is asked again with more time.
                found = self._collect([servo_id], size, self._latency * (1 + 2 * attempt))
                if found:
                    error = found[0].error
                    if error & ~protocol.ALERT:
                        raise BusError(
                            self.name, operation, "refused", protocol.error_text(error), "check register and value"
                        )
                    return Reply(error, found[0].data)
                self._missed(servo_id)
            code = "corrupt" if self.statistics.skipped_bytes > garbage else "timeout"
            cause, remedy = _FAILURES[code]
            raise BusError(self.name, operation, code, cause, remedy)

    def _sync_pass(self, servo_ids: list[int], address: int, size: int, fast: bool) -> list[Status]:
        head = address.to_bytes(2, "little") + size.to_bytes(2, "little")
        instruction = protocol.FAST_SYNC_READ if fast else protocol.SYNC_READ
        self._send(protocol.BROADCAST, instruction, head + bytes(servo_ids))
        if fast:
            return self._collect_fast(servo_ids, size)
        return self._collect(servo_ids, size, self._latency)

    def _send(self, servo_id: int, instruction: int, parameters: bytes) -> None:
        packet = protocol.instruction_packet(servo_id, instruction, parameters)
        self._stream.discard_input()
        self._stream.write(packet)
        # What was sent without waiting for an answer may still be on its way out.
        self._line_free = max(self._clock.now(), self._line_free) + len(packet) * self._byte_time
        self.statistics.transactions += 1

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
        deadline = max(self._clock.now(), self._line_free) + patience
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

    def _collect_fast(self, servo_ids: list[int], size: int) -> list[Status]:
        total = 7 + protocol.fast_length(len(servo_ids), size)
        # The servos talk without a pause: when no block comes in its time, none will.
        block_time = (size + 4) * self._byte_time
        deadline = max(self._clock.now(), self._line_free) + _RETURN_DELAY + block_time + self._latency
        buffer = b""
        start = -1
        while start < 0 or len(buffer) - start < total:
            chunk = self._stream.read(total, max(0.0, deadline - self._clock.now()))
            if not chunk:
                break
            buffer += chunk
            start = protocol.find_fast(buffer, len(servo_ids), size)
            heard = max(0, len(buffer) - start - 8) // (size + 4) if start >= 0 else 0
            known = self._late.keys() >= set(servo_ids[heard:])
            deadline = self._clock.now() + block_time
            deadline += min(self._latency, _LATENCY_AGAIN) if known else self._latency
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
        self._line_free = self._clock.now()

    def _judge_fast(self, used: bool, complete: bool) -> None:
        """Give the fast read up when it keeps failing where a plain one succeeds: some firmware loses its replies."""
        if used:
            self._fast_failures = 0 if complete else self._fast_failures + 1
        elif complete:
            self.fast = False
            self._fast_failures = 0
            self.statistics.fast_fallbacks += 1
        else:
            # The servo is silent either way.
            self._fast_failures = -_TRIAL_EVERY

    def _missed(self, *servo_ids: int) -> None:
        until = self._clock.now() + LATE_REPLY
        self._pad = (self._pad + 1) % _PADS
        for servo_id in servo_ids:
            self._late[servo_id] = until

    def _wait_out_late(self, servo_ids: Iterable[int]) -> None:
        """Let the time pass in which a reply missed before could still be taken for the next one."""
        until = max((self._late.get(servo_id, 0.0) for servo_id in servo_ids), default=0.0)
        wait = until - self._clock.now()
        if wait > 0.0:
            self._clock.sleep(wait)


_FAILURES = {
    "timeout": ("no answer", "check the cable and the 12 V supply, the servo's ID and the baud rate"),
    "corrupt": ("only broken answers", "check for two servos with the same ID, loose plugs, and the USB cable"),
}

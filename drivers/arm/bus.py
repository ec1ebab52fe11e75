"""The servo bus: transactions with deadlines over a byte stream, one reply per servo, never an invented value.

Stands where `dynamixel_sdk`'s packet handler and group classes would, because those drop what an honest arm
needs: group reads lose every servo's error byte and all servos when one is missing, `getData` then gives 0; a
failed transaction returns while replies are still on the line; time is the wall clock with at least 34 ms for a
silent servo; an unplugged adapter surfaces as `termios.error` and leaves the port busy for ever.

Rules kept here:

- A reply counts only when checksum, ID and length fit the question. A servo that did not answer is `None`.
- Reads may be repeated (and are counted); writes never are.
- A reply that comes too late is never taken for the next answer (see `line`).
- In a sync read servos answer in turn, so those behind a silent one stay silent. They are asked again at once,
  and a servo that has just been silent is asked last.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

from controller.errors import BusError
from controller.ports import ByteStream, Clock
from drivers.arm import protocol
from drivers.arm.control_table import REGISTERS, Register
from drivers.arm.line import Line
from drivers.arm.replies import BusStatistics, Identity, Reply

READ_RETRIES = 2

_LATENCY = 0.0065  # adapter and scheduler; a silent servo costs this and its wire time
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
        self.fast = False
        self._line = Line(stream, clock, baud, latency)
        self._lock = threading.RLock()
        self._fast_failures = 0

    @property
    def name(self) -> str:
        """The line's name, for messages."""
        return self._line.name

    @property
    def statistics(self) -> BusStatistics:
        """What has been sent, heard and missed."""
        return self._line.statistics

    def open(self) -> None:
        """Open the line. Raises BusError."""
        with self._lock:
            self._line.open()

    def close(self) -> None:
        """Release the line; harmless when not open."""
        with self._lock:
            self._line.close()

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
            self._line.tell(protocol.BROADCAST, protocol.SYNC_WRITE, head + body)

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
            replies: dict[int, Reply | None] = dict.fromkeys(servo_ids)
            waiting = self._line.by_silence(servo_ids)
            fast = self.fast and self._fast_failures < _FAST_FAILURES
            passes = 0
            while waiting:
                for status in self._line.ask_all(waiting, address, size, fast):
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
                    self._line.missed(missing[0])
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
            self._line.wait_out_late(servo_ids)
            found = self._line.ask_all(servo_ids, address, size, fast=True)
            self.fast = len(found) == len(servo_ids)
            if not self.fast:
                # Servos that do not know it may answer something else, late.
                self._line.missed(*servo_ids)
            return self.fast

    # --- inside ---------------------------------------------------------------------------------------

    def _ask(
        self, servo_id: int, instruction: int, parameters: bytes, size: int, operation: str, retries: int
    ) -> Reply:
        with self._lock:
            garbage = self.statistics.skipped_bytes
            for attempt in range(1 + retries):
                self.statistics.retries += attempt > 0
                # A machine that is too busy to hear an answer in time is asked again with more time.
                patience = self._line.latency * (1 + 2 * attempt)
                found = self._line.ask(servo_id, instruction, parameters, size, patience)
                if found is not None:
                    error = found.error
                    if error & ~protocol.ALERT:
                        raise BusError(
                            self.name, operation, "refused", protocol.error_text(error), "check register and value"
                        )
                    return Reply(error, found.data)
                self._line.missed(servo_id)
            code = "corrupt" if self.statistics.skipped_bytes > garbage else "timeout"
            cause, remedy = _FAILURES[code]
            raise BusError(self.name, operation, code, cause, remedy)

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


_FAILURES = {
    "timeout": ("no answer", "check the cable and the 12 V supply, the servo's ID and the baud rate"),
    "corrupt": ("only broken answers", "check for two servos with the same ID, loose plugs, and the USB cable"),
}

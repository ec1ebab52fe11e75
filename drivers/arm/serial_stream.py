"""The serial port as a byte stream: exclusive, blocking, low latency, and gone means gone.

A `pyserial` port with no time-out polls, one with a time-out waits for every byte asked for, and setting its
time-out reconfigures the terminal. Here `poll` waits for the first byte and one read takes what has arrived.
"""

from __future__ import annotations

import contextlib
import os
import select
from pathlib import Path

import serial

from controller.errors import BusError

try:
    import fcntl
    import termios

    # `termios.error` is neither an OSError nor pyserial's exception, yet it is what an unplugged port may raise.
    PORT_ERRORS: tuple[type[Exception], ...] = (OSError, termios.error)
except ImportError:  # not a POSIX system: simulations run there, serial ports are refused
    PORT_ERRORS = (OSError,)
_OPEN_ERRORS: tuple[type[Exception], ...] = (*PORT_ERRORS, ValueError)

MAX_LATENCY_MS = 2.0
"""Largest latency timer of an adapter to work with: at FTDI's factory 16 ms a cycle cannot exceed 63 Hz."""

_LOST_REMEDY = "check the USB cable and the adapter, then open the arm again"


class SerialStream:
    """A serial device, or a pseudo-terminal. Reopens after a loss.

    Args:
        path: Device, preferably a stable link such as `/dev/serial/by-id/...`.

    Attributes:
        latency_ms: The adapter's latency timer as read back; None where there is none.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._port: serial.Serial | None = None
        self._poll: select.poll | None = None
        self.latency_ms: float | None = None

    @property
    def name(self) -> str:
        """The path it was given."""
        return self._path

    def open(self, baud: int) -> None:
        """Open exclusively at `baud` bit/s and ask the adapter for its lowest latency.

        Raises:
            BusError: code `lost` (no such port), `busy` (held by another process) or `refused` (no permission,
                a baud rate the port cannot do, or a latency timer above 2 ms that cannot be lowered).
        """
        self.close()
        if not hasattr(select, "poll"):
            raise BusError(self._path, "open", "refused", "serial ports need Linux or macOS", "run with --sim here")
        try:
            # The lock keeps out programs that ask for it, TIOCEXCL everyone but root. On a pseudo-terminal, which
            # its other end keeps open, TIOCEXCL would outlive a killed process.
            self._port = serial.Serial(self._path, baud, timeout=0, exclusive=True)
            if not str(Path(self._path).resolve()).startswith("/dev/pts/"):
                fcntl.ioctl(self._port.fileno(), termios.TIOCEXCL)
            self._port.reset_input_buffer()
            self._poll = select.poll()
            self._poll.register(self._port.fileno(), select.POLLIN)
        except _OPEN_ERRORS as error:
            self.close()
            raise _open_error(self._path, baud, error) from error
        with contextlib.suppress(*PORT_ERRORS, ValueError, NotImplementedError, AttributeError):
            # Sets the FTDI's timer to 1 ms; pseudo-terminals and some adapters have no such setting.
            self._port.set_low_latency_mode(True)
        self.latency_ms = _latency_timer(self._path)
        if self.latency_ms is not None and self.latency_ms > MAX_LATENCY_MS:
            latency = self.latency_ms
            self.close()
            raise BusError(
                self._path,
                "open",
                "refused",
                f"the adapter's latency timer is {latency:g} ms",
                'install the udev rule (ATTR{latency_timer}="1") or write 1 to its latency_timer as root',
            )

    def close(self) -> None:
        """Release the port; harmless when not open."""
        port, self._port, self._poll = self._port, None, None
        if port is not None:
            with contextlib.suppress(*PORT_ERRORS):
                port.close()

    def write(self, data: bytes) -> None:
        """Hand bytes to the system. Raises BusError, code `lost`."""
        fd = self._fd("write")
        try:
            while data:
                data = data[os.write(fd, data) :]
        except BlockingIOError as error:
            raise self._lost("write", "its output stays full") from error
        except OSError as error:
            raise self._lost("write", str(error)) from error

    def read(self, size: int, timeout: float) -> bytes:
        """Up to `size` bytes as soon as any have arrived; empty after `timeout` s. Raises BusError, code `lost`."""
        fd = self._fd("read")
        assert self._poll is not None  # opened together with the port
        try:
            if not self._poll.poll(timeout * 1000.0):
                return b""
            data = os.read(fd, size)
        except OSError as error:
            raise self._lost("read", str(error)) from error
        if not data:
            raise self._lost("read", "it has been unplugged")
        return data

    def discard_input(self) -> None:
        """Drop what has arrived. Raises BusError, code `lost`."""
        self._fd("discard input")
        assert self._port is not None
        try:
            self._port.reset_input_buffer()
        except PORT_ERRORS as error:
            raise self._lost("discard input", str(error)) from error

    def _fd(self, operation: str) -> int:
        if self._port is None:
            raise BusError(self._path, operation, "lost", "the port is not open", _LOST_REMEDY)
        return int(self._port.fileno())

    def _lost(self, operation: str, cause: str) -> BusError:
        self.close()
        return BusError(self._path, operation, "lost", cause, _LOST_REMEDY)


def _open_error(path: str, baud: int, error: Exception) -> BusError:
    if not Path(path).exists():
        return BusError(path, "open", "lost", "there is no such port", "plug the adapter in; see `controller doctor`")
    text = str(error)
    if "exclusively lock" in text or "[Errno 16]" in text:
        return BusError(path, "open", "busy", "another process holds the port", "end the other program")
    if "[Errno 13]" in text:
        return BusError(path, "open", "refused", "permission denied", "join the group `dialout` and log in again")
    return BusError(path, "open", "refused", f"cannot be opened at {baud} bit/s ({text})", "check path and baud rate")


def _latency_timer(path: str) -> float | None:
    """The adapter's latency timer, ms, from the system's own record."""
    try:
        device = Path("/sys/class/tty") / Path(path).resolve().name / "device" / "latency_timer"
        return float(device.read_text())
    except (OSError, ValueError):
        return None

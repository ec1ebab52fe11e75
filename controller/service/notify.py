"""Telling the service manager how we are: the few lines of sd_notify(3) that a service needs.

Without `NOTIFY_SOCKET` in the environment every call does nothing, so that the same program runs in a terminal.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from typing import Self

_SEND_TIMEOUT = 1.0  # s; the service manager's queue may be full, and nobody may wait for it for long


class Notifier:
    """Sends state to the service manager; never raises, as no work may depend on who is listening.

    Args:
        address: Of a datagram socket: a path, or `@` and an abstract name; None to say nothing.
        watchdog: s within which the manager wants to hear from us again and again; None when it does not.

    Source: sd_notify(3), sd_watchdog_enabled(3).
    """

    def __init__(self, address: str | None, watchdog: float | None = None) -> None:
        self.watchdog = watchdog
        self._address = "\0" + address[1:] if address and address.startswith("@") else address

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] | None = None) -> Self:
        """What `NOTIFY_SOCKET`, `WATCHDOG_USEC` and `WATCHDOG_PID` ask for."""
        given = os.environ if environment is None else environment
        address = given.get("NOTIFY_SOCKET", "")
        if not address.startswith(("/", "@")) or not hasattr(socket, "AF_UNIX"):
            return cls(None)
        return cls(address, _watchdog(given))

    @property
    def listening(self) -> bool:
        """Whether there is a service manager to talk to."""
        return self._address is not None

    def ready(self, status: str) -> None:
        """Start-up, or a reload, is done."""
        self._send("READY=1", _status(status))

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        self._send(_status(text))

    def reloading(self) -> None:
        """A reload has begun; `ready` says its end."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self, status: str) -> None:
        """The end has begun."""
        self._send("STOPPING=1", _status(status))

    def pet(self) -> None:
        """All is well; to be said at least every `watchdog` seconds."""
        self._send("WATCHDOG=1")

    def _send(self, *assignments: str) -> None:
        if self._address is None:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as line:
                line.settimeout(_SEND_TIMEOUT)
                line.sendto("\n".join(assignments).encode(), self._address)
        except OSError:
            return


def _watchdog(environment: Mapping[str, str]) -> float | None:
    """The manager's watchdog interval, s, when it is meant for this process."""
    try:
        microseconds = int(environment.get("WATCHDOG_USEC", "0"))
        process = int(environment.get("WATCHDOG_PID", str(os.getpid())))
    except ValueError:
        return None
    return microseconds / 1e6 if microseconds > 0 and process == os.getpid() else None


def _status(text: str) -> str:
    # A line break would begin another assignment, e.g. one that ends the service.
    return "STATUS=" + "".join(c if c.isprintable() else " " for c in text)

"""Signals as requests: Ctrl-C and SIGTERM so that the arm comes to rest along its path, SIGHUP to read again."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType


@contextmanager
def on_interrupt(stop: Callable[[], None], message: str) -> Iterator[list[int]]:
    """Call `stop` on Ctrl-C and SIGTERM; a second one gives up waiting. Yields the signals received so far."""
    received: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt
        stop()
        # The handler may have interrupted a print: only the bare descriptor may be written to here.
        with suppress(OSError):
            os.write(2, f"\n{message}\n".encode())

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def on_hangup(reload: Callable[[], None]) -> Iterator[None]:
    """Call `reload` on SIGHUP, as a service manager sends it."""
    before = signal.signal(signal.SIGHUP, lambda number, frame: reload())
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


def exit_code(received: list[int]) -> int:
    """130 after Ctrl-C, else 0."""
    return 130 if signal.SIGINT in received else 0

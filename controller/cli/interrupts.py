"""Signals as requests: Ctrl-C and SIGTERM so that the arm comes to rest along its path, SIGHUP to read again."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from controller.cycle.requests import Interrupted


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
def ends_question() -> Iterator[None]:
    """Inside `on_interrupt` and around a question to a person: what asks for the end ends the question too.

    Otherwise the question would wait on for its answer, and the end for the question.

    Raises:
        Interrupted: The end was asked for.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def handle(number: int, frame: FrameType | None) -> None:
        handler = before[signal.Signals(number)]
        if callable(handler):
            handler(number, frame)
        raise Interrupted

    for number in before:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def on_hangup(reload: Callable[[], None], stop: Callable[[], None]) -> Iterator[None]:
    """Call `reload` on SIGHUP, as a service manager or a person sends it; `stop` when the terminal was closed."""
    at_terminal = os.isatty(2)

    def handle(number: int, frame: FrameType | None) -> None:
        # Of a terminal that was closed nothing is left to ask.
        closed = at_terminal and not os.isatty(2)
        (stop if closed else reload)()

    before = signal.signal(signal.SIGHUP, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


def exit_code(received: list[int]) -> int:
    """130 after Ctrl-C, else 0."""
    return 130 if signal.SIGINT in received else 0

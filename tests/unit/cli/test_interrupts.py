"""Ctrl-C is a request that may come at any moment, in the middle of a print as well."""

from __future__ import annotations

import io
import os
import signal
import sys

import pytest

from controller.cli.interrupts import ends_question, exit_code, on_hangup, on_interrupt
from controller.cycle.requests import Interrupted


def test_a_signal_in_the_middle_of_a_print_only_asks_for_a_stop(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    class Interrupted(io.RawIOBase):
        def writable(self) -> bool:
            return True

        def write(self, data: object) -> int:
            os.kill(os.getpid(), signal.SIGINT)
            return memoryview(data).nbytes  # type: ignore[arg-type]  # a buffer, whatever its type

    asked: list[bool] = []
    stream = io.TextIOWrapper(io.BufferedWriter(Interrupted()), encoding="utf-8")
    monkeypatch.setattr(sys, "stderr", stream)
    with on_interrupt(lambda: asked.append(True), "stopping") as received:
        print("a line", file=sys.stderr, flush=True)
    assert asked == [True]
    assert exit_code(received) == 130
    assert "stopping" in capfd.readouterr().err
    stream.detach()


def test_a_second_one_gives_up_waiting() -> None:
    def interrupt_twice() -> None:
        with on_interrupt(lambda: None, "stopping"):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        interrupt_twice()


def test_it_ends_a_question_too_which_would_wait_for_its_answer() -> None:
    asked: list[str] = []

    def question() -> None:
        with ends_question():
            signal.raise_signal(signal.SIGINT)
            asked.append("waits on")

    with on_interrupt(lambda: asked.append("stop"), "stopping") as received:
        with pytest.raises(Interrupted):
            question()
        assert asked == ["stop"]
        # What comes after the question is only asked for, as before it.
        received.clear()
        signal.raise_signal(signal.SIGTERM)
    assert asked == ["stop", "stop"]


@pytest.mark.parametrize(
    ("terminal_before", "terminal_then", "does"),
    [(False, False, "reload"), (True, True, "reload"), (True, False, "stop")],
)
def test_a_hangup_reloads_but_stops_when_the_terminal_was_closed(
    monkeypatch: pytest.MonkeyPatch, terminal_before: bool, terminal_then: bool, does: str
) -> None:
    done: list[str] = []
    monkeypatch.setattr(os, "isatty", lambda descriptor: terminal_before)
    with on_hangup(lambda: done.append("reload"), lambda: done.append("stop")):
        monkeypatch.setattr(os, "isatty", lambda descriptor: terminal_then)
        signal.raise_signal(signal.SIGHUP)
    assert done == [does]

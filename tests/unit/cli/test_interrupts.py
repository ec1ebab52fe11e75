"""Ctrl-C is a request that may come at any moment, in the middle of a print as well."""

from __future__ import annotations

import io
import os
import signal
import sys

import pytest

from controller.cli.interrupts import exit_code, on_interrupt


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

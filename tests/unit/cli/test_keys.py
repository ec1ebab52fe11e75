"""The client side of jogging: which keys mean what, and whose silence stops the arm."""

from __future__ import annotations

import os
import pty
import select
import threading
import tty
from collections.abc import Iterator

import pytest

from controller.cli.keys import Client, Echo, Keys
from controller.service.jogging import DeadMan

QUERY = b"\x1b[5n"
READY = b"\x1b[0n"


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    """(the person's end, the program's end) of a terminal that is stdin."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    with os.fdopen(os.dup(theirs)) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield ours, theirs
    for end in (ours, theirs):
        os.close(end)


def _asked(ours: int, timeout: float = 5.0) -> bool:
    return bool(select.select([ours], [], [], timeout)[0]) and QUERY in os.read(ours, 4096)


def test_answers_are_no_keys(terminal: tuple[int, int]) -> None:
    echo = Echo(terminal[1])
    found = [(echo.keys(typed), echo.answers) for typed in ("w", "s\x1b[0nd\x1b[A")]
    assert found == [("w", False), ("sd\x1b[A", True)]
    # Cut anywhere, an answer and an arrow key stay what they are.
    for whole, keys in (("\x1b[0n", ""), ("\x1b[A", "\x1b[A")):
        for cut in range(1, len(whole)):
            assert echo.keys(whole[:cut]) + echo.keys(whole[cut:]) == keys


def test_it_asks_again_only_after_an_answer(terminal: tuple[int, int]) -> None:
    ours, theirs = terminal
    echo = Echo(theirs)
    echo.ask()
    echo.ask()
    assert os.read(ours, 100) == QUERY
    echo.keys(READY.decode())
    echo.ask()
    assert _asked(ours)


def test_a_terminal_that_falls_silent_stops_the_arm(terminal: tuple[int, int]) -> None:
    ours, _ = terminal
    stopped = threading.Event()
    dead_man = DeadMan(stopped.set)
    client = Client(dead_man.beat, stopped.set, Keys(lambda line: None))
    with client.reading(), dead_man.watching():
        client.ready()
        for _ in range(3):
            assert _asked(ours)
            assert not stopped.is_set()
            os.write(ours, READY)
        os.write(ours, b"w")
        assert client.next() == "x+ 5"
        # The reader is as alive as before; the terminal no longer is.
        assert stopped.wait(5.0)
        assert dead_man.lost
        os.write(ours, READY)
        client.ready()
        os.write(ours, b"s")
        assert client.next() == "x- 5"
        dead_man.rearm()


def test_a_terminal_that_never_answers_is_told_so_and_can_jog(terminal: tuple[int, int]) -> None:
    ours, _ = terminal
    said: list[str] = []
    beats: list[int] = []
    told = threading.Event()

    def beat() -> None:
        beats.append(1)
        if len(beats) > 5:
            told.set()

    client = Client(beat, lambda: None, Keys(said.append))
    with client.reading():
        client.ready()
        os.write(ours, b"w")
        assert client.next() == "x+ 5"
        assert told.wait(5.0)
    assert "answers no status query" in said[0]

"""Progress on a terminal: it leaves room for a question, and its end is no failure of the run."""

from __future__ import annotations

import errno
import io

from rich.console import Console

from controller.cli.progress import Progress
from controller.cycle.machine import State


class _Closed(io.StringIO):
    """A terminal that somebody closes."""

    gone = False

    def write(self, text: str) -> int:
        if self.gone:
            raise OSError(errno.EIO, "Input/output error")
        return super().write(text)


def test_a_question_is_not_wiped_out_by_the_live_line() -> None:
    screen = io.StringIO()
    with Progress(Console(file=screen, force_terminal=True)) as progress:
        with progress.away():
            shown = screen.getvalue()
            assert progress._status is not None
            assert not progress._status._live.is_started
            assert screen.getvalue() == shown
        assert progress._status._live.is_started


def test_a_run_does_not_end_for_a_terminal_that_was_closed() -> None:
    screen = _Closed()
    with Progress(Console(file=screen, force_terminal=True)) as progress:
        progress.say("a line")
        screen.gone = True
        progress.say("another")
        progress.entered(State.PICK, 1.0)
    assert "a line" in screen.getvalue()
    assert "another" not in screen.getvalue()

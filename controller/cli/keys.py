"""The client side of jogging: keys of a terminal, or lines of a pipe, and the heartbeat of whoever gives them.

The heartbeat of a terminal is its own answer to a status query, every 50 ms: it comes the same way as the keys, so
that a frozen connection or window, from which no `stop` would come either, stops the arm.
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import select
import sys
import threading
from collections.abc import Callable, Iterator

from controller.errors import InputError
from controller.service.jogging import HEARTBEAT, LARGEST_STEP_MM, STEP_DEG, STEP_MM

BEAT = 0.05
"""s between two heartbeats at most."""

HELP = (
    "arrows or w s a d: x and y   r f: up, down   1..9 then , .: turn that joint   o c: jaws\n"
    "+ -: step size   space: stop   enter: where   q: quit (the arm keeps holding)"
)

_ARROWS = {"\x1b[A": "w", "\x1b[B": "s", "\x1b[D": "a", "\x1b[C": "d", "\x1b[5~": "r", "\x1b[6~": "f"}
_STEPS = {"w": "x+", "s": "x-", "a": "y+", "d": "y-", "r": "z+", "f": "z-"}
_SMALLEST_STEP_MM = 0.5


class Keys:
    """Turns keys into the lines that `parse` understands; knows the step size and the chosen joint.

    Args:
        say: Takes lines for people.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.say = say
        self._step = STEP_MM
        self._joint = 1

    def lines(self, typed: str) -> list[str]:
        """The commands of what was typed since the last call."""
        for sequence, key in _ARROWS.items():
            typed = typed.replace(sequence, key)
        return [line for line in map(self._line, typed.replace("\x1b", " ")) if line]

    def _line(self, key: str) -> str:
        if key in _STEPS:
            return f"{_STEPS[key]} {self._step:g}"
        if key in ",.":
            return f"j{self._joint}{'+' if key == '.' else '-'} {STEP_DEG * self._step / STEP_MM:g}"
        if key in "oc":
            return f"jaws{'+' if key == 'o' else '-'} {self._step:g}"
        if key in "123456789":
            self._joint = int(key)
            self.say(f"joint {key}")
        elif key in "+-":
            factor = 2.0 if key == "+" else 0.5
            # Of the joint's step, which is smaller, the bound is never met before this one.
            self._step = min(max(self._step * factor, _SMALLEST_STEP_MM), LARGEST_STEP_MM)
            self.say(f"steps of {self._step:g} mm, {STEP_DEG * self._step / STEP_MM:g} deg")
        return {" ": "stop", "\r": "where", "\n": "where", "q": "q", "\x04": "q"}.get(key, "")


class Echo:
    """Asks a terminal whether it is there.

    Source: ECMA-48, Device Status Report: `CSI 5 n` asks, `CSI 0 n` answers "ready" (`CSI 3 n`: "malfunction").

    Attributes:
        answers: The terminal has answered before; one that never does cannot be told from one that is gone.

    Args:
        descriptor: Of the terminal.
    """

    def __init__(self, descriptor: int) -> None:
        self.answers = False
        self._descriptor = descriptor
        self._waiting = False
        self._cut = ""

    def ask(self) -> None:
        """Ask, unless an answer is still due; never blocks, even when the terminal takes no more."""
        if not self._waiting and select.select([], [self._descriptor], [], 0.0)[1]:
            with contextlib.suppress(OSError):
                os.write(self._descriptor, b"\x1b[5n")
                self._waiting = True

    def keys(self, typed: str) -> str:
        """What was typed without the answers in it."""
        text, answers = _ANSWER.subn("", self._cut + typed)
        self.answers = self.answers or answers > 0
        # A terminal that sends keys is there: an answer that got lost is not waited for.
        self._waiting = self._waiting and not answers and not text
        self._cut = found[0] if (found := _CUT.search(text)) else ""
        return text[: len(text) - len(self._cut)]

    def settle(self) -> None:
        """Wait for the last answer, so that it is not typed into the shell."""
        while self.answers and self._waiting and select.select([self._descriptor], [], [], HEARTBEAT)[0]:
            if not (typed := _typed(self._descriptor)):
                return
            self.keys(typed)


_ANSWER = re.compile(r"\x1b\[[03]n")
_CUT = re.compile(r"\x1b(\[\d?)?$")  # the beginning of an answer or of an arrow key


class Client:
    """Reads commands in a thread and beats as long as those who give them are there.

    From a terminal, a key that comes while the arm moves is dropped, so that nothing goes on after the key is let
    go; `stop` acts at once. From a pipe every line is kept, and its end means `q`.

    Args:
        beat: The heartbeat.
        stop: Stops the arm at once, from this thread.
        keys: Set when keys of a terminal are to be read instead of lines.
    """

    def __init__(self, beat: Callable[[], None], stop: Callable[[], None], keys: Keys | None) -> None:
        self._beat = beat
        self._stop = stop
        self._keys = keys
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._idle = threading.Event()
        self._ended = threading.Event()

    def ready(self) -> None:
        """The arm stands: the next key counts."""
        self._idle.set()

    def next(self) -> str:
        """Wait for the next command."""
        line = self._lines.get()
        self._idle.clear()
        return line

    def forget(self) -> None:
        """Drop what waits to be done."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._lines.get_nowait()

    def quit(self) -> None:
        """Make `q` the next command; from any thread or signal handler."""
        self.forget()
        self._lines.put("q")

    @contextlib.contextmanager
    def reading(self) -> Iterator[None]:
        """Read stdin for as long as the context lasts; a terminal gives single keys meanwhile."""
        descriptor = sys.stdin.fileno()
        with _single_keys(descriptor) if self._keys is not None else contextlib.nullcontext():
            thread = threading.Thread(target=self._read, args=(descriptor,), name="keys", daemon=True)
            thread.start()
            try:
                yield
            finally:
                self._ended.set()
                thread.join()

    def _read(self, descriptor: int) -> None:
        if self._keys is not None:
            self._read_keys(descriptor, self._keys)
            return
        left = ""
        while not self._ended.is_set():
            self._beat()
            if not select.select([descriptor], [], [], BEAT)[0]:
                continue
            typed = _typed(descriptor)
            *lines, left = (left + typed).split("\n") if typed else (left, "q", "")
            self._queue(lines)
            if not typed:
                break
        # Whoever wrote into the pipe has said all: the lines are his intent, and this thread stands for him.
        while not self._ended.wait(BEAT):
            self._beat()

    def _read_keys(self, descriptor: int, keys: Keys) -> None:
        echo = Echo(descriptor)
        echo.ask()
        warned = False
        while not self._ended.is_set():
            if not echo.answers:
                self._beat()
            if not select.select([descriptor], [], [], BEAT)[0]:
                echo.ask()
                continue
            typed = _typed(descriptor)
            if not typed:
                # The terminal is gone, and with it whoever watched the arm.
                self._stop()
                self.quit()
                return
            self._beat()
            lines = keys.lines(echo.keys(typed))
            if lines and not echo.answers and not warned:
                warned = True
                keys.say("this terminal answers no status query: a connection that freezes will not stop the arm")
            self._take(lines)
        echo.settle()

    def _queue(self, lines: list[str]) -> None:
        for line in lines:
            if line.strip():
                self._lines.put(line)

    def _take(self, lines: list[str]) -> None:
        for line in lines:
            if line == "stop":
                self._stop()
                self.forget()
                self._lines.put(line)
            elif self._idle.is_set() and self._lines.empty():
                self._lines.put(line)
            elif line == "q":
                self._stop()
                self.quit()


def _typed(descriptor: int) -> str:
    try:
        return os.read(descriptor, 4096).decode("utf-8", "replace")
    except OSError:
        return ""


@contextlib.contextmanager
def _single_keys(descriptor: int) -> Iterator[None]:
    """A terminal that hands over every key at once and does not echo it; Ctrl-C still interrupts."""
    try:
        import termios
        import tty
    except ImportError as error:
        raise InputError("no terminal control on this system", "pipe commands into `controller jog`") from error
    before = termios.tcgetattr(descriptor)
    tty.setcbreak(descriptor)
    try:
        yield
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)

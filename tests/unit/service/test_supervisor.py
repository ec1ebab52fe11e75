"""The watchdog is fed only while every loop moves: in steps, and in a real process that is stopped or spins."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import pytest

from controller.domain import PickPlan
from controller.service.notify import Notifier
from controller.service.standing_service import Service
from controller.service.supervisor import STANDALONE_PERIOD, Supervisor, WatchedClock
from sim_backends.virtual_clock import VirtualClock


class Bench:
    """A supervisor whose looks the test takes itself, on a clock the test moves."""

    def __init__(self) -> None:
        self.pets = 0
        self.hangs: list[tuple[str, ...]] = []
        self.time = 0.0
        self.supervisor = Supervisor(self._pet, 10.0, on_hang=self.hangs.append, now=lambda: self.time)

    def _pet(self) -> None:
        self.pets += 1

    def look(self) -> bool:
        """Whether the next look fed the watchdog."""
        before = self.pets
        self.time += self.supervisor.period
        self.supervisor.check()
        return self.pets > before


def test_looks_twice_within_the_managers_interval() -> None:
    assert Supervisor(lambda: None, 10.0).period == 5.0
    assert Supervisor(lambda: None, None).period == STANDALONE_PERIOD


def test_a_person_who_is_asked_may_take_his_time() -> None:
    bench = Bench()
    service = Service(Notifier(None), bench.supervisor, bench.supervisor.register("cycle"))
    plan = cast(PickPlan, None)
    answers = iter((True, False))

    def ask(asked: PickPlan) -> bool:
        assert all(bench.look() for _ in range(5))
        return next(answers)

    assert [service.while_idle(ask)(plan) for _ in range(2)] == [True, False]
    assert bench.look()
    assert not bench.look()  # watched again


@pytest.mark.safety("SR-26")
def test_one_loop_that_stands_still_among_many_is_enough() -> None:
    bench = Bench()
    loops = [bench.supervisor.register(name) for name in ("cycle", "control", "camera")]
    for _ in range(3):
        for loop in loops:
            loop.progress()
        assert bench.look()
    for loop in loops[:2]:
        loop.progress()
    assert not bench.look()
    assert bench.hangs == [("camera",)]


def test_a_loop_that_moves_again_is_forgiven_and_said_so() -> None:
    bench = Bench()
    loop = bench.supervisor.register("cycle")
    assert bench.look()
    assert not bench.look()
    assert not bench.look()
    loop.progress()
    assert bench.look()
    assert bench.hangs == [("cycle",), ()]


def test_a_loop_that_waits_need_not_move_until_it_is_woken() -> None:
    bench = Bench()
    loop = bench.supervisor.register("cycle")
    loop.idle()
    assert all(bench.look() for _ in range(5))
    loop.progress()
    assert bench.look()
    assert not bench.look()


def test_a_patient_loop_may_take_its_time_but_not_more() -> None:
    bench = Bench()
    bench.supervisor.register("camera", patience=12.0)
    # Looks come every 5 s: 5 s and 10 s of standing are within 12 s, 15 s are not.
    assert [bench.look() for _ in range(4)] == [True, True, True, False]


def test_a_forgotten_loop_is_not_waited_for() -> None:
    bench = Bench()
    bench.supervisor.forget(bench.supervisor.register("calibration"))
    assert all(bench.look() for _ in range(3))


def test_the_stack_of_a_hung_loop_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()
    bench.supervisor.register("cycle").progress()
    bench.look()
    with caplog.at_level(logging.ERROR):
        bench.look()
    assert "cycle stands still" in caplog.text
    assert "test_the_stack_of_a_hung_loop_is_logged" in caplog.text


def test_sleeping_on_the_watched_clock_is_progress() -> None:
    bench, clock = Bench(), VirtualClock()
    watched = WatchedClock(clock, bench.supervisor.register("cycle"))
    bench.look()
    watched.sleep(0.01)
    assert bench.look()
    watched.charge(0.05)
    assert bench.look()
    watched.now()
    assert not bench.look()
    assert clock.now() == watched.now() == pytest.approx(0.06)


# --- a real process, as the service manager sees it --------------------------------------------------------

_PERIOD = 0.1  # s between looks of the child at its loop, which moves twenty times as often
_SILENCE = 0.8  # s of waiting for a datagram that must not come: 8 periods

_CHILD = f"""
import re, sys, threading
from controller.service.notify import Notifier
from controller.service.supervisor import Supervisor
notifier = Notifier.from_environment()
hang = lambda names: notifier.status("hung: " + ", ".join(names))
with Supervisor(notifier.pet, {2 * _PERIOD}, on_hang=hang) as supervisor:
    loop = supervisor.register("cycle")
    told = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.readline(), told.set()), daemon=True).start()
    notifier.ready("moving")
    while not told.wait({_PERIOD / 20}):
        loop.progress()
    {{after}}
"""


@contextmanager
def _child(folder: Path, after: str) -> Iterator[tuple[subprocess.Popen[bytes], socket.socket]]:
    """A process with one loop that moves until it reads a line, and then does `after`."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(folder / "n"))
        line.settimeout(20.0)
        environment = os.environ | {"NOTIFY_SOCKET": str(folder / "n"), "PYTHONPATH": os.pathsep.join(sys.path)}
        process = subprocess.Popen(
            [sys.executable, "-c", _CHILD.format(after=after)],
            env=environment,
            stdin=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        with process:
            try:
                assert line.recv(4096).startswith(b"READY=1")
                yield process, line
            finally:
                process.kill()


def _tell(process: subprocess.Popen[bytes]) -> None:
    assert process.stdin is not None
    process.stdin.write(b"\n")
    process.stdin.flush()


def _drain(line: socket.socket) -> None:
    line.setblocking(False)
    try:
        while True:
            line.recv(4096)
    except BlockingIOError:
        pass


def _falls_silent(line: socket.socket) -> bool:
    line.settimeout(_SILENCE)
    try:
        line.recv(4096)
    except TimeoutError:
        return True
    return False


@pytest.mark.safety("SR-26")
def test_a_stopped_process_says_nothing_and_goes_on_when_continued(tmp_path: Path) -> None:
    with _child(tmp_path, "pass") as (process, line):
        assert [line.recv(4096) for _ in range(3)] == [b"WATCHDOG=1"] * 3
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
        _drain(line)
        assert _falls_silent(line)
        process.send_signal(signal.SIGCONT)
        line.settimeout(20.0)
        heard = line.recv(4096)
        while heard != b"WATCHDOG=1":  # the supervisor may first notice that nothing has moved
            heard = line.recv(4096)


@pytest.mark.safety("SR-26")
def test_a_loop_that_spins_without_progress_ends_the_reassurance(tmp_path: Path) -> None:
    with _child(tmp_path, "while True: pass") as (process, line):
        assert line.recv(4096) == b"WATCHDOG=1"
        _tell(process)
        heard = line.recv(4096)
        while heard == b"WATCHDOG=1":
            heard = line.recv(4096)
        assert heard == b"STATUS=hung: cycle"
        assert _falls_silent(line)
        assert process.poll() is None


def test_a_loop_that_never_gives_up_the_interpreter_ends_the_reassurance(tmp_path: Path) -> None:
    # One call into C that holds the interpreter's lock for ages: no other thread of the process runs any more.
    with _child(tmp_path, "notifier.status('begins'); re.match('(a+)+b', 'a' * 60)") as (process, line):
        _tell(process)
        heard = line.recv(4096)
        while heard == b"WATCHDOG=1":
            heard = line.recv(4096)
        assert heard == b"STATUS=begins"
        line.settimeout(_SILENCE)
        last: list[bytes] = []
        try:
            while len(last) < 8:
                last.append(line.recv(4096))
        except TimeoutError:
            pass
        # What was under way when the lock was taken may still come; a supervisor that runs would go on to 8.
        assert len(last) < 3
        assert process.poll() is None

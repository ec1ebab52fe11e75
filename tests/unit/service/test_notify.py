"""The notify protocol on real datagram sockets: by path, by abstract name, and with nobody there."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.service.notify import Notifier


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """A service manager's socket and its address as the environment names it."""
    name = str(tmp_path / "n") if request.param == "path" else f"@sorting-controller-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(name.replace("@", "\0", 1) if name.startswith("@") else name)
        line.settimeout(5.0)
        yield line, name


def test_says_what_the_manager_understands(manager: tuple[socket.socket, str]) -> None:
    line, name = manager
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": name})
    assert notifier.listening
    notifier.ready("STOPPED")
    notifier.pet()
    notifier.status("EXECUTE: 3 placed")
    notifier.stopping("parking")
    said = [line.recv(4096).decode().split("\n") for _ in range(4)]
    assert said == [
        ["READY=1", "STATUS=STOPPED"],
        ["WATCHDOG=1"],
        ["STATUS=EXECUTE: 3 placed"],
        ["STOPPING=1", "STATUS=parking"],
    ]


def test_a_reload_carries_the_time_of_the_monotonic_clock(manager: tuple[socket.socket, str]) -> None:
    line, name = manager
    before = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
    Notifier.from_environment({"NOTIFY_SOCKET": name}).reloading()
    first, second = line.recv(4096).decode().split("\n")
    assert first == "RELOADING=1"
    # systemd compares it with CLOCK_MONOTONIC, in microseconds.
    assert before <= int(second.removeprefix("MONOTONIC_USEC=")) <= time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000


def test_a_status_cannot_smuggle_in_another_assignment(manager: tuple[socket.socket, str]) -> None:
    line, name = manager
    Notifier.from_environment({"NOTIFY_SOCKET": name}).status("servo 3\nSTOPPING=1\x00\r")
    assert line.recv(4096) == b"STATUS=servo 3 STOPPING=1  "


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "vsock:2:1234"}])
def test_is_silent_without_a_manager_it_can_reach(environment: dict[str, str]) -> None:
    notifier = Notifier.from_environment(environment | {"WATCHDOG_USEC": "10000000"})
    assert not notifier.listening
    assert notifier.watchdog is None
    notifier.ready("")
    notifier.pet()


def test_a_manager_that_went_away_is_no_failure(tmp_path: Path) -> None:
    Notifier.from_environment({"NOTIFY_SOCKET": str(tmp_path / "gone")}).ready("")


@pytest.mark.parametrize(
    ("environment", "seconds"),
    [
        ({"WATCHDOG_USEC": "10000000"}, 10.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid())}, 10.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid() + 1)}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_the_watchdog_interval_is_read_when_it_is_meant_for_this_process(
    environment: dict[str, str], seconds: float | None
) -> None:
    assert Notifier.from_environment({"NOTIFY_SOCKET": "/nowhere"} | environment).watchdog == seconds

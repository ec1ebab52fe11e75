"""`controller run` as the service manager runs it: a program of its own, on a machine where nothing is plugged in."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from controller.calibration import store
from controller.config.files import shipped
from controller.service.client import ControlClient
from tests.system.conftest import Controller
from tests.unit.calibration.certified import certify
from tests.unit.calibration.test_store import parts

CELL = (
    shipped("cell.toml").read_text(encoding="utf-8")
    .replace("/dev/sorter-cam", "/dev/no-camera-here")
    .replace("/dev/sorter-arm", "/dev/no-port-here")
)  # fmt: skip


@contextmanager
def service(folder: Path, environment: dict[str, str]) -> Iterator[tuple[subprocess.Popen[bytes], socket.socket]]:
    """The program with what the unit gives it, and the manager's end of its socket."""
    camera, table, arm = parts()
    devices = {"camera": "/dev/no-camera-here", "port": "/dev/no-port-here"}
    (folder / "calibration").mkdir(parents=True)
    store.save(folder / "calibration", camera=camera, table=table, arm=arm, provenance=devices)
    certify(folder / "calibration", **devices)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(folder / "notify"))
        line.settimeout(30.0)
        given = {"NOTIFY_SOCKET": str(folder / "notify"), "STATE_DIRECTORY": str(folder), "WATCHDOG_USEC": "1000000"}
        command = [sys.executable, "-m", "controller.cli", "run", "--config", str(folder.parent / "cell.toml")]
        with subprocess.Popen(command, env=environment | given, stderr=subprocess.DEVNULL) as process:
            try:
                yield process, line
            finally:
                process.kill()


def hears(line: socket.socket, wanted: str) -> None:
    """Wait until the service says something, whatever it says before."""
    while wanted not in line.recv(4096).decode().split("\n"):
        pass


@pytest.mark.safety("SR-01", "SR-03", "SR-04")
def test_a_service_from_its_start_to_its_end(
    controller: Controller, environment: dict[str, str], tmp_path: Path
) -> None:
    config, state = tmp_path / "cell.toml", tmp_path / "state"
    config.write_text(CELL, encoding="utf-8")
    with service(state, environment) as (process, line):
        # Ready although nothing is plugged in: an alarm says so, and it goes on reassuring the manager.
        hears(line, "READY=1")
        hears(line, "WATCHDOG=1")
        operator = ControlClient(state)
        status = operator.ask("status")
        assert (status["state"], status["pid"]) == ("ABORTED", process.pid)
        assert "/dev/no-camera-here" in status["alarms"][0]["cause"]
        assert "/dev/no-port-here" in status["alarms"][0]["cause"]
        # There is one instance: another ends with 75, names this one, and has disturbed nothing.
        environment["STATE_DIRECTORY"] = str(state)
        second = controller("run", "--config", config)
        assert (second.returncode, second.stdout) == (75, "")
        assert f"process {process.pid}" in second.stderr
        # A hangup reads the configuration again; a wrong one is refused, and the old one stays.
        for text, changed in ((CELL + "[", False), (CELL.replace("speed_percent = 50", "speed_percent = 40"), True)):
            config.write_text(text, encoding="utf-8")
            process.send_signal(signal.SIGHUP)
            hears(line, "RELOADING=1")
            hears(line, "READY=1")
            assert (operator.ask("status")["config_digest"] != status["config_digest"]) == changed
        process.send_signal(signal.SIGTERM)
        hears(line, "STOPPING=1")
        # The unit gives it 60 s to park; here there is no arm that could.
        assert process.wait(20.0) == 0
    assert not (state / "control.sock").exists()


def test_a_wrong_configuration_ends_at_once_and_is_not_tried_again(
    controller: Controller, environment: dict[str, str], tmp_path: Path
) -> None:
    unit = shipped("systemd/controller.service").read_text(encoding="utf-8")
    assert "RestartPreventExitStatus=75 78" in unit
    (tmp_path / "cell.toml").write_text(CELL + "[", encoding="utf-8")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(tmp_path / "notify"))
        line.setblocking(False)
        environment["NOTIFY_SOCKET"] = str(tmp_path / "notify")
        assert controller("run", "--config", "cell.toml").returncode == 78
        with pytest.raises(BlockingIOError):
            line.recv(4096)  # it was never ready
    assert not (tmp_path / "state").exists()

"""A whole service as the service manager and operators see it: ready, started, stopped, killed, started again."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from controller.service.client import ControlClient, NotRunning

_SERVICE = """
import signal, threading
from controller.cycle.machine import State
from controller.service.client import runtime_folder
from controller.service.control import ControlServer, operators
from controller.service.notify import Notifier
from controller.service.operation import CellFacts, Operation
from controller.service.supervisor import Supervisor

class Work:
    fault = None
    def __init__(self): self.over = threading.Event()
    def run(self):
        operation.entered(State.CAPTURE, 0.0)
        while not self.over.wait(0.02): cycle.progress()
    def request_stop(self): self.over.set()
    def request_pause(self): pass
    def resume(self): pass

notifier = Notifier.from_environment()
operation = Operation(CellFacts("real", "cell.toml", "0", "c"), lambda: (), say=notifier.status)
signal.signal(signal.SIGTERM, lambda number, frame: operation.end())
with Supervisor(notifier.pet, notifier.watchdog) as supervisor:
    cycle = supervisor.register("cycle", patience=2.0)
    control = supervisor.register("control", patience=2.0)
    with ControlServer(runtime_folder(), operation, group=operators(), progress=control.progress):
        operation.ready()
        notifier.ready("STOPPED")
        while operation.wait_for_start(cycle.progress):
            operation.sort(Work())
        notifier.stopping("parked")
"""


class Manager:
    """What systemd is to a service: a socket that listens, signals, and a folder."""

    def __init__(self, line: socket.socket, process: subprocess.Popen[bytes], folder: Path) -> None:
        self.line = line
        self.process = process
        self.operator = ControlClient(folder)

    def hears(self, wanted: bytes) -> None:
        """Wait until the service says something, whatever it says before."""
        while wanted not in self.line.recv(4096).split(b"\n"):
            pass


@contextmanager
def _service(folder: Path) -> Iterator[Manager]:
    folder.mkdir(exist_ok=True)
    address = folder / "notify"
    address.unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(address))
        line.settimeout(30.0)
        environment = os.environ | {
            "NOTIFY_SOCKET": str(address),
            "WATCHDOG_USEC": "400000",
            "RUNTIME_DIRECTORY": str(folder),
            "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *sys.path]),
        }
        with subprocess.Popen([sys.executable, "-c", _SERVICE], env=environment) as process:
            try:
                manager = Manager(line, process, folder)
                manager.hears(b"READY=1")
                yield manager
            finally:
                process.kill()


def test_it_is_started_and_stopped_and_ends_in_good_order(tmp_path: Path) -> None:
    with _service(tmp_path / "run") as manager:
        manager.hears(b"WATCHDOG=1")
        assert manager.operator.ask("status")["state"] == "STOPPED"
        assert manager.operator.ask("start")["state"] in ("STOPPED", "EXECUTE")
        manager.hears(b"STATUS=EXECUTE: 0 placed")
        manager.hears(b"WATCHDOG=1")
        manager.process.send_signal(signal.SIGTERM)
        manager.hears(b"STOPPING=1")
        assert manager.process.wait(20.0) == 0
        with pytest.raises(NotRunning):
            manager.operator.ask("status")
        assert not (tmp_path / "run" / "control.sock").exists()


@pytest.mark.safety("SR-01", "SR-41")
def test_after_a_kill_at_work_it_comes_up_stopped(tmp_path: Path) -> None:
    with _service(tmp_path / "run") as manager:
        manager.operator.ask("start")
        manager.hears(b"STATUS=EXECUTE: 0 placed")
        manager.process.kill()
        manager.process.wait(20.0)
        with pytest.raises(NotRunning):
            manager.operator.ask("status")
    with _service(tmp_path / "run") as manager:
        assert manager.operator.ask("status")["state"] == "STOPPED"

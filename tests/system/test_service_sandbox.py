"""What the service does works under the unit's system call filter and without executable memory."""

from __future__ import annotations

import json
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.system import sandbox

pytestmark = pytest.mark.skipif(
    platform.machine() != "x86_64"
    or not sandbox.NUMBERS.is_file()
    or shutil.which("systemd-analyze") is None
    or tuple(int(part) for part in platform.release().split(".")[:2]) < (6, 3),
    reason="needs Linux 6.3 on x86-64, its headers, and systemd-analyze",
)

_WORK = """
import mmap, os, pathlib, sys
from controller.service.client import ControlClient
from controller.service.control import ControlServer
from controller.service.lock import InstanceLock
from controller.service.notify import Notifier
from controller.service.supervisor import Supervisor
from controller.ledger.sqlite import SqliteLedger
from drivers.clock import MonotonicClock
from tests.unit.service.cell_double import PretendedCell

folder = pathlib.Path(sys.argv[1])
refused = []
for name, call in (
    ("chown", lambda: os.chown(folder, -1, 5)),
    ("memory", lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)),
):
    try:
        call()
    except PermissionError:
        refused.append(name)
print(*refused)
with InstanceLock(folder), SqliteLedger(folder / "ledger.db", clock=MonotonicClock()) as ledger:
    ledger.note("start", 0.0)
    with (
        Supervisor(Notifier.from_environment().pet, 1.0) as supervisor,
        ControlServer(folder, PretendedCell(), group=os.getegid(), progress=supervisor.register("c").progress),
    ):
        print(ControlClient(folder).ask("start")["state"])
"""


def _run(environment: dict[str, str], *command: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "tests.system.sandbox", sys.executable, *map(str, command)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=100.0,
        check=False,
    )


def test_lock_ledger_control_and_watchdog(environment: dict[str, str], tmp_path: Path) -> None:
    done = _run(environment, "-c", _WORK, tmp_path)
    # The first line shows that the sandbox is one.
    assert (done.stdout, done.returncode) == ("chown memory\nEXECUTE\n", 0), done.stderr


def test_vision(environment: dict[str, str], tmp_path: Path) -> None:
    picture = np.full((480, 640, 3), 240, np.uint8)
    cv2.rectangle(picture, (200, 150), (300, 250), (40, 40, 200), -1)
    cv2.imwrite(str(tmp_path / "p.png"), picture)
    done = _run(environment, "-m", "controller.cli", "detect", tmp_path / "p.png", "--json")
    assert done.returncode == 0, done.stderr
    assert [item["shape"] for item in json.loads(done.stdout)["objects"]] == ["square"]

"""Runs the program as its user does: as a process of its own, from a folder of its own."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest

from controller.cli import execute
from controller.cli.app import ROOMS
from tests.benchmarks.cell_vision import look_at_cell
from tests.unit.calibration.certified import certify

Controller = Callable[..., "subprocess.CompletedProcess[str]"]
ROOT = Path(__file__).parents[2]


def own_environment(home: Path) -> dict[str, str]:
    """An environment whose home and state folders are in this folder."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("XDG_", "STATE_"))}
    paths = os.pathsep.join(filter(None, [str(ROOT), kept.get("PYTHONPATH")]))
    own = {"HOME": str(home), "XDG_STATE_HOME": str(home / "state"), "PYTHONPATH": paths, "COLUMNS": "160"}
    return kept | own


def run_controller(
    folder: Path, environment: dict[str, str], *arguments: object, timeout: float = 100.0
) -> subprocess.CompletedProcess[str]:
    """Run `controller` with arguments in a folder; returns the completed process."""
    return subprocess.run(
        [sys.executable, "-m", "controller.cli", *map(str, arguments)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


@pytest.fixture(scope="session")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The certified calibration of the simulated cell of seed 7, level `static`; to be read only."""
    folder = tmp_path_factory.mktemp("calibrated")
    look_at_cell(7, 1, "static", folder)
    certify(folder / "calibration")
    return folder / "calibration"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """An environment whose home and state folders are the test's own."""
    return own_environment(tmp_path)


def _in_child(folder: Path, environment: dict[str, str], arguments: tuple[str, ...], out: Path, err: Path) -> None:
    """What a new process does; never returns."""
    code = 1
    try:
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment)
        for descriptor, path in ((1, out), (2, err)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdin = os.fdopen(0, closefd=False)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", closefd=False)
        code = execute(arguments)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


@pytest.fixture(scope="session")
def _imported() -> None:
    """What commands load on demand, for all processes that are forked from this one."""
    for name in (*(f"controller.cli.{room}" for room in dict.fromkeys(ROOMS.values())), "drivers.arm.dynamixel"):
        import_module(name)
    with suppress(ImportError):  # its extra may not be installed
        import_module("sim_backends.cell")


@pytest.fixture
def controller(_imported: None, tmp_path: Path, environment: dict[str, str]) -> Controller:
    """Call `controller` with arguments in the test's folder; returns the completed process.

    A process of its own, forked from this one where that can be: what is imported already need not be again.
    """
    if sys.platform != "linux":
        return partial(run_controller, tmp_path, environment)

    calls = itertools.count(1)

    def call(*given: object, timeout: float = 100.0) -> subprocess.CompletedProcess[str]:
        arguments = tuple(map(str, given))
        number = next(calls)
        out, err = (tmp_path.with_name(f"{tmp_path.name}-{number}.{name}") for name in ("out", "err"))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads, which are the test's own
            child = os.fork()
        if child == 0:
            _in_child(tmp_path, environment, arguments, out, err)
        until, status = time.monotonic() + timeout, (0, 0)
        while status[0] == 0:
            status = os.waitpid(child, os.WNOHANG)
            if time.monotonic() > until:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
                raise TimeoutError(f"controller {' '.join(arguments)}")
            time.sleep(0.005)
        said = [path.read_text(encoding="utf-8") for path in (out, err)]
        return subprocess.CompletedProcess(arguments, os.waitstatus_to_exitcode(status[1]), *said)

    return call

"""`controller status ... doctor, service` as their user runs them, against a cell that only pretends."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.config.files import shipped
from controller.service import unit
from controller.service.control import ControlServer
from tests.system.conftest import Controller
from tests.unit.service.cell_double import PretendedCell


@pytest.fixture
def cell() -> PretendedCell:
    return PretendedCell()


@pytest.fixture
def folder(tmp_path: Path, cell: PretendedCell) -> Iterator[Path]:
    """The state folder of the program's user, where a cell is at work."""
    with ControlServer(tmp_path / "state" / "sorting-controller", cell) as server:
        yield server.path.parent


def test_a_cell_is_started_looked_at_and_stopped(controller: Controller, folder: Path, cell: PretendedCell) -> None:
    for command, state in (("start", "EXECUTE"), ("status", "EXECUTE"), ("stop", "STOPPED")):
        done = controller(command, "--json")
        assert (done.returncode, done.stderr) == (0, "")
        assert json.loads(done.stdout)["state"] == state, command
    assert cell.told == ["start", "stop"]


def test_a_refusal_is_one_line(controller: Controller, folder: Path, cell: PretendedCell) -> None:
    cell.start()
    done = controller("start")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "error: not possible in CAPTURE: stop first\n"


def test_without_a_cell_one_is_told_so(controller: Controller, tmp_path: Path) -> None:
    done = controller("stop", "--at", tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith(f"error: no cell is running at {tmp_path}: start it")


def test_a_dry_run_prints_all_that_installing_would_do(controller: Controller) -> None:
    plan = unit.plan(Path(sys.executable).parent / "controller")
    done = controller("service", "install", "--dry-run")
    assert done.returncode == 0
    for file in plan.files:
        assert f"# --- {file.path}\n{file.content}" in done.stdout
    for command in plan.commands:
        assert " ".join(command) in done.stdout


def test_the_doctor_says_what_has_failed(controller: Controller, tmp_path: Path) -> None:
    done = controller("doctor", "--config", shipped("cell.toml"), "--state", tmp_path / "none", "--json")
    report = json.loads(done.stdout)
    checks = {check["name"]: check for check in report["checks"]}
    assert (done.returncode, report["verdict"]) == (1, "failed")
    assert checks["configuration"]["level"] == "ok"
    assert checks["calibration"]["level"] == "failed"
    assert all(bool(check["remedy"]) == (check["level"] != "ok") for check in checks.values())
    # It has only looked.
    assert not (tmp_path / "none").exists()

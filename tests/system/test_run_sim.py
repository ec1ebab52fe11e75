"""Whole runs of the simulated cell, as its user starts them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import pytest

from controller.cli import execute
from controller.ledger.view import LedgerView
from tests.system.conftest import Controller, own_environment, run_controller


def figures(stdout: str) -> dict[str, Any]:
    lines = stdout.splitlines()
    assert len(lines) == 1, stdout
    loaded: dict[str, Any] = json.loads(lines[0])
    return loaded


def check_sums(found: dict[str, Any]) -> None:
    assert found["sorted"] == found["correct"] + found["missorted"] + found["silent"]
    assert found["parts"] == sum(found[k] for k in ("sorted", "rejected", "left", "dropped", "indeterminate"))
    assert found["reachable"] <= found["parts"]


RUN = ("run", "--sim", "--level", "static", "--seed", 7, "--json")


@pytest.fixture(scope="module")
def first_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder and the figures of one run that calibrates its cell and sorts four parts."""
    home = tmp_path_factory.mktemp("home")
    done = run_controller(home, own_environment(home), *RUN, "--parts", 4, "--out", "run")
    assert done.returncode == 0, done.stderr
    return home / "run", figures(done.stdout)


def test_a_run_sorts_and_keeps_everything(
    first_run: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, found = first_run
    check_sums(found)
    assert (found["parts"], found["correct"], found["missorted"], found["silent"]) == (4, 4, 0, 0)
    with LedgerView(out / "ledger.db") as ledger:
        assert ledger.verify() == ()
        assert ledger.counts()["placed"] == 4
    for name in ("before.png", "after.png", "cell.png"):
        assert cv2.imread(str(out / name)) is not None
    assert json.loads((out / "report.json").read_text()) == found
    page = (out / "report.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 3
    assert "http" not in page
    assert (out / "calibration" / "camera.json").is_file()
    made = {"report": ["--out", str(tmp_path / "shift.html")], "bundle": ["--out", str(tmp_path / "bundle.zip")]}
    for command in (["ledger", "show"], ["ledger", "export"], ["ledger", "verify"], ["report"], ["bundle"]):
        assert execute([*command, str(out), *made.get(command[0], [])]) == 0
    assert "4 of 4 parts in a bin" in capsys.readouterr().out


def test_the_same_seed_gives_the_same_run(first_run: tuple[Path, dict[str, Any]], controller: Controller) -> None:
    done = controller(*RUN, "--parts", 4, "--out", "again")
    assert done.returncode == 0, done.stderr
    runs = ({key: value for key, value in run.items() if key not in ("wall_s", "out")} for run in (
        first_run[1], figures(done.stdout),
    ))  # fmt: skip
    assert next(runs) == next(runs)


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_ctrl_c_in_a_pick_parks_the_arm_and_closes_the_record(
    first_run: tuple[Path, dict[str, Any]], tmp_path: Path, environment: dict[str, str]
) -> None:
    calibration = first_run[0] / "calibration"
    arguments = [*map(str, RUN), "--parts", "6", "--out", "run", "--calibration", str(calibration)]
    with subprocess.Popen(
        [sys.executable, "-m", "controller.cli", *arguments],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        for line in process.stderr:
            if "placed:" in line:
                os.kill(process.pid, signal.SIGINT)
                break
        stderr = process.stderr.read()
        stdout = process.stdout.read()
        assert process.wait(60) == 130, stderr
    found = figures(stdout)
    assert 1 <= found["sorted"] < 6
    with LedgerView(tmp_path / "run" / "ledger.db") as ledger:
        assert ledger.verify() == ()
        runs = list(ledger.rows("runs"))
        assert runs[0]["end_reason"] == "stopped"
        assert len(list(ledger.rows("outcomes"))) >= found["sorted"]


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals are POSIX")
def test_the_stock_serial_path_sorts_in_real_time(
    first_run: tuple[Path, dict[str, Any]], tmp_path: Path, environment: dict[str, str]
) -> None:
    arguments = (*RUN, "--real-time", "--parts", 2, "--calibration", first_run[0] / "calibration")
    done = run_controller(tmp_path, environment, *arguments)
    assert done.returncode == 0, done.stderr
    found = figures(done.stdout)
    check_sums(found)
    assert (found["correct"], found["missorted"], found["silent"]) == (2, 0, 0)
    assert found["sim_s"] == pytest.approx(found["wall_s"], abs=0.5)  # both clocks are the system's


def test_the_simulation_needs_nothing_that_only_posix_has(tmp_path: Path, environment: dict[str, str]) -> None:
    program = """
import sys
import subprocess, serial  # these choose their own system's modules
for name in ("fcntl", "termios", "tty", "pty", "grp", "pwd", "resource", "syslog"):
    sys.modules[name] = None
from controller.cli import main
main(sys.argv[1:])
"""
    command = [sys.executable, "-c", program, *map(str, (*RUN, "--parts", 1, "--out", "run"))]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert figures(done.stdout)["correct"] == 1

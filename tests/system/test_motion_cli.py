"""Motion by hand, bins and rehearsals, as their user calls them, in the simulated cell."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from controller.cli import execute
from controller.config.files import shipped
from controller.service.lock import InstanceLock
from tests.system.conftest import Controller

pytest.importorskip("mujoco")


def test_home_and_park(controller: Controller) -> None:
    done = controller("home", "--sim", "--level", "ideal", "--park", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["home"]
    assert found["parked"]
    # At rest the arm lies on itself: the described rest pose to what it sinks without torque.
    assert found["joints_deg"]["shoulder"] == pytest.approx(-103.1, abs=2.0)


def test_home_needs_the_cell_for_itself(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    with InstanceLock(tmp_path):
        assert execute(["home", "--config", str(shipped("cell.toml"))]) == 75
    assert str(os.getpid()) in capsys.readouterr().err


def test_home_without_a_configuration(capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["home"]) == 78
    assert "--sim" in capsys.readouterr().err


def test_jog_from_a_pipe(environment: dict[str, str], tmp_path: Path) -> None:
    lines = ["home", "x+ 10", "j1- 2", "z- 50", "z- 50", "z- 50", "z- 50", "jaws 40", "j1+ 20", "j1+ 20", "j1+ 20"]
    lines += ["j1+ 20", "set squares"]
    done = subprocess.run(
        [sys.executable, "-m", "controller.cli", "jog", "--sim", "--level", "ideal", "--bins", "bins.toml", "--json"],
        input="\n".join(lines),
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=100.0,
        check=False,
    )
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert [one.get("command") for one in found] == [None, *lines], done.stderr
    tools = {one.get("command"): one["tool_mm"] for one in found}
    homed, moved = tools["home"], tools["x+ 10"]
    # Friction holds a joint up to 4 mrad off its goal: 1.3 mm of the tool at each end of the step.
    assert moved[0] - homed[0] == pytest.approx(10.0, abs=2.6)
    assert moved[2] == pytest.approx(homed[2], abs=2.6)
    # The second to last step down ends above the table, the last is refused, and the exit code says so.
    assert "over the table" in done.stderr
    assert done.returncode == 1
    assert min(one["tool_mm"][2] for one in found) > 16.0
    assert found[-1]["note"].startswith("squares stands at")
    listed = [line for line in (tmp_path / "bins.toml").read_text().splitlines() if line.startswith("name")]
    assert listed == ['name = "squares"']


def test_jog_from_a_terminal(environment: dict[str, str], tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    jog = subprocess.Popen(
        [sys.executable, "-m", "controller.cli", "jog", "--sim", "--level", "ideal", "--json"],
        stdin=theirs,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=tmp_path,
        env=environment,
        text=True,
    )
    os.close(theirs)
    try:
        assert jog.stdout is not None
        first = json.loads(jog.stdout.readline())
        os.write(ours, b"2.")
        turned = json.loads(jog.stdout.readline())
        assert turned["command"] == "j2+ 2"
        assert turned["joints_deg"]["shoulder"] - first["joints_deg"]["shoulder"] == pytest.approx(2.0, abs=0.5)
        assert jog.poll() is None
        os.write(ours, b"q")
        assert jog.wait(timeout=60.0) == 0
    finally:
        jog.kill()
        jog.communicate()
        os.close(ours)


def test_ctrl_c_ends_jogging(environment: dict[str, str], tmp_path: Path) -> None:
    jog = subprocess.Popen(
        [sys.executable, "-m", "controller.cli", "jog", "--sim", "--level", "ideal", "--json"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=tmp_path,
        env=environment,
        text=True,
    )
    with jog:
        assert jog.stdout is not None
        json.loads(jog.stdout.readline())
        jog.send_signal(signal.SIGINT)
        assert jog.wait(timeout=60.0) == 130


def test_bins_are_taught_beside_the_configuration(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    config = shipped("cell.toml")
    before = config.read_bytes()
    assert execute(["bins", "set", "squares", "--at", "-180", "230", "--config", str(config)]) == 0
    assert execute(["bins", "set", "circles", "--at", "-900", "0", "--config", str(config)]) == 78
    said = capsys.readouterr()
    assert "cannot be reached" in said.err
    assert execute(["bins", "list", "--config", str(config), "--json"]) == 0
    bins = {bin_["name"]: bin_ for bin_ in map(json.loads, capsys.readouterr().out.splitlines())}
    assert bins["squares"]["center_mm"] == [-180.0, 230.0]
    assert bins["squares"]["taught"]
    assert not bins["circles"]["taught"]
    assert config.read_bytes() == before
    assert execute(["config", "check", "--config", str(config), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["taught"] == ["squares"]
    # Into another bin: refused, and nothing is written.
    assert execute(["bins", "set", "circles", "--at", "-170", "240", "--config", str(config)]) == 78
    assert "stand in one another" in capsys.readouterr().err


def test_the_doctor_looks_at_the_simulated_cell(capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["doctor", "--sim", "--json"]) == 0
    checks = {check["name"]: check for check in json.loads(capsys.readouterr().out)["checks"]}
    assert "6 servos answer" in checks["servos"]["finding"]
    assert "6 within reach" in checks["bins"]["finding"]
    assert "1280x720" in checks["camera"]["finding"]


@pytest.mark.safety("SR-18")
def test_rehearsals_touch_nothing(controller: Controller, tmp_path: Path) -> None:
    common = ("run", "--sim", "--level", "ideal", "--parts", 2, "--seed", 3, "--json")
    dry = controller(*common, "--dry-run", "--out", "dry")
    assert dry.returncode == 0, dry.stderr
    assert dry.stderr.count("would take the") == 2
    moves = [json.loads(line) for line in (tmp_path / "dry" / "moves.jsonl").read_text().splitlines()]
    assert [move["name"] for move in moves if move["command"] == "follow"].count("carry") == 2
    figures = json.loads(dry.stdout)
    assert figures["rehearsal"] == "dry"
    assert "correct" not in figures


def test_identify_writes_beside_the_calibration(controller: Controller, tmp_path: Path) -> None:
    done = controller("identify", "--sim", "--level", "dynamic", "--seed", 2, "--calibration", "cal", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert json.loads((tmp_path / "cal" / "identification.json").read_text()) == found
    # Masses of this level are off by up to a tenth: the gains stay near the described ones.
    assert found["joints"]["shoulder"]["stiffness"] == pytest.approx(18.9, rel=0.2)
    assert max(found["rms_after_rad"].values()) < 0.005

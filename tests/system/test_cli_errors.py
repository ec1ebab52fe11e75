"""Bad input: one clear line on stderr and the contract's exit code, and nothing on stdout."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.config.files import shipped
from controller.service.lock import InstanceLock
from tests.system.conftest import Controller

CELL = shipped("cell.toml").read_text()
SIM = shipped("sim.toml").read_text()


def one_error(stderr: str) -> str:
    lines = [line for line in stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, stderr
    assert "Traceback" not in stderr
    return lines[0]


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_no_configuration(controller: Controller) -> None:
    done = controller("run", "--start")
    assert (done.returncode, done.stdout) == (78, "")
    assert "--config FILE" in one_error(done.stderr)


def test_a_configuration_that_is_not_there(controller: Controller) -> None:
    done = controller("run", "--config", "none.toml")
    assert done.returncode == 78
    assert "none.toml" in one_error(done.stderr)


@pytest.mark.safety("SR-04")
def test_a_typo_in_a_configuration(controller: Controller, tmp_path: Path) -> None:
    path = write(tmp_path / "cell.toml", CELL.replace("speed_percent", "sped_percent"))
    for command in (["run"], ["config", "check"]):
        done = controller(*command, "--config", path)
        assert done.returncode == 78
        line = one_error(done.stderr)
        assert "arm.sped_percent" in line
        assert "did you mean speed_percent?" in line


@pytest.mark.safety("SR-04")
def test_an_unreachable_bin(controller: Controller, tmp_path: Path) -> None:
    path = write(tmp_path / "cell.toml", re.sub(r"center_mm = .*", "center_mm = [190.0, 526.0]", SIM, count=1))
    for command in (["config", "check"], ["run", "--sim"]):
        done = controller(*command, "--config", path)
        assert done.returncode == 78, done.stderr
        assert "squares" in one_error(done.stderr)
    assert not (tmp_path / "runs").exists()


@pytest.mark.safety("SR-06")
def test_a_missing_camera_and_a_missing_serial_port(controller: Controller, tmp_path: Path) -> None:
    text = CELL.replace("/dev/sorter-cam", "/dev/no-camera-here").replace("/dev/sorter-arm", "/dev/no-port-here")
    done = controller("run", "--config", write(tmp_path / "cell.toml", text), "--start")
    assert done.returncode == 1
    line = one_error(done.stderr)
    assert "/dev/no-camera-here" in line
    assert "/dev/no-port-here" in line


@pytest.mark.safety("SR-03")
def test_a_second_instance(controller: Controller, tmp_path: Path) -> None:
    import os

    path = write(tmp_path / "cell.toml", CELL)
    with InstanceLock(tmp_path / "state" / "sorting-controller"):
        done = controller("run", "--config", path, "--start")
    assert done.returncode == 75
    assert str(os.getpid()) in one_error(done.stderr)


def test_a_folder_that_is_taken(controller: Controller, tmp_path: Path) -> None:
    write(tmp_path / "old.txt", "old")
    done = controller("run", "--sim", "--out", tmp_path)
    assert done.returncode == 2
    assert "is not empty" in one_error(done.stderr)
    assert (tmp_path / "old.txt").read_text() == "old"


@pytest.mark.parametrize("arguments", [["run", "--level", "wild"], ["run", "--sim", "--replay", "."], ["sort"]])
def test_usage(controller: Controller, arguments: list[str]) -> None:
    assert controller(*arguments).returncode == 2


def test_an_empty_folder_to_replay(controller: Controller, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    done = controller("run", "--replay", tmp_path / "empty")
    assert done.returncode == 1
    assert "empty" in one_error(done.stderr)


def test_an_empty_folder_to_look_at(controller: Controller, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    done = controller("detect", tmp_path / "empty")
    assert done.returncode == 1
    assert "holds no pictures" in one_error(done.stderr)


def test_a_text_file_named_png_does_not_spoil_the_others(controller: Controller, tmp_path: Path) -> None:
    import json

    text = write(tmp_path / "a.png", "this is no picture\n")
    gray = tmp_path / "b.png"
    cv2.imwrite(str(gray), np.full((120, 160, 3), 180, np.uint8))
    done = controller("detect", text, gray, "--json")
    assert done.returncode == 1
    first, second = map(json.loads, done.stdout.splitlines())
    assert first["image"] == str(text)
    assert "a.png" in first["error"]
    assert second["objects"] == []
    assert "a.png" in one_error(done.stderr)


def test_help_teaches_with_an_example(controller: Controller) -> None:
    for command in (["run"], ["detect"], ["config", "check"], ["calibrate", "camera"], ["calibrate", "table"]):
        done = controller(*command, "--help")
        assert done.returncode == 0
        assert "Example" in done.stdout


def test_version(controller: Controller) -> None:
    done = controller("--version")
    assert done.returncode == 0
    assert done.stdout.startswith("controller ")

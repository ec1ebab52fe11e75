"""The README's guide from the box to the first sort: its commands, read from it and run in simulation, in its order.

What differs from a real cell is here and nowhere else: `--sim` and the seed of a simulated cell, pictures of a painted
board where the camera would have taken them, one camera that is said to be plugged in, and a cell that only pretends
behind the control socket. Files named in the guide are the test's own.
"""

from __future__ import annotations

import glob
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.calibration.board_spec import parse_board
from controller.calibration.printing import lay_out, raster
from controller.cli import camera as camera_command
from controller.cli import execute
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.geometry import pose_from_rvec
from controller.service.control import ControlServer
from drivers.camera.listing import CameraListing
from tests.unit.calibration.scene import LENS, paint
from tests.unit.service.cell_double import PretendedCell

pytest.importorskip("mujoco")

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
BOARD = "charuco:10x7:28:21:DICT_5X5_100"
# What only a real machine can do, and no command of the program.
OTHERS = ("python3 -m venv", "/opt/", "ln -s", "usermod", "mkdir", "install -", "cp ", "chown", "systemctl")
SIM = ("--sim", "--level", "ideal", "--seed", "7")


def guide() -> list[list[str]]:
    """Every command of the guide, in its order, as words."""
    section = README.split("## First hardware", 1)[1].split("\n## ", 1)[0]
    lines = "\n".join(re.findall(r"```sh\n(.*?)```", section, re.DOTALL)).splitlines()
    found = []
    for line in (part.strip().removeprefix("sudo ") for text in lines for part in text.split("&&") if part.strip()):
        if line.startswith("controller "):
            found.append(shlex.split(line)[1:])
        else:
            assert line.startswith(OTHERS), f"the guide has a command that nobody has looked at: {line}"
    return found


def simulated(words: list[str], folder: Path) -> list[str]:
    """The command as it is run here."""
    words = [str(folder / "cell.toml") if word == "/etc/sorter/cell.toml" else word for word in words]
    match words[:2]:
        case ["service", "install"]:
            return [*words, "--dry-run"]
        case ["camera", "focus"]:
            return [*words, "--sim", "--frames", "2"]
        case ["camera", "snapshot"]:
            return [*words, "--sim"]
        case ["calibrate", "camera"]:
            # From pictures: the live guide, with simulated hands, is tried once in `test_the_whole_guide_in_one_go`.
            return [*words[:2], *sorted(glob.glob("views/*.png")), *words[4:]]
        case ["calibrate", "table"]:
            return [*words[:2], "sheet.png", *words[2:]]
        case ["calibrate", "check"]:
            return [*words, *SIM, "--points", "20"]
        case ["calibrate", "arm"] | ["home", _] | ["identify", _] | ["jog", _]:
            return [*words, *SIM]
        case ["run", _]:
            # A simulated cell starts by itself, and `--step` would ask a person; the last --parts counts.
            return [*(word for word in words if word not in ("--start", "--step")), *SIM, "--parts", "1"]
    return words


def board_pictures(folder: Path) -> None:
    """What the snapshots of step 5 show: the printed board held in several ways, and lying on the table."""
    page, pixel = raster(lay_out(parse_board(BOARD)), 100.0), 25.4 / 100.0
    random = np.random.default_rng(3)
    for number in range(1, 9):
        tilt = random.uniform(-0.6, 0.6, 3)
        place = [*random.uniform(-110.0, 110.0, 2), random.uniform(420.0, 560.0)]
        held = paint(page, pixel, pose_from_rvec(tilt, place), LENS)
        cv2.imwrite(str(folder / "views" / f"{number:02}.png"), held)
    lying = paint(page, pixel, pose_from_rvec([0.02, -0.03, 0.1], [5.0, -8.0, 600.0]), LENS)
    cv2.imwrite(str(folder / "sheet.png"), lying)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A machine with one camera plugged in and folders of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    plugged = [CameraListing("/dev/video0", "a camera", ("/dev/v4l/by-id/usb-a-camera",))]
    monkeypatch.setattr(camera_command, "plugged_in", lambda: plugged)
    (tmp_path / "views").mkdir()
    (tmp_path / "keys").write_text("where\nq\n", encoding="ascii")
    with (tmp_path / "keys").open() as keys:
        monkeypatch.setattr("sys.stdin", keys)
        yield tmp_path


# The longest of them, which other tests of this folder run in simulation with the same options.
ELSEWHERE = {"calibrate check": "test_calibrate_cli.py", "identify": "test_motion_cli.py"}


@pytest.mark.timeout(300)
def test_every_command_of_the_guide_works(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    walk_through(machine, capsys, leave_out=tuple(ELSEWHERE))
    for command, file in ELSEWHERE.items():
        there = (Path(__file__).parent / file).read_text(encoding="utf-8").replace('", "', " ")
        assert f"{command} --sim" in there


@pytest.mark.study
@pytest.mark.timeout(600)
def test_the_whole_guide_in_one_go(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    walk_through(machine, capsys)
    (live,) = (words for words in guide() if words[:2] == ["calibrate", "camera"])
    assert execute([*live, *SIM]) == 0, capsys.readouterr().err


def walk_through(machine: Path, capsys: pytest.CaptureFixture[str], leave_out: tuple[str, ...] = ()) -> None:
    """Run the guide's commands, but those that begin with what is left out."""
    done: list[str] = []
    with ControlServer(machine / "run", PretendedCell()):
        for words in guide():
            if " ".join(words).startswith(leave_out):
                continue
            if words[:2] in (["calibrate", "camera"], ["calibrate", "table"]):
                board_pictures(machine)
            if words[:2] == ["calibrate", "arm"]:
                # The lens of the painted pictures is not the simulated cell's, which makes its own.
                shutil.rmtree("cal")
            if words[0] == "report":
                (machine / "state").mkdir(exist_ok=True)
                shutil.copyfile(max(glob.glob("runs/*/ledger.db")), machine / "state" / "ledger.db")
            command = simulated(words, machine)
            code = execute(command)
            said = capsys.readouterr()
            # Nothing is plugged in where the doctor looks; on a real cell it says the same of what is missing there.
            assert code == (1 if words[0] == "doctor" else 0), f"{' '.join(command)}: {said.err or said.out}"
            done.append(" ".join(words[:2]))
    for step in ("config new", "camera focus", "board --marker", "calibrate table", "calibrate arm", "bins set"):
        assert step in done


def test_the_guide_speaks_of_the_shipped_configuration() -> None:
    """Its figures are those of the file it begins with."""
    cell = load_cell(shipped("cell.toml"))
    section = README.split("## First hardware", 1)[1].split("\n## ", 1)[0]
    assert cell.table.board == BOARD
    assert section.count(BOARD) >= 3
    assert f"{cell.camera.height_mm:.0f} mm above" in section
    area = cell.table.work_area
    assert f"{area.inner_radius_mm:.0f} to {area.outer_radius_mm:.0f} mm ahead" in section
    assert f"{cell.table.origin_in_base_mm[0]:.0f} mm ahead of the arm" in section
    assert f"speed_percent = {cell.arm.speed_percent:.0f}" in section
    assert "no emergency stop" in section

"""The commands that talk to a running cell: what people and machines get to see."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from controller.cli import control
from controller.cycle.machine import State
from controller.errors import SorterError
from controller.service.client import NotRunning
from controller.service.control import ControlServer
from tests.unit.service.cell_double import PretendedCell


@pytest.fixture
def cell() -> PretendedCell:
    return PretendedCell()


@pytest.fixture
def at(tmp_path: Path, cell: PretendedCell, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Folder of a cell at work; wide enough a terminal that tables do not wrap."""
    monkeypatch.setenv("COLUMNS", "200")
    with ControlServer(tmp_path, cell):
        yield tmp_path


def test_every_command_does_what_it_is_called(
    at: Path, cell: PretendedCell, capsys: pytest.CaptureFixture[str]
) -> None:
    for command, state in (
        (control.start, "EXECUTE"),
        (control.pause, "HELD"),
        (control.resume, "EXECUTE"),
        (control.stop, "STOPPED"),
        (control.reset, "STOPPED"),
        (control.status, "STOPPED"),
    ):
        command(at=at, as_json=True)
        assert json.loads(capsys.readouterr().out)["state"] == state
    assert cell.told == ["start", "pause", "resume", "stop", "reset"]


def test_a_start_says_that_the_view_is_clear_only_when_told_to(at: Path, cell: PretendedCell) -> None:
    control.start(at=at, view_clear=True)
    control.stop(at=at)
    control.start(at=at)
    assert cell.told == ["start --view-clear", "stop", "start"]


def test_people_see_what_matters(at: Path, cell: PretendedCell, capsys: pytest.CaptureFixture[str]) -> None:
    cell.log.raise_("camera_lost", "/dev/video0 is gone", "plug it in")
    control.status(at=at)
    shown = capsys.readouterr().out
    for said in ("STOPPED", "waiting for start", "3 placed", "camera_lost", "plug it in", "came first"):
        assert said in shown
    assert "dropped" not in shown


def test_a_stop_is_only_confirmed_when_the_cell_is_at_rest(
    at: Path, cell: PretendedCell, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop_but_never_park() -> None:
        cell.state = State.PLACE

    monkeypatch.setattr(cell, "stop", stop_but_never_park)
    monkeypatch.setattr(control, "STOP_TIMEOUT", 0.0)
    with pytest.raises(SorterError, match="still EXECUTE after 0 s: use the emergency stop"):
        control.stop(at=at)
    assert capsys.readouterr().out == ""


def test_alarms_are_listed_one_a_line_and_acknowledged(
    at: Path, cell: PretendedCell, capsys: pytest.CaptureFixture[str]
) -> None:
    control.alarms(at=at)
    assert capsys.readouterr().out == "no alarms\n"
    cell.log.raise_("camera_lost", "/dev/video0 is gone", "plug it in")
    cell.log.raise_("bin_full", "squares", "empty it")
    control.alarms(acknowledge=True, at=at, as_json=True)
    alarms = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(alarm["code"], alarm["first_out"]) for alarm in alarms] == [("camera_lost", True), ("bin_full", False)]
    assert all(alarm["acknowledged_at"] and alarm["active"] for alarm in alarms)


@pytest.mark.parametrize(
    "command",
    [control.status, control.start, control.pause, control.resume, control.stop, control.reset, control.reload],
)
def test_without_a_cell_every_command_says_so(tmp_path: Path, command: Callable[..., None]) -> None:
    with pytest.raises(NotRunning, match="no cell is running"):
        command(at=tmp_path)
    with pytest.raises(SorterError, match="no such folder"):
        command(at=tmp_path / "none")

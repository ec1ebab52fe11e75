"""The machine that every test of the doctor starts from."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.service.doctor.case import Case
from tests.unit.service.doctor.machines import NOW, never_opened, no_command


@pytest.fixture
def case(tmp_path: Path) -> Case:
    """A machine with nothing plugged in, and the shipped example of a real cell."""
    (tmp_path / "root/dev").mkdir(parents=True)
    (tmp_path / "state").mkdir()
    found = load_cell(shipped("cell.toml"))
    return Case(
        state=tmp_path / "state",
        config=shipped("cell.toml"),
        cell=found,
        arm=load_arm(found.arm.description),
        root=tmp_path / "root",
        run=no_command,
        clock_in_step=lambda: True,
        now=NOW,
        devices=never_opened,
    )

"""The doctor on the software, the computer and the cell's files: it finds each trouble and names a remedy."""

from __future__ import annotations

import dataclasses
import errno
import os
import shutil
import sqlite3
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path

import pytest

from controller.calibration.approval import Approval
from controller.errors import CalibrationMissing
from controller.ledger.sqlite import SqliteLedger
from controller.service import unit
from controller.service.doctor import cell, devices, examine, host, software
from controller.service.doctor.case import Case, clock_in_step
from controller.service.doctor.finding import Finding, Level
from controller.service.lock import InstanceLock
from sim_backends.virtual_clock import VirtualClock
from tests.unit.service.doctor.machines import NOW, level_of, plug_in

# --- software ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "level"),
    [((3, 10, 13), Level.FAILED), ((3, 11, 0), Level.OK), ((3, 14, 1), Level.OK)],
)
def test_python(case: Case, version: tuple[int, ...], level: Level) -> None:
    assert level_of(software.python(case, version)) is level


@pytest.mark.parametrize(
    ("version", "level"),
    [
        ((3, 6, 23), Level.OK),
        ((3, 7, 0), Level.WARNING),
        ((3, 40, 1), Level.WARNING),
        ((3, 44, 5), Level.WARNING),
        ((3, 44, 6), Level.OK),
        ((3, 45, 0), Level.WARNING),
        ((3, 50, 6), Level.WARNING),
        ((3, 50, 7), Level.OK),
        ((3, 51, 2), Level.WARNING),
        ((3, 51, 3), Level.OK),
        ((3, 52, 0), Level.OK),
    ],
)
def test_sqlite(case: Case, version: tuple[int, ...], level: Level) -> None:
    assert level_of(software.sqlite(case, version)) is level


@pytest.mark.parametrize(
    ("present", "level", "said"),
    [
        ({"opencv-python-headless": "4.14.0.94", "numpy": "2.1.0"}, Level.OK, "numpy 2.1.0"),
        ({"opencv-python-headless": "5.0.0.93", "numpy": "2.1.0"}, Level.FAILED, "opencv-python-headless 5.0.0.93"),
        ({"opencv-python-headless": "4.10.0.84", "numpy": "2.1.0"}, Level.FAILED, "is not <5,>=4.11"),
        ({"opencv-python-headless": "4.11", "numpy": "1.26"}, Level.FAILED, "numpy 1.26"),
        ({"numpy": "2.1.0"}, Level.FAILED, "opencv-python-headless is missing"),
        (
            {"opencv-python-headless": "4.14.0.94", "opencv-python": "4.14.0.94", "numpy": "2.1.0"},
            Level.WARNING,
            "overwrite each other",
        ),
    ],
)
def test_libraries(present: dict[str, str], level: Level, said: str) -> None:
    found = software.judge_libraries(["opencv-python-headless<5,>=4.11", "numpy>=2.0"], present)
    assert level_of(found) is level
    assert said in found.finding


@pytest.mark.parametrize(
    ("said", "level"),
    [
        ("→ Overall exposure level for controller.service: 0.6 SAFE", Level.OK),
        ("→ Overall exposure level for controller.service: 1.5 OK", Level.OK),
        ("→ Overall exposure level for controller.service: 9.2 UNSAFE", Level.WARNING),
        ("gibberish", Level.OK),
    ],
)
def test_the_unit_s_exposure(case: Case, said: str, level: Level) -> None:
    judged: list[str] = []

    def run(command: Sequence[str]) -> str:
        judged.append(Path(command[-1]).read_text())
        return said

    assert level_of(software.exposure(dataclasses.replace(case, run=run))) is level
    installed = case.root / "etc/systemd/system/controller.service"
    installed.parent.mkdir(parents=True)
    installed.write_text("[Service]\nType=notify\n")
    software.exposure(dataclasses.replace(case, run=run))
    assert "DevicePolicy=closed" in judged[0]
    assert judged[1] == "[Service]\nType=notify\n"


def test_without_systemd_the_unit_is_not_judged(case: Case) -> None:
    assert "not judged" in software.exposure(case).finding


def test_the_service(case: Case) -> None:
    assert "not installed" in software.service(case).finding
    (case.root / "run/systemd/system").mkdir(parents=True)
    answer = "ActiveState=active\nNRestarts=2\nResult=success\n"
    here = dataclasses.replace(case, run=lambda command: answer)
    unit.install(unit.plan(Path("/opt/sorter/bin/controller")), root=case.root, run=here.run, uid=0)
    found = software.service(here)
    assert level_of(found) is Level.OK
    assert found.finding == "active, 2 restarts"
    answer = "ActiveState=failed\nNRestarts=5\nResult=watchdog\n"
    assert level_of(software.service(here)) is Level.WARNING
    assert "watchdog, after 5 restarts" in software.service(here).finding
    answer = "ActiveState=active\n"
    (case.root / "etc/modules-load.d/sorter.conf").unlink()
    found = software.service(here)
    assert level_of(found) is Level.WARNING
    assert "sorter.conf" in found.finding


# --- the computer --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gib", "level"), [(0.05, Level.FAILED), (0.5, Level.WARNING), (20.0, Level.OK)])
def test_disk(case: Case, monkeypatch: pytest.MonkeyPatch, gib: float, level: Level) -> None:
    asked: list[Path] = []

    class Usage:
        free = gib * host.GIB

    def usage(path: Path) -> Usage:
        asked.append(path)
        return Usage()

    monkeypatch.setattr(shutil, "disk_usage", usage)
    missing = dataclasses.replace(case, state=case.state / "not" / "yet")
    assert level_of(host.disk(missing)) is level
    assert asked == [case.state]


@pytest.mark.parametrize(("in_step", "level"), [(True, Level.OK), (False, Level.WARNING), (None, Level.OK)])
def test_clock(case: Case, in_step: bool | None, level: Level) -> None:
    assert level_of(host.clock(dataclasses.replace(case, clock_in_step=lambda: in_step))) is level


def test_the_kernel_can_be_asked_about_its_clock() -> None:
    assert clock_in_step() in (True, False, None)


@pytest.mark.parametrize(
    ("bits", "level"), [("0x0", Level.OK), ("0x50000", Level.WARNING), ("0x50005", Level.FAILED), ("80000", Level.OK)]
)
def test_the_supply_of_a_raspberry_pi(case: Case, bits: str, level: Level) -> None:
    assert host.supply(case) is None
    path = case.path("/sys/devices/platform/soc/soc:firmware/get_throttled")
    path.parent.mkdir(parents=True)
    path.write_text(bits + "\n")
    assert level_of(host.supply(case)) is level


# --- the cell ------------------------------------------------------------------------------------------


def test_another_instance_is_named_and_its_devices_left_alone(case: Case) -> None:
    plug_in(case)
    with InstanceLock(case.state):
        found = cell.instance(case)
        assert str(os.getpid()) in found.finding
        assert devices.opened(case) == []
    assert "nobody" in cell.instance(case).finding


def test_looking_for_an_instance_leaves_no_trace(case: Case) -> None:
    cell.instance(case)
    assert list(case.state.iterdir()) == []
    with InstanceLock(case.state):
        pass
    before = (case.state / "lock").read_text()
    cell.instance(case)
    assert (case.state / "lock").read_text() == before


def test_ledger(case: Case) -> None:
    assert "none yet" in cell.ledger(case).finding
    path = case.state / "ledger.db"
    SqliteLedger(path, clock=VirtualClock()).close()
    assert level_of(cell.ledger(case)) is Level.OK
    with sqlite3.connect(path) as connection:
        connection.execute(f"PRAGMA user_version = {10**6}")
    connection.close()
    found = cell.ledger(case)
    assert level_of(found) is Level.FAILED
    assert "newer version" in found.finding
    path.write_bytes(b"not a database, but long enough to be looked at as one" * 100)
    assert level_of(cell.ledger(case)) is Level.FAILED


class _Stored:
    """A calibration folder's contents as far as the doctor asks."""

    def __init__(self, made_at: str) -> None:
        self.provenance = {"arm.json": {"made_at": made_at}, "camera.json": {}}

    def check(self, *, arm: str | None) -> None:
        assert arm == "reactorx_150"

    def cell(self) -> _Stored:
        return self

    calibration_id = "cell-1234"


@pytest.mark.parametrize(
    ("proof", "level", "said"),
    [
        (Approval("passed", NOW - timedelta(days=3), 0.3, 0.5, {}), Level.OK, "30 days old, passed"),
        (Approval("passed", NOW - timedelta(days=120), 0.3, 0.5, {}), Level.WARNING, "120 days ago"),
        (Approval("passed", None, 0.3, 0.5, {}), Level.WARNING, "unknown time"),
        (Approval("failed", NOW, 1.3, 2.5, {}), Level.FAILED, "failed"),
        (CalibrationMissing("the calibration was never proved", "prove it"), Level.FAILED, "never proved"),
    ],
)
def test_calibration(
    case: Case, monkeypatch: pytest.MonkeyPatch, proof: Approval | CalibrationMissing, level: Level, said: str
) -> None:
    def found_proof(folder: Path, stored: object) -> Approval:
        if isinstance(proof, CalibrationMissing):
            raise proof
        return proof

    monkeypatch.setattr(cell, "load", lambda folder: _Stored((NOW - timedelta(days=30)).isoformat()))
    monkeypatch.setattr(cell, "certificate_of", found_proof)
    (case.state / "calibration").mkdir()
    found = cell.calibration(case)
    assert level_of(found) is level
    assert said in found.finding


def test_no_calibration_is_a_failure(case: Case) -> None:
    assert level_of(cell.calibration(case)) is Level.FAILED


def test_what_a_stranger_may_not_read_is_said_with_what_to_do(case: Case) -> None:
    def denied(case: Case) -> Finding:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "/var/lib/sorter/ledger.db")

    (found,) = examine._made({"ledger": denied}, case)
    assert (found.level, found.finding) == (Level.FAILED, "/var/lib/sorter/ledger.db: Permission denied")
    assert "sudo usermod -aG sorter" in found.remedy

"""The doctor's checks on machines made up for them: each finds its own trouble and names a remedy."""

from __future__ import annotations

import dataclasses
import os
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from controller.backends import BackendOptions, Devices
from controller.calibration.approval import Approval
from controller.config.arm import load_arm
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.domain import ArmDescription, ArmState, Frame
from controller.errors import BusError, CalibrationMissing, SorterError
from controller.ledger.sqlite import SqliteLedger
from controller.service import unit
from controller.service.doctor import cell, devices, host, software
from controller.service.doctor.case import Case, clock_in_step
from controller.service.doctor.examine import examine, worst
from controller.service.doctor.finding import Finding, Level
from controller.service.lock import InstanceLock
from sim_backends.virtual_clock import VirtualClock
from tests.unit.drivers.bench import ArmBench

NOW = datetime(2026, 11, 22, tzinfo=UTC)


def _no_command(command: Sequence[str]) -> str:
    raise SorterError(f"{command[0]}: no such command")


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
        run=_no_command,
        clock_in_step=lambda: True,
        now=NOW,
        devices=_never,
    )


def _never(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
    raise AssertionError("devices must not be opened here")


def _plug_in(case: Case, latency: str | None = "1") -> Case:
    """Camera and servo adapter, by the names that the shipped rules give them."""
    dev = case.root / "dev"
    for name, link in (("video0", "sorter-cam"), ("ttyUSB0", "sorter-arm")):
        (dev / name).touch()
        (dev / link).symlink_to(name)
    if latency is not None:
        timer = case.root / "sys/bus/usb-serial/devices/ttyUSB0/latency_timer"
        timer.parent.mkdir(parents=True)
        timer.write_text(latency + "\n")
    return case


def _level(finding: Finding | None) -> Level:
    assert finding is not None
    # Whoever is told of trouble is told what to do about it, and nobody else.
    assert bool(finding.remedy) == (finding.level is not Level.OK)
    return finding.level


# --- software ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "level"),
    [((3, 10, 13), Level.FAILED), ((3, 11, 0), Level.OK), ((3, 14, 1), Level.OK)],
)
def test_python(case: Case, version: tuple[int, ...], level: Level) -> None:
    assert _level(software.python(case, version)) is level


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
    assert _level(software.sqlite(case, version)) is level


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
    assert _level(found) is level
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

    assert _level(software.exposure(dataclasses.replace(case, run=run))) is level
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
    assert _level(found) is Level.OK
    assert found.finding == "active, 2 restarts"
    answer = "ActiveState=failed\nNRestarts=5\nResult=watchdog\n"
    assert _level(software.service(here)) is Level.WARNING
    assert "watchdog, after 5 restarts" in software.service(here).finding
    answer = "ActiveState=active\n"
    (case.root / "etc/modules-load.d/sorter.conf").unlink()
    found = software.service(here)
    assert _level(found) is Level.WARNING
    assert "sorter.conf" in found.finding


# --- the computer ------------------------------------------------------------------------------------------


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
    assert _level(host.disk(missing)) is level
    assert asked == [case.state]


@pytest.mark.parametrize(("in_step", "level"), [(True, Level.OK), (False, Level.WARNING), (None, Level.OK)])
def test_clock(case: Case, in_step: bool | None, level: Level) -> None:
    assert _level(host.clock(dataclasses.replace(case, clock_in_step=lambda: in_step))) is level


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
    assert _level(host.supply(case)) is level


# --- the cell ----------------------------------------------------------------------------------------------


def test_another_instance_is_named_and_its_devices_left_alone(case: Case) -> None:
    _plug_in(case)
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
    assert _level(cell.ledger(case)) is Level.OK
    with sqlite3.connect(path) as connection:
        connection.execute(f"PRAGMA user_version = {10**6}")
    connection.close()
    found = cell.ledger(case)
    assert _level(found) is Level.FAILED
    assert "newer version" in found.finding
    path.write_bytes(b"not a database, but long enough to be looked at as one" * 100)
    assert _level(cell.ledger(case)) is Level.FAILED


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
    assert _level(found) is level
    assert said in found.finding


def test_no_calibration_is_a_failure(case: Case) -> None:
    assert _level(cell.calibration(case)) is Level.FAILED


# --- devices -----------------------------------------------------------------------------------------------


def test_devices_that_are_not_there(case: Case) -> None:
    for found in devices.nodes(case):
        assert _level(found) is Level.FAILED
        assert "service install" in found.remedy
    assert devices.latency(case) is None
    assert devices.opened(dataclasses.replace(case, devices=_fake())) == []


def test_devices_that_are_there(case: Case) -> None:
    _plug_in(case)
    assert [_level(found) for found in devices.nodes(case)] == [Level.OK, Level.OK]
    assert devices.nodes(case)[1].finding == "/dev/sorter-arm is ttyUSB0"


def test_a_device_that_may_not_be_used_names_the_group(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    _plug_in(case)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    found = devices.nodes(case)[1]
    assert _level(found) is Level.FAILED
    assert "usermod -aG" in found.remedy


@pytest.mark.parametrize(("timer", "level"), [("1", Level.OK), ("16", Level.WARNING), (None, Level.OK)])
def test_latency_timer(case: Case, timer: str | None, level: Level) -> None:
    assert _level(devices.latency(_plug_in(case, timer))) is level


class _Camera:
    """A camera that shows one grey picture."""

    def __init__(self, grey: int, refused: tuple[str, ...]) -> None:
        self.settings_in_force = {"exposure": 156.0, "focus": 20.0}
        self.refused_settings = refused
        self.open_count = 0
        self._image = np.full((48, 64, 3), grey, np.uint8)

    def open(self) -> None:
        self.open_count += 1

    def close(self) -> None:
        self.open_count -= 1

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        return Frame(1, after, self._image)


class _Arm:
    """An arm that answers, and that fails the test when it is asked to do anything."""

    def __init__(self, volts: float, fault: SorterError | None) -> None:
        self.inventory = {number: object() for number in range(1, 8)}
        self.changed = ("servo 3: Return_Delay_Time 250 -> 0",)
        self._volts, self._fault = volts, fault
        self.open_count = 0

    def open(self) -> None:
        self.open_count += 1
        if self._fault is not None:
            raise self._fault

    def close(self) -> None:
        self.open_count -= 1

    def state(self) -> ArmState:
        return ArmState(0.0, np.zeros(5), np.zeros(5), 40.0, 0.0, voltage=self._volts, temperature=34.0)


def _fake(
    volts: float = 12.1, fault: SorterError | None = None, grey: int = 120, refused: tuple[str, ...] = ()
) -> Callable[[CellConfig, ArmDescription, BackendOptions], Devices]:
    def make(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
        return Devices(_Camera(grey, refused), _Arm(volts, fault), VirtualClock())  # type: ignore[arg-type]  # no motion

    return make


def _opened(case: Case, **given: object) -> dict[str, Finding]:
    made = _fake(**given)  # type: ignore[arg-type]  # the parameters of _fake
    return {found.name: found for found in devices.opened(dataclasses.replace(_plug_in(case), devices=made))}


def test_devices_in_order(case: Case) -> None:
    found = _opened(case)
    assert [_level(finding) for finding in found.values()] == [Level.OK] * 5
    assert found["camera settings"].finding == "exposure 156, focus 20"
    assert "7 servos answer, 1 settings were corrected" in found["servos"].finding
    assert "12.1 V" in found["servo supply"].finding


def test_settings_that_are_not_in_force_are_listed(case: Case) -> None:
    found = _opened(case, refused=("focus = 20: the camera has no such setting",))["camera settings"]
    assert _level(found) is Level.WARNING
    assert "focus = 20" in found.finding


@pytest.mark.parametrize(("grey", "level"), [(2, Level.WARNING), (100, Level.OK), (254, Level.WARNING)])
def test_a_picture_that_shows_nothing(case: Case, grey: int, level: Level) -> None:
    assert _level(_opened(case, grey=grey)["camera"]) is level


@pytest.mark.parametrize(("volts", "level"), [(9.9, Level.WARNING), (12.0, Level.OK), (14.8, Level.WARNING)])
def test_servo_supply(case: Case, volts: float, level: Level) -> None:
    assert _level(_opened(case, volts=volts)["servo supply"]) is level


def test_servos_that_do_not_answer_do_not_hide_the_camera(case: Case) -> None:
    fault = BusError("/dev/sorter-arm", "inventory", "timeout", "no answer from servo 3 (elbow)", "check the cables")
    found = _opened(case, fault=fault)
    assert _level(found["camera"]) is Level.OK
    assert _level(found["servos"]) is Level.FAILED
    assert "servo 3 (elbow)" in found["servos"].finding


@pytest.mark.parametrize("holding", [False, True])
def test_the_real_driver_is_asked_without_a_move_and_torque_stays_as_it_is(case: Case, holding: bool) -> None:
    bench = ArmBench("reactorx_150")
    with bench.ready() as arm:
        if not holding:
            arm.relax()
    ids = [joint.servo_id for joint in bench.description.joints]
    before = bench.positions()
    bench.stream.goals.clear()

    def make(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
        return Devices(_Camera(120, ()), bench.arm, bench.clock)

    found = {f.name: f for f in devices.opened(dataclasses.replace(_plug_in(case), devices=make))}
    # Five joints, of which two have a second servo, and the gripper.
    assert found["servos"].finding == f"{bench.description.title}: {len(bench.bus.servo_ids)} servos answer"
    assert _level(found["servo supply"]) is Level.OK
    assert bench.stream.goals == []
    assert [bench.register(number, "Torque_Enable") for number in ids] == [int(holding)] * len(ids)
    # A holding arm sags no further than its encoders can tell: 0.09 degrees.
    assert np.abs(bench.positions() - before).max() < 0.0016


def test_devices_are_released(case: Case) -> None:
    made: list[Devices] = []

    def make(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
        made.append(_fake()(config, arm, options))
        return made[-1]

    devices.opened(dataclasses.replace(_plug_in(case), devices=make))
    assert isinstance(made[0].camera, _Camera)
    assert made[0].camera.open_count == 0
    assert isinstance(made[0].arm, _Arm)
    assert made[0].arm.open_count == 0


# --- as a whole --------------------------------------------------------------------------------------------


def test_everything_is_looked_at(case: Case) -> None:
    names = {found.name for found in examine(dataclasses.replace(_plug_in(case), devices=_fake()))}
    assert names >= {"python", "libraries", "sqlite", "unit", "disk", "clock", "instance", "ledger"}
    assert names >= {"configuration", "calibration", "camera file", "servo port", "latency timer", "camera", "servos"}


def test_a_configuration_that_is_wrong_is_a_failure_and_the_rest_is_still_looked_at(case: Case, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("nmae = 1\n")
    findings = {found.name: found for found in examine(dataclasses.replace(case, config=wrong, cell=None, arm=None))}
    assert _level(findings["configuration"]) is Level.FAILED
    assert "disk" in findings
    assert "camera file" not in findings


def test_a_check_that_goes_wrong_does_not_keep_the_others_from_being_made(case: Case) -> None:
    def broken() -> bool:
        raise ZeroDivisionError("oops")

    findings = {found.name: found for found in examine(dataclasses.replace(case, clock_in_step=broken))}
    assert findings["clock"].level is Level.FAILED
    assert "oops" in findings["clock"].finding
    assert "ledger" in findings


def test_the_worst_finding_decides() -> None:
    levels = [Level.OK, Level.FAILED, Level.WARNING]
    findings = [Finding("x", level, "") for level in levels]
    assert worst(findings) is Level.FAILED
    assert worst([findings[0], findings[2]]) is Level.WARNING
    assert worst([]) is Level.OK

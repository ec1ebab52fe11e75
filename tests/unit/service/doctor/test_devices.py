"""The doctor on the devices, and as a whole: nothing moves, and one failing check hides no other."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from controller.backends import BackendOptions, Devices
from controller.config.cell import CellConfig
from controller.domain import ArmDescription
from controller.errors import BusError
from controller.service.doctor import devices
from controller.service.doctor.case import Case
from controller.service.doctor.examine import examine, worst
from controller.service.doctor.finding import Finding, Level
from tests.unit.drivers.bench import ArmBench
from tests.unit.service.doctor.machines import GreyCamera, SilentArm, fake_devices, level_of, opened, plug_in

# --- devices -------------------------------------------------------------------------------------------


def test_devices_that_are_not_there(case: Case) -> None:
    for found in devices.nodes(case):
        assert level_of(found) is Level.FAILED
        assert "service install" in found.remedy
    assert devices.latency(case) is None
    assert devices.opened(dataclasses.replace(case, devices=fake_devices())) == []


def test_devices_that_are_there(case: Case) -> None:
    plug_in(case)
    assert [level_of(found) for found in devices.nodes(case)] == [Level.OK, Level.OK]
    assert devices.nodes(case)[1].finding == "/dev/sorter-arm is ttyUSB0"


def test_a_device_that_may_not_be_used_names_the_group(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    plug_in(case)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    found = devices.nodes(case)[1]
    assert level_of(found) is Level.FAILED
    assert "usermod -aG" in found.remedy


@pytest.mark.parametrize(("timer", "level"), [("1", Level.OK), ("16", Level.WARNING), (None, Level.OK)])
def test_latency_timer(case: Case, timer: str | None, level: Level) -> None:
    assert level_of(devices.latency(plug_in(case, timer))) is level


def test_devices_in_order(case: Case) -> None:
    found = opened(case)
    assert [level_of(finding) for finding in found.values()] == [Level.OK] * 5
    assert found["camera settings"].finding == "exposure 156, focus 20"
    assert "7 servos answer, 1 setting was corrected" in found["servos"].finding
    assert "12.1 V" in found["servo supply"].finding


def test_settings_that_are_not_in_force_are_listed(case: Case) -> None:
    found = opened(case, refused=("focus = 20: the camera has no such setting",))["camera settings"]
    assert level_of(found) is Level.WARNING
    assert "focus = 20" in found.finding


@pytest.mark.parametrize(("grey", "level"), [(2, Level.WARNING), (100, Level.OK), (254, Level.WARNING)])
def test_a_picture_that_shows_nothing(case: Case, grey: int, level: Level) -> None:
    assert level_of(opened(case, grey=grey)["camera"]) is level


@pytest.mark.parametrize(("volts", "level"), [(9.9, Level.WARNING), (12.0, Level.OK), (14.8, Level.WARNING)])
def test_servo_supply(case: Case, volts: float, level: Level) -> None:
    assert level_of(opened(case, volts=volts)["servo supply"]) is level


def test_servos_that_do_not_answer_do_not_hide_the_camera(case: Case) -> None:
    fault = BusError("/dev/sorter-arm", "inventory", "timeout", "no answer from servo 3 (elbow)", "check the cables")
    found = opened(case, fault=fault)
    assert level_of(found["camera"]) is Level.OK
    assert level_of(found["servos"]) is Level.FAILED
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
        return Devices(GreyCamera(120, ()), bench.arm, bench.clock)

    found = {f.name: f for f in devices.opened(dataclasses.replace(plug_in(case), devices=make))}
    # Five joints, of which two have a second servo, and the gripper.
    assert found["servos"].finding == f"{bench.description.title}: {len(bench.bus.servo_ids)} servos answer"
    assert level_of(found["servo supply"]) is Level.OK
    assert bench.stream.goals == []
    assert [bench.register(number, "Torque_Enable") for number in ids] == [int(holding)] * len(ids)
    # A holding arm sags no further than its encoders can tell: 0.09 degrees.
    assert np.abs(bench.positions() - before).max() < 0.0016


def test_devices_are_released(case: Case) -> None:
    made: list[Devices] = []

    def make(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
        made.append(fake_devices()(config, arm, options))
        return made[-1]

    devices.opened(dataclasses.replace(plug_in(case), devices=make))
    assert isinstance(made[0].camera, GreyCamera)
    assert made[0].camera.open_count == 0
    assert isinstance(made[0].arm, SilentArm)
    assert made[0].arm.open_count == 0


# --- as a whole ----------------------------------------------------------------------------------------


def test_everything_is_looked_at(case: Case) -> None:
    names = {found.name for found in examine(dataclasses.replace(plug_in(case), devices=fake_devices()))}
    assert names >= {"python", "libraries", "sqlite", "unit", "disk", "clock", "instance", "ledger"}
    assert names >= {"configuration", "calibration", "camera file", "servo port", "latency timer", "camera", "servos"}


def test_a_configuration_that_is_wrong_is_a_failure_and_the_rest_is_still_looked_at(case: Case, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("nmae = 1\n")
    findings = {found.name: found for found in examine(dataclasses.replace(case, config=wrong, cell=None, arm=None))}
    assert level_of(findings["configuration"]) is Level.FAILED
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

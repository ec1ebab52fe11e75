"""What may move an arm by itself: a certified calibration of these devices, and none other."""

from __future__ import annotations

import json
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from controller.calibration import store
from controller.calibration.approval import approve
from controller.errors import CalibrationMissing, CalibrationPoorFit, CalibrationStale, SorterError
from tests.unit.calibration.certified import certify
from tests.unit.calibration.test_store import parts

pytestmark = pytest.mark.safety("SR-05")
NOW = datetime.now().astimezone()
DEVICES = {"camera": "usb-Cam-1", "port": "usb-FTDI-1"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    camera, table, arm = parts()
    store.save(tmp_path, camera=camera, table=table, arm=arm, provenance=DEVICES)
    return tmp_path


def refusal(folder: Path, devices: dict[str, str] | None = None, now: datetime = NOW) -> SorterError | None:
    stored = store.load(folder)
    assert stored.arm is not None
    try:
        approve(folder, stored, arm=stored.arm.arm, devices=devices or DEVICES, now=now)
    except SorterError as error:
        return error
    return None


def test_a_certified_calibration_may_work(folder: Path) -> None:
    certify(folder, **DEVICES)
    assert refusal(folder) is None


def test_without_a_certificate_nothing_moves(folder: Path) -> None:
    found = refusal(folder)
    assert isinstance(found, CalibrationMissing)
    assert "never proved" in found.cause
    assert "calibrate check" in found.remedy


def test_a_failed_certificate_is_refused(folder: Path) -> None:
    certify(folder, verdict="failed", touch_mm={"mean": 1.23, "p95": 2.0, "max": 3.0})
    found = refusal(folder)
    assert isinstance(found, CalibrationPoorFit)
    assert "1.23 mm" in found.cause


def test_an_old_certificate_is_refused(folder: Path) -> None:
    certify(folder)
    found = refusal(folder, now=NOW + timedelta(days=200))
    assert isinstance(found, CalibrationStale)
    assert "200 days ago" in found.cause


@pytest.mark.parametrize("key", ["calibration_id", "camera_id", "table_id"])
def test_a_certificate_of_other_files_is_refused(folder: Path, key: str) -> None:
    certify(folder, **{key: "another"})
    found = refusal(folder)
    assert isinstance(found, CalibrationStale)
    assert "another" in found.cause


def test_an_edited_certificate_is_refused(folder: Path) -> None:
    certify(folder, verdict="failed")
    path = folder / store.CERTIFICATE
    path.write_text(path.read_text().replace('"failed"', '"passed"'))
    found = refusal(folder)
    assert isinstance(found, CalibrationStale)
    assert "edited" in found.cause


@pytest.mark.parametrize("key", ["camera", "port"])
def test_other_devices_are_refused(folder: Path, key: str) -> None:
    certify(folder, **DEVICES)
    found = refusal(folder, DEVICES | {key: "another"})
    assert isinstance(found, CalibrationStale)
    assert DEVICES[key] in found.cause
    assert "another" in found.cause


def test_a_lens_that_is_hardly_known_is_refused(folder: Path) -> None:
    camera, table, arm = parts(uncertainty_mm=1.2, distance_mm=500.0)
    store.save(folder, camera=camera, table=table, arm=arm)
    certify(folder)
    found = refusal(folder)
    assert isinstance(found, CalibrationPoorFit)
    assert "lens" in found.cause


def test_going_back_takes_the_certificate_along(folder: Path) -> None:
    first = store.load(folder).arm
    certify(folder)
    *_, arm = parts(points=33)
    store.save(folder, arm=arm)
    second = store.load(folder).arm
    certify(folder)
    assert first is not None
    assert second is not None
    assert first.calibration_id != second.calibration_id
    assert store.restore_previous(folder) == (store.ARM, store.CERTIFICATE)
    again = store.load(folder).arm
    assert again is not None
    assert again.calibration_id == first.calibration_id
    assert json.loads((folder / store.CERTIFICATE).read_text())["calibration_id"] == first.calibration_id
    assert refusal(folder) is None

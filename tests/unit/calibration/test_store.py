"""A calibration folder: parts that belong together, written whole, one step back."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from controller.calibration import files, store
from controller.calibration.arm import ArmCalibration, Residual, arm_from_json, named
from controller.calibration.camera import CameraCalibration, camera_from_json
from controller.calibration.table import TableCalibration, table_from_json
from controller.errors import CalibrationMissing, CalibrationStale, InputError
from controller.geometry import pose, pose_from_rvec
from tests.unit.calibration.scene import LENS

T_TABLE_CAMERA = pose(0.0, 0.0, 600.0) @ pose_from_rvec([math.pi, 0.0, 0.0], [0.0, 0.0, 0.0])


Parts = tuple[CameraCalibration, TableCalibration, ArmCalibration]


def parts(focal: float = 1000.0, *, points: int = 20, **lens: float) -> Parts:
    matrix = LENS.matrix.copy()
    matrix[0, 0] = focal
    raw = {
        "camera_matrix": matrix.tolist(),
        "dist_coeffs": [-0.2, 0.05, 0.0, 0.0, 0.0],
        "image_size": [1280, 720],
        "uncertainty_mm": 0.245,
        **lens,
    }
    camera = camera_from_json(raw, "test")
    table = table_from_json({"T_table_camera": T_TABLE_CAMERA.tolist(), "camera_id": camera.calibration_id}, "test")
    arm = named(
        ArmCalibration(
            "",
            camera.calibration_id,
            table.calibration_id,
            "reactorx_150",
            pose(230.5, 1.0, 0.2, yaw=0.01),
            {"waist": 0.0, "shoulder": 0.02},
            np.eye(4),
            Residual(0.3, 0.6, 0.9),
            points,
            (30.0, 5.0),
            {"shoulder": 0.001},
        )
    )
    return camera, table, arm


def write_all(folder: Path, focal: float = 1000.0) -> Parts:
    camera, table, arm = parts(focal)
    store.save(folder, camera=camera, table=table, arm=arm, provenance={"made_at": "2026-01-01", "camera": "cam0"})
    return camera, table, arm


def test_a_cell_survives_its_folder(tmp_path: Path) -> None:
    camera, table, arm = write_all(tmp_path / "new" / "folder")
    held = store.load(tmp_path / "new" / "folder")
    assert (held.camera.calibration_id, held.table.calibration_id) == (camera.calibration_id, table.calibration_id)
    assert held.arm is not None
    assert held.arm.to_json() == arm.to_json()
    assert held.provenance["arm.json"]["made_at"] == "2026-01-01"
    cell = store.load_calibration(tmp_path / "new" / "folder")
    assert cell.joint_offsets == {"waist": 0.0, "shoulder": 0.02}
    assert np.allclose(cell.T_base_table, arm.T_base_table)
    assert cell.sigma == pytest.approx(0.1)
    assert cell.calibration_id == store.cell_calibration(camera, table, arm).calibration_id


def test_the_id_is_of_the_measurement_not_of_the_notes(tmp_path: Path) -> None:
    write_all(tmp_path / "a")
    camera, table, arm = parts()
    store.save(tmp_path / "b", camera=camera, table=table, arm=arm, provenance={"made_at": "2026-02-02"})
    first, second = (store.load_calibration(tmp_path / name) for name in "ab")
    assert first.calibration_id == second.calibration_id
    write_all(tmp_path / "c", focal=1001.0)
    assert store.load_calibration(tmp_path / "c").calibration_id != first.calibration_id


@pytest.mark.parametrize("name", ["camera.json", "table.json"])
@pytest.mark.safety("SR-05")
def test_a_swapped_file_is_refused(name: str, tmp_path: Path) -> None:
    write_all(tmp_path / "a")
    write_all(tmp_path / "b", focal=1003.0)
    (tmp_path / "a" / name).write_bytes((tmp_path / "b" / name).read_bytes())
    with pytest.raises(CalibrationStale, match="made with the camera calibration"):
        store.load(tmp_path / "a")


@pytest.mark.safety("SR-05")
def test_foreign_devices_are_refused(tmp_path: Path) -> None:
    write_all(tmp_path)
    held = store.load(tmp_path)
    held.check(arm="reactorx_150", devices={"camera": "cam0"})
    with pytest.raises(CalibrationStale, match="widowx_250"):
        held.check(arm="widowx_250")
    with pytest.raises(CalibrationStale, match="cam7"):
        held.check(devices={"camera": "cam7"})


def test_one_step_back_and_forth(tmp_path: Path) -> None:
    first, *_ = write_all(tmp_path, focal=1000.0)
    second, *_ = write_all(tmp_path, focal=1010.0)
    assert store.load(tmp_path).camera.calibration_id == second.calibration_id
    assert set(store.restore_previous(tmp_path)) == set(store.NAMES)
    assert store.load(tmp_path).camera.calibration_id == first.calibration_id
    store.restore_previous(tmp_path)
    assert store.load(tmp_path).camera.calibration_id == second.calibration_id


def test_nothing_to_go_back_to(tmp_path: Path) -> None:
    write_all(tmp_path)
    with pytest.raises(CalibrationMissing, match="no earlier"):
        store.restore_previous(tmp_path)


def test_a_failed_write_leaves_the_old_file_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera, *_ = write_all(tmp_path)
    before = (tmp_path / "camera.json").read_text()

    def broken(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", broken)
    with pytest.raises(InputError, match="No space left"):
        store.save(tmp_path, camera=camera)
    assert (tmp_path / "camera.json").read_text() == before
    assert not list(tmp_path.glob(".*.tmp"))


@pytest.mark.safety("SR-05")
def test_what_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationMissing, match="no such calibration folder"):
        store.load(tmp_path / "none")
    camera, table, _ = parts()
    store.save(tmp_path, camera=camera)
    with pytest.raises(CalibrationMissing, match=r"table\.json"):
        store.load(tmp_path)
    store.save(tmp_path, table=table)
    with pytest.raises(CalibrationMissing, match="arm"):
        store.load_calibration(tmp_path)


def test_by_ruler_says_that_nothing_vouches_for_it(tmp_path: Path) -> None:
    camera, table, _ = parts()
    store.save_calibration(tmp_path, camera, table, pose(230.0, 0.0, 0.0), arm="reactorx_150")
    held = store.load(tmp_path)
    assert held.arm is not None
    assert held.arm.points == 0
    assert held.cell().joint_offsets == {}


@pytest.mark.safety("SR-05", "SR-43")
def test_hostile_arm_files_are_refused() -> None:
    _, _, arm = parts()
    good = arm.to_json()
    assert arm_from_json(good, "arm.json").calibration_id == arm.calibration_id
    for key, value in (
        ("T_base_table", np.zeros((4, 4)).tolist()),
        ("joint_offsets", {"waist": 2.0}),
        ("joint_offsets", {"waist": "0.1"}),
        ("joint_offsets", [0.1]),
        ("residual_mm", {"mean": 1.0}),
        ("singular_values", {"a": 1}),
        ("sigma", None),
    ):
        with pytest.raises(InputError, match=r"arm\.json"):
            arm_from_json({**good, key: value}, "arm.json")


def test_parts_are_the_values_they_claim() -> None:
    camera, table, _ = parts()
    assert isinstance(camera, CameraCalibration)
    assert isinstance(table, TableCalibration)
    content = json.loads(json.dumps(camera.to_json()))
    assert files.identity("camera", content) == camera.calibration_id

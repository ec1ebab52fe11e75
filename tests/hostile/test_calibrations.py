"""Calibration files with anything in them: refused with words, or a calibration of finite numbers."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.calibration import files
from controller.calibration.identified import IDENTIFICATION, load_identified
from controller.calibration.store import load_calibration
from controller.config.arm import load_arm
from controller.errors import SorterError
from controller.service.doctor.case import Case
from controller.service.doctor.cell import calibration as doctors_look
from tests.hostile.mutations import HOSTILE, mutated, spoiled
from tests.unit.calibration.test_store import write_all

NAMES = ("camera.json", "table.json", "arm.json")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole calibration, with a certificate and figures of identification."""
    folder = tmp_path_factory.mktemp("calibrated")
    write_all(folder)
    arm = load_arm("reactorx_150")
    joints = {name: {"stiffness": 18.0, "friction": 0.1} for name in arm.joint_names}
    content: dict[str, Any] = {"arm": arm.name, "joints": joints, "link_scale": [1.0] * len(arm.links)}
    (folder / IDENTIFICATION).write_text(json.dumps(content), encoding="utf-8")
    verdict = {"verdict": "passed", "calibration_id": load_calibration(folder).calibration_id}
    (folder / "certificate.json").write_text(json.dumps(verdict), encoding="utf-8")
    assert load_identified(folder, arm) is not arm
    return folder


def kind(name: str) -> str:
    return name.partition(".")[0]


@pytest.mark.safety("SR-05", "SR-43")
@pytest.mark.parametrize("honest", [False, True], ids=["id as it was", "id made to fit"])
@HOSTILE
@given(data=st.data())
def test_what_is_accepted_is_finite_and_belongs_together(
    data: st.DataObject, honest: bool, folder: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    name = data.draw(st.sampled_from(NAMES))
    content: Any = data.draw(mutated(json.loads((folder / name).read_text(encoding="utf-8"))))
    if honest and isinstance(content, dict):
        # Somebody who edits a file and puts a right name on it: the numbers themselves must be refused.
        try:
            content["calibration_id"] = files.identity(kind(name), content)
        except (ValueError, RecursionError):
            return
    (copy / name).write_text(json.dumps(content), encoding="utf-8")
    try:
        found = load_calibration(copy)
    except SorterError:
        return
    for array in (found.camera.matrix, found.camera.distortion, found.T_table_camera, found.T_base_table):
        assert np.isfinite(array).all()
    assert all(np.isfinite(offset) for offset in found.joint_offsets.values())


@pytest.mark.safety("SR-43")
@pytest.mark.parametrize("name", [*NAMES, IDENTIFICATION, "certificate.json"])
@HOSTILE
@given(data=st.data())
def test_no_bytes_crash_a_reader(data: st.DataObject, name: str, folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "calibration"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    (copy / name).write_bytes(data.draw(spoiled((folder / name).read_bytes())))
    arm = load_arm("reactorx_150")
    readers: tuple[Callable[[], object], ...] = (
        lambda: load_calibration(copy),
        lambda: load_identified(copy, arm),
        lambda: doctors_look(Case(tmp_path, arm=arm)),
    )
    for read in readers:
        try:
            read()
        except SorterError as error:
            assert str(error).isprintable()

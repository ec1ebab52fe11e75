"""`controller calibrate arm` and `check`, as their user starts them, on the simulated cell."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from controller.backends import Level
from controller.calibration import files
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.errors import SafetyStop
from controller.service.self_calibration import CalibrationOptions, check_cell, open_cell
from tests.system.conftest import Controller

FIGURES = {"mean", "p95", "max"}


@pytest.fixture
def calibrated(controller: Controller, tmp_path: Path) -> dict[str, Any]:
    """What `calibrate arm` said of the cell with seed 1; the calibration is in `cal`."""
    done = controller("calibrate", "arm", "--sim", "--level", "static", "--seed", 1, "--calibration", "cal", "--json")
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.splitlines()
    made: dict[str, Any] = json.loads(line)
    return made


@pytest.mark.safety("SR-05")
def test_a_cell_is_calibrated_certified_and_refused_when_something_changed(
    calibrated: dict[str, Any], controller: Controller, tmp_path: Path
) -> None:
    assert set(calibrated["residual_mm"]) == FIGURES
    assert calibrated["points"] >= 15
    assert calibrated["sim_s"] < 240.0
    for name in ("camera.json", "table.json", "arm.json"):
        assert json.loads((tmp_path / "cal" / name).read_text())["calibration_id"]
    arguments = ("calibrate", "check", "--sim", "--level", "static", "--calibration", "cal", "--points", 20)

    # Somebody has bumped into the camera: 8 mm to the side, everything else as it was.
    bumped = tmp_path / "bumped.toml"
    text = shipped("sim.toml").read_text()
    assert "above_mm = [-15.0, 0.0]" in text
    bumped.write_text(text.replace("above_mm = [-15.0, 0.0]", "above_mm = [-7.0, 0.0]"))
    moved = controller(*arguments, "--seed", 1, "--config", bumped)
    assert moved.returncode == 1
    assert "was moved" in moved.stderr.splitlines()[-1]
    # Another seed is another camera and another arm.
    foreign = controller("run", "--sim", "--level", "static", "--calibration", "cal", "--seed", 2, "--parts", 1)
    assert foreign.returncode == 1
    assert "made with camera simulated camera 1, this cell has simulated camera 2" in foreign.stderr
    assert not (tmp_path / "cal" / "certificate.json").exists()

    done = controller(*arguments, "--seed", 1, "--json")
    assert done.returncode == 0, done.stderr
    certificate = json.loads(done.stdout)
    assert certificate["verdict"] == "passed"
    assert certificate["calibration_id"] == calibrated["calibration_id"]
    assert certificate["points"] >= 18  # one or another marker may be hidden
    assert certificate["sim_s"] < 240.0
    # The limits; measured 0.25 to 0.3 mm in the mean.
    assert certificate["truth_mm"]["mean"] <= 0.8
    assert certificate["truth_mm"]["p95"] <= 1.5
    # What the camera says is what is true.
    assert abs(certificate["touch_mm"]["mean"] - certificate["truth_mm"]["mean"]) < 0.15
    assert certificate["before_mm"]["mean"] > 3 * certificate["truth_mm"]["mean"]
    fitted = np.array(json.loads((tmp_path / "cal" / "arm.json").read_text())["places"])
    for x, y in certificate["places_mm"]:
        assert np.linalg.norm(fitted - [x, y, 20.0], axis=1).min() > 14.5
    kept = json.loads((tmp_path / "cal" / "certificate.json").read_text())
    assert {"made_at", "software", "camera", "port", "arm", "limits_mm", "verdict"} <= set(kept)
    picture = cv2.imread(str(tmp_path / "cal" / "certificate.png"))
    assert picture is not None

    # Something lies where the jaws would come down.
    options = CalibrationOptions(load_cell(shipped("sim.toml")), True, 1, Level.STATIC, tmp_path / "cal")
    with open_cell(options) as (devices, folder):
        devices.lay_round_part()
        before = devices.arm.state().positions
        with pytest.raises(SafetyStop, match="not empty: a circle lies"):
            check_cell(devices, options.config, folder, 1, options.say)
        # Without torque it leans on its rest by a degree.
        assert np.abs(devices.arm.state().positions - before).max() < np.radians(2.0)
    assert json.loads((tmp_path / "cal" / "certificate.json").read_text()) == kept

    # A certificate that somebody has helped along.
    helped = tmp_path / "helped"
    shutil.copytree(tmp_path / "cal", helped)
    text = (helped / "certificate.json").read_text()
    (helped / "certificate.json").write_text(text.replace('"points": ', '"points": 1'))
    work = ("run", "--sim", "--level", "static", "--seed", 1, "--parts", 1, "--calibration")
    refused = controller(*work, helped)
    assert refused.returncode == 1
    assert "was edited" in refused.stderr

    # A lens file from elsewhere: its id is in order, but table and arm were not made with it.
    swapped = tmp_path / "swapped"
    shutil.copytree(tmp_path / "cal", swapped)
    lens = json.loads((swapped / "camera.json").read_text())
    lens["camera_matrix"][0][0] *= 1.01
    lens["calibration_id"] = files.identity("camera", lens)
    (swapped / "camera.json").write_text(json.dumps(lens))
    for command in (("calibrate", "check", "--sim", "--calibration"), work):
        refused = controller(*command, swapped)
        assert refused.returncode == 1
        assert "made with the camera calibration" in refused.stderr

    back = controller("calibrate", "restore", "--calibration", "cal")
    assert back.returncode == 0, back.stderr
    assert "placed by ruler" in back.stdout  # what `calibrate arm` has replaced
    lens["camera_matrix"][0][0] *= 1.01
    (swapped / "camera.json").write_text(json.dumps(lens))
    edited = controller("calibrate", "check", "--sim", "--calibration", swapped)
    assert edited.returncode == 1
    assert "was edited" in edited.stderr


def test_what_is_missing_is_said(controller: Controller, tmp_path: Path) -> None:
    without = controller("calibrate", "arm")
    assert without.returncode == 78
    assert "--sim" in without.stderr
    nothing = controller("calibrate", "check", "--sim", "--calibration", tmp_path / "none")
    assert nothing.returncode == 1
    assert "no such calibration folder" in nothing.stderr

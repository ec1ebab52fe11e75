"""The certificate says what a touch would miss by, at places no fit has seen."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from controller.calibration.arm import ArmCalibration, by_ruler
from controller.calibration.arm_fit import Observation, fit_arm
from controller.calibration.arm_model import MarkerView
from controller.calibration.arm_poses import choose
from controller.calibration.camera import CameraCalibration
from controller.calibration.certificate import FAILED, PASSED, Certificate, check_arm
from controller.calibration.looks import APART
from controller.calibration.marker import ArmMarker
from controller.calibration.table import TableCalibration
from controller.config.arm import load_arm
from controller.errors import CalibrationStale, Unreachable
from controller.geometry import pose, pose_from_rvec
from controller.motion import kinematics
from tests.unit.calibration.metal import Cell, Metal, small
from tests.unit.calibration.scene import LENS

Array = NDArray[np.float64]
ARM = load_arm("reactorx_150")
ABOVE = pose(0.0, 0.0, 600.0, yaw=math.pi / 2) @ pose_from_rvec([math.pi, 0.0, 0.0], [0.0, 0.0, 0.0])
LENS_KNOWN = CameraCalibration("camera-x", LENS, 0.1, 20)


def metal(seed: int) -> Metal:
    return Metal(ARM, LENS, ABOVE @ small(np.random.default_rng(seed), 15.0, 3.0), seed=seed)


def calibrated(m: Metal, *, touched: bool = False) -> ArmCalibration:
    """By its marker; and by eight pushes of a disc, the wrist turned to either side."""
    view = MarkerView(ARM, ArmMarker(), LENS, m.T_table_camera, m.nominal)
    seen = [Observation(q, m.corners(q)) for q in choose(view, 20, clearance=45.0)]
    poses = [kinematics.inverse(ARM, [200.0, y, 24.0], roll=roll)[0] for y in (-30.0, 20.0) for roll in (1.57, -1.57)]
    pushes = [m.push(q, side, 21.5, 24.0) for q in poses for side in (1.0, -1.0)] if touched else []
    return fit_arm(view, seen, touches=pushes)


def check(
    m: Metal,
    calibration: ArmCalibration,
    *,
    looked_at: Metal | None = None,
    arrived: list[Array] | None = None,
    **options: Any,
) -> tuple[Certificate, Array]:
    """The certificate, and by how much (N, 2) the arm truly missed, its play drawn anew.

    `looked_at` is the cell as it is by now, when it is no longer as it was calibrated.
    """
    # Only the methods that the procedure calls are there.
    cell: Any = Cell(looked_at or m)
    offsets = np.array([calibration.joint_offsets.get(name, 0.0) for name in m.arm.joint_names])
    missed: list[Array] = [] if arrived is None else arrived
    table = TableCalibration("table-x", "camera-x", m.T_table_camera, 0.1, 0.1, 10)
    found = check_arm(
        cell,
        cell,
        cell,
        lambda q: cell.move_to(q + offsets),
        lambda: None,
        lens=LENS_KNOWN,
        table=table,
        calibration=calibration,
        T_base_table=m.nominal,
        arrived=lambda place: missed.append(m.grasp_point(cell.q)[:2] - place[:2]),
        **options,
    )
    return found, np.array(missed)


@pytest.mark.safety("SR-05")
def test_a_calibrated_arm_gets_a_good_one_and_an_uncalibrated_a_poor_one() -> None:
    m = replace(metal(1), jaws=(0.9, -0.8))
    arm = calibrated(m, touched=True)
    # What 0.3 degrees of play leave of eight touches.
    assert np.abs(np.array(arm.jaws) - m.jaws).max() < 0.3
    found, missed = check(m, arm, seed=7, points=8)
    true = np.linalg.norm(missed, axis=1)
    assert found.verdict == PASSED
    assert len(found.places) >= 6
    # Play of 0.3 degrees in every joint, drawn once for the look and once for the truth: 0.5 mm each.
    assert abs(found.touch_mm.mean - true.mean()) < 0.4
    assert found.before_mm.mean > 2 * found.touch_mm.mean
    raw, raw_missed = check(m, by_ruler(m.nominal, "", "", ARM.name), seed=7, points=8)
    assert raw.verdict == FAILED
    # The marker's mount by its drawing is off by up to 2 mm an axis: so is what its look says of a touch.
    assert raw.touch_mm.mean > 1.5
    assert np.linalg.norm(raw_missed, axis=1).mean() > 1.5


def test_jaws_off_centre_that_nothing_touched_are_not_certified() -> None:
    m = replace(metal(1), jaws=(0.9, -0.8))
    found, missed = check(m, calibrated(m), seed=7, points=6)
    assert found.touch_mm.mean < 0.8  # the camera sees nothing wrong
    assert np.linalg.norm(missed, axis=1).mean() > 0.8
    assert found.verdict == FAILED


def test_places_are_fresh_spread_and_repeatable() -> None:
    m = metal(2)
    arm = calibrated(m)
    one, _ = check(m, arm, seed=3, points=6)
    two, _ = check(m, arm, seed=3, points=3)
    other, _ = check(m, arm, seed=4, points=3)
    assert np.allclose(two.places, check(m, arm, seed=3, points=3)[0].places)
    assert not np.allclose(two.places[0], other.places[0])
    fitted = np.array(arm.places)
    assert len(fitted) == arm.points
    for x, y in one.places:
        # Jaw tips 5 mm over the table hold the grasp point 20 mm over it.
        assert np.linalg.norm(fitted - [x, y, 20.0], axis=1).min() > APART - 0.5
    assert np.ptp(one.places[:, 1]) > 150.0  # the whole sector, not one side of it


def test_a_moved_camera_is_noticed_above_the_table() -> None:
    m = metal(1)
    arm = calibrated(m)
    # Bumped by 6 mm: less than a hand's width of the picture, more than any touch may miss.
    bumped = replace(m, T_table_camera=pose(5.0, -4.0, 0.0) @ m.T_table_camera)
    before: list[Array] = []
    with pytest.raises(CalibrationStale, match="was moved"):
        check(m, arm, seed=1, points=6, looked_at=bumped, arrived=before)
    assert before == []  # nothing went down to the table


def test_its_json_is_the_contracts() -> None:
    m = metal(3)
    found, _ = check(m, calibrated(m), seed=1, points=6)
    content = found.to_json()
    assert {"touch_mm", "before_mm", "points", "verdict", "calibration_id"} <= set(content)
    assert set(content["touch_mm"]) == {"mean", "p95", "max"}
    assert len(content["places_mm"]) == len(content["errors_mm"]) == content["points"]


def test_an_arm_without_a_roll_is_certified_by_touching_only() -> None:
    short = load_arm("pincherx_100")
    m = Metal(short, LENS, ABOVE @ small(np.random.default_rng(1), 15.0, 3.0), nominal=pose(170.0, 0.0, 0.0), seed=1)
    view = MarkerView(short, ArmMarker(), LENS, m.T_table_camera, m.nominal)
    seen = [Observation(q, m.corners(q)) for q in choose(view, 20, clearance=45.0)]
    arm = fit_arm(view, seen)
    found, missed = check(m, arm, seed=7, points=6, radius=(120.0, 200.0))
    # The camera sees nothing wrong, yet the tip is beside: the offset of the last joint hides in the mount.
    assert found.touch_mm.mean < 1.0
    blind = np.linalg.norm(missed, axis=1).mean()
    assert blind > found.touch_mm.mean
    assert found.unseen_mm > 1.0
    assert found.verdict == FAILED

    pushes = [
        m.push(kinematics.inverse(short, [radius, 5.0, 24.0])[0], side, 21.5, 24.0)
        for side, radius in ((1.0, 130.0), (-1.0, 175.0)) * 4
    ]
    one_sided = fit_arm(view, seen, touches=[touch for touch in pushes if touch.side > 0.0])
    assert one_sided.touches == 0  # how far before the jaws the part lies would pass for the tip
    touched = fit_arm(view, seen, touches=pushes)
    assert touched.touches == len(pushes)
    # Known to 2 degrees before; eight pushes average the play of three joints, 0.09 degrees each.
    assert touched.sigma["wrist_angle"] < math.radians(0.2)
    assert abs(touched.joint_offsets["wrist_angle"] - m.offsets[3]) < 3.0 * touched.sigma["wrist_angle"]
    found, missed = check(m, touched, seed=7, points=6, radius=(120.0, 200.0))
    assert found.unseen_mm < 0.4
    assert np.linalg.norm(missed, axis=1).mean() < 0.6 * blind


def test_a_work_area_out_of_reach_is_said() -> None:
    m = metal(1)
    with pytest.raises(Unreachable, match="places can be reached"):
        check(m, calibrated(m), seed=1, points=6, radius=(600.0, 700.0))

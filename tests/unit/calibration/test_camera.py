"""A known lens is found again from views of a board, and what cannot be known is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.calibration import bundle
from controller.calibration.board_search import BoardView
from controller.calibration.board_spec import parse_board
from controller.calibration.camera import CameraCalibration, LensModel, calibrate_camera, fit_views
from controller.calibration.guided import board_pose_for, wanted_views
from controller.calibration.table import board_pose
from controller.calibration.views import find_views
from controller.errors import CalibrationMissing, CalibrationPoorFit, CalibrationStale, InputError
from controller.geometry import CameraModel, PlaneMap, invert, pose_from_rvec, transform
from tests.unit.calibration.scene import LENS

Array = NDArray[np.float64]
Bow = tuple[float, float, float]
BOARD = parse_board("charuco:10x7:25:18:DICT_5X5_100")


def views(poses: list[Array], noise: float = 0.1, seed: int = 0, bow: Bow = (0, 0, 0)) -> list[tuple[str, BoardView]]:
    random = np.random.default_rng(seed)
    corners = BOARD.corners
    x, y = corners[:, 0] / np.abs(corners).max(), corners[:, 1] / np.abs(corners).max()
    bent = corners.copy()
    bent[:, 2] = bow[0] * x * x + bow[1] * x * y + bow[2] * y * y
    out = []
    for index, T in enumerate(poses):
        pixels = LENS.project(transform(T, bent)) + random.normal(0.0, noise, (len(corners), 2))
        inside = ((pixels > 5) & (pixels < np.array(LENS.image_size) - 5)).all(axis=1)
        view = BoardView(corners[inside], pixels[inside], np.flatnonzero(inside), LENS.image_size)
        if inside.sum() >= 8:
            out.append((f"view {index}", view))
    return out


def good_poses() -> list[Array]:
    return [board_pose_for(wanted, BOARD, LENS.image_size) for wanted in wanted_views()]


def table_error(camera: CameraModel) -> Array:
    """Distances on a plane 600 mm away, its pose refitted from a sheet in mid-view, as `table` would."""
    T = pose_from_rvec([0.05, 0.02, 0.0], [0.0, 0.0, 600.0])
    sheet = BOARD.corners
    found = board_pose(sheet, LENS.project(transform(T, sheet)), camera)
    u, v = np.meshgrid(np.linspace(20, 1260, 12), np.linspace(20, 700, 8))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    truth = PlaneMap(LENS, invert(T)).to_plane(pixels)
    return np.asarray(np.linalg.norm(PlaneMap(camera, invert(found)).to_plane(pixels) - truth, axis=1))


def test_a_known_lens_is_found_from_the_guided_views() -> None:
    found = fit_views(views(good_poses()), [], BOARD)
    assert found.model == LensModel.TANGENTIAL.value
    assert found.views_used == len(wanted_views())
    # 0.1 px of noise per axis: 0.14 in OpenCV's definition.
    assert 0.12 < found.rms_px < 0.15
    for name, value, true in (
        ("fx", found.camera.matrix[0, 0], LENS.matrix[0, 0]),
        ("cy", found.camera.matrix[1, 2], LENS.matrix[1, 2]),
        ("k1", found.camera.distortion[0], LENS.distortion[0]),
    ):
        # Four standard deviations of its own.
        assert abs(value - true) < 4 * found.sigma[name]
    # A published study of this set-up has 0.15 mm at the 95th percentile for 20 such views.
    assert np.percentile(table_error(found.camera), 95) < 0.2
    assert 0.02 < found.uncertainty_mm < 0.3
    assert found.bow_mm == (0.0, 0.0, 0.0)


def test_the_stated_uncertainty_is_the_true_one() -> None:
    """Over ten calibrations the stated figure and the errors really made agree within a factor of two."""
    stated: list[float] = []
    made: list[Array] = []
    for seed in range(10):
        found = fit_views(views(good_poses(), seed=seed), [], BOARD)
        stated.append(found.uncertainty_mm * 600.0 / found.distance_mm)
        made.append(table_error(found.camera))
    assert 0.5 < np.percentile(made, 95) / np.mean(stated) < 2.0


def test_a_bowed_board_is_noticed_and_does_no_harm() -> None:
    bow = (0.6, 0.1, 0.3)
    found = fit_views(views(good_poses(), bow=bow), [], BOARD)
    ignored = fit_views(views(good_poses(), bow=bow), [], BOARD, consider_bow=False)
    assert np.allclose(found.bow_mm, bow, atol=0.05)
    assert np.percentile(table_error(found.camera), 95) < 0.2
    assert np.percentile(table_error(ignored.camera), 95) > 0.3


def test_frontal_views_do_not_pin_the_focal_length() -> None:
    poses = [pose_from_rvec([0, 0, 0.1 * i], [20.0 * i - 80, 10.0 * i - 40, 450.0 + 20 * i]) for i in range(9)]
    with pytest.raises(CalibrationPoorFit, match="focal length is not pinned"):
        fit_views(views(poses), [], BOARD)


def test_one_view_many_times_is_not_many_views() -> None:
    with pytest.raises(CalibrationPoorFit, match="focal length is not pinned"):
        fit_views(views([good_poses()[2]] * 12), [], BOARD)


def test_a_bad_view_is_dropped_by_name() -> None:
    all_views = views(good_poses())
    name, view = all_views[3]
    broken = BoardView(view.object_points, np.roll(view.image_points, 1, axis=0), view.ids, view.image_size)
    found = fit_views([*all_views[:3], (name, broken), *all_views[4:]], [], BOARD)
    assert [item[0] for item in found.views_rejected] == [name]
    assert "fits badly" in found.views_rejected[0][1]
    assert abs(found.camera.matrix[0, 0] - LENS.matrix[0, 0]) < 4 * found.sigma["fx"]


def test_pictures_that_cannot_be_used_are_named() -> None:
    gray = np.full((360, 640), 128, np.uint8)
    with pytest.raises(CalibrationPoorFit) as caught:
        calibrate_camera([("a.png", gray), ("b.png", gray), ("c.png", gray[:200])], BOARD)
    assert "0 of 3" in caught.value.cause
    assert "a.png" in caught.value.cause
    with pytest.raises(CalibrationPoorFit):
        calibrate_camera([], BOARD)


def test_derivatives_of_the_bundle_agree_with_differences() -> None:
    corners = BOARD.corners[:10]
    lens = np.array([1000.0, 990, 640, 360, -0.2, 0.05, 1e-3, -1e-3, 0.01, 0, 0, 0])
    pose = np.array([0.2, -0.3, 0.1, 10.0, 20.0, 500.0])
    seen, jacobian = bundle.project(corners, pose, lens)
    for column, step in ((0, 1e-6), (5, 1e-3), (6, 1e-3), (10, 1e-6), (14, 1e-6)):
        moved_pose, moved_lens = pose.copy(), lens.copy()
        (moved_pose if column < 6 else moved_lens)[column if column < 6 else column - 6] += step
        slope = (bundle.project(corners, moved_pose, moved_lens)[0] - seen).ravel() / step
        # Forward differences: second order times the step.
        assert np.allclose(slope, jacobian[:, column], rtol=1e-3, atol=1e-3 * np.abs(jacobian[:, column]).max())


# --- the file -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lens() -> CameraCalibration:
    return fit_views(views(good_poses()), [("x.png", "no board")], BOARD)


def test_a_lens_survives_its_file(lens: CameraCalibration, tmp_path: Path) -> None:
    lens.save(tmp_path / "camera.json")
    again = CameraCalibration.load(tmp_path / "camera.json")
    assert again.calibration_id == lens.calibration_id
    assert again.to_json() == lens.to_json()
    assert np.allclose(again.camera.matrix, lens.camera.matrix, rtol=1e-9)
    content = json.loads((tmp_path / "camera.json").read_text())
    assert {"rms_px", "camera_matrix", "dist_coeffs", "image_size", "views_used", "views_rejected"} < set(content)
    assert content["views_rejected"] == [{"image": "x.png", "reason": "no board"}]


def test_an_edited_file_is_refused(lens: CameraCalibration, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    lens.save(path)
    path.write_text(path.read_text().replace('"rms_px": 0.1', '"rms_px": 0.0'))
    with pytest.raises(CalibrationStale, match="edited"):
        CameraCalibration.load(path)


def test_a_file_by_hand_needs_only_the_camera(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(
        json.dumps({"camera_matrix": LENS.matrix.tolist(), "dist_coeffs": [0, 0, 0, 0], "image_size": [1280, 720]})
    )
    found = CameraCalibration.load(path)
    assert found.camera.image_size == (1280, 720)
    assert found.calibration_id.startswith("camera-")


HOSTILE = [
    "",
    "[]",
    "null",
    "{",
    '{"camera_matrix": 1}',
    "[" * 100_000,
    '{"camera_matrix": [[NaN,0,1],[0,1,1],[0,0,1]], "dist_coeffs": [0,0,0,0], "image_size": [640,480]}',
    '{"camera_matrix": [[1e999,0,1],[0,1,1],[0,0,1]], "dist_coeffs": [0,0,0,0], "image_size": [640,480]}',
    '{"camera_matrix": [["500",0,1],[0,500,1],[0,0,1]], "dist_coeffs": [0,0,0,0], "image_size": [640,480]}',
    '{"camera_matrix": [[-500,0,1],[0,500,1],[0,0,1]], "dist_coeffs": [0,0,0,0], "image_size": [640,480]}',
    '{"camera_matrix": [[500,3,1],[0,500,1],[0,0,1]], "dist_coeffs": [0,0,0,0], "image_size": [640,480]}',
    '{"camera_matrix": [[500,0,1],[0,500,1],[0,0,1]], "dist_coeffs": [0,0,0], "image_size": [640,480]}',
    '{"camera_matrix": [[500,0,1],[0,500,1],[0,0,1]], "dist_coeffs": [0,0,0,0], "image_size": [640.5,480]}',
    '{"camera_matrix": [[500,0,1],[0,500,1],[0,0,1]], "dist_coeffs": [0,0,0,0], "image_size": [640,480], "sigma": 3}',
]


@pytest.mark.parametrize("text", HOSTILE)
def test_a_hostile_file_is_one_clear_error(text: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        CameraCalibration.load(path)
    assert "camera.json" in caught.value.cause


def test_no_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(CalibrationMissing):
        CameraCalibration.load(tmp_path / "none.json")
    with pytest.raises(InputError, match="cannot be read"):
        CameraCalibration.load(tmp_path)


def test_a_board_of_another_size_is_named() -> None:
    print_ = parse_board("chessboard:9x6:25").draw(0.625)
    picture = np.pad(np.asarray(cv2.GaussianBlur(print_, (0, 0), 1.0), np.uint8), 60, constant_values=200)
    seen, rejected = find_views([("a.png", picture), ("b.png", picture)], parse_board("chessboard:8x5:25"))
    assert not seen
    assert rejected[0] == ("a.png", "no 8x5 inner corners seen, but 9x6")
    with pytest.raises(CalibrationPoorFit, match="but 9x6"):
        fit_views(seen, rejected, parse_board("chessboard:8x5:25"))

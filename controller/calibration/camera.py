"""The lens: intrinsics and distortion from pictures of a board, with the uncertainty said in mm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration import bundle
from controller.calibration.board_search import BoardView
from controller.calibration.boards import Board, BoardKind
from controller.calibration.lens import CameraCalibration, LensModel, camera_from_json, named
from controller.calibration.views import find_views
from controller.errors import CalibrationPoorFit
from controller.geometry import PlaneMap, invert, pose_from_rvec

__all__ = [
    "CameraCalibration",
    "LensModel",
    "calibrate_camera",
    "camera_from_json",
    "fit_views",
    "refine_pose",
]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: Four planar views give the focal length a check on itself; three only just determine it.
MIN_VIEWS = 4
#: A view is dropped when its RMS exceeds this many times the median of all views ...
OUTLIER_RATIO = 3.0
#: ... and this many px, so that a very good set does not lose good views.
OUTLIER_FLOOR_PX = 0.3
#: At most this share of the views may be dropped before the set itself is at fault.
OUTLIER_SHARE = 0.25
#: Boards turned against each other by less than this leave focal length and distance exchangeable, rad.
MIN_TURN = np.deg2rad(10.0)
#: Largest standard deviation of the focal length, as a share of it, that still counts as pinned.
MAX_FOCAL_SIGMA = 0.01
#: The rational model bends freely outside its data: only with this many views ...
RATIONAL_VIEWS = 40
#: ... that reach this share of the picture's cells.
RATIONAL_COVERAGE = 0.9
#: Above this RMS, px, something else than a bowed board dominates, and its terms would absorb that.
BOW_MAX_RMS = 0.5
_DRAWS = 48
_CELLS = (8, 6)


def calibrate_camera(
    images: Sequence[tuple[str, Image]],
    board: Board,
    *,
    model: LensModel | None = None,
    consider_bow: bool = True,
) -> CameraCalibration:
    """Intrinsics and lens distortion from views of one board.

    Views without the board, with another picture size, or far worse than the rest are left out with the
    reason. The lens model is the one with the lowest Bayesian information criterion unless it is given.

    Args:
        images: (name, picture) pairs.
        board: What is shown.
        model: Fit exactly this model.
        consider_bow: Let the evidence decide whether the board is bowed.

    Raises:
        CalibrationPoorFit: Too few views, or views that do not pin the focal length.
    """
    seen, rejected = find_views(images, board)
    return fit_views(seen, rejected, board, model=model, consider_bow=consider_bow)


def fit_views(
    seen: Sequence[tuple[str, BoardView]],
    rejected: Sequence[tuple[str, str]],
    board: Board,
    *,
    model: LensModel | None = None,
    consider_bow: bool = True,
) -> CameraCalibration:
    """The fit behind `calibrate_camera`, from views already found."""
    views, out = list(seen), list(rejected)
    _check_count(views, out, board)
    size = views[0][1].image_size
    fit = _start(views, size)
    limit = int(OUTLIER_SHARE * len(views))
    dropped = 0
    while True:
        worst = int(np.argmax(fit.view_rms))
        bar = max(OUTLIER_RATIO * float(np.median(fit.view_rms)), OUTLIER_FLOOR_PX)
        if fit.view_rms[worst] <= bar:
            break
        if dropped == limit or len(views) <= MIN_VIEWS:
            raise CalibrationPoorFit(
                f"more than {limit} of the views fit badly (worst {views[worst][0]}: {fit.view_rms[worst]:.2f} px)",
                f"check that they show {board.spec}, sharp and flat",
            )
        out.append((views[worst][0], f"fits badly: {fit.view_rms[worst]:.2f} px, limit {bar:.2f} px"))
        del views[worst]
        dropped += 1
        fit = _refit(views, fit.lens, np.delete(fit.poses, worst, axis=0), LensModel.RADIAL_3)
    coverage = _coverage([view for _, view in views], size)
    consider_bow = consider_bow and board.kind is not BoardKind.OVERFILLED
    fit, chosen, candidates = _choose(views, fit, model, coverage, consider_bow)
    _check_pinned(fit, board)
    distance = float(np.median(np.linalg.norm(fit.poses[:, 3:], axis=1)))
    deviations = dict(zip(fit.free, np.sqrt(np.diag(fit.covariance)), strict=True))
    bow = fit.bow
    return named(
        CameraCalibration(
            "",
            fit.camera(size),
            fit.rms,
            len(views),
            tuple(out),
            {name: float(value) for name, value in deviations.items() if name in bundle.NAMES},
            chosen.value,
            board.spec,
            (float(bow[0]), float(bow[1]), float(bow[2])),
            spread_mm(fit, candidates, size, distance),
            distance,
            coverage,
        )
    )


def spread_mm(fit: bundle.Fit, candidates: Sequence[bundle.Fit], size: tuple[int, int], distance: float) -> float:
    """95th percentile of what the lens' uncertainty does on a frontal plane at `distance`, mm.

    A lens is drawn from the covariance of any candidate, as often as it is likely to predict best: a term that the
    views are too few to show, and that the chosen model leaves out, may be there all the same. Each draw refits the
    plane's pose to the same sheet in mid-picture, as the table calibration would, so that only what a lens error
    leaves behind counts.

    Source: Akaike weights, Burnham and Anderson, Model Selection and Multimodel Inference, 2.9.

    Args:
        fit: The chosen one.
        candidates: Fits of all models that were considered, the chosen one among them.
        size: (width, height) of the picture, px.
        distance: Of the plane, mm.
    """
    nominal = bundle.camera_of(fit.lens, size)
    width = 0.45 * size[0] * distance / fit.lens[0]
    sheet = np.column_stack([np.tile(np.linspace(-0.5, 0.5, 9), 6), np.repeat(np.linspace(-0.35, 0.35, 6), 9)])
    sheet = np.column_stack([sheet * width, np.zeros(len(sheet))])
    start = np.array([0.0, 0.0, 0.0, 0.0, 0.0, distance])
    seen, _ = bundle.project(sheet, start, fit.lens)
    u, v = np.meshgrid(np.linspace(0.02, 0.98, 9) * size[0], np.linspace(0.02, 0.98, 7) * size[1])
    picture = np.column_stack([u.ravel(), v.ravel()])
    truth = PlaneMap(nominal, invert(pose_from_rvec(start[:3], start[3:]))).to_plane(picture)
    criteria = np.array([candidate.aic for candidate in candidates])
    weights = np.exp((criteria.min() - criteria) / 2.0)
    random = np.random.default_rng(0)
    errors = []
    for index in random.choice(len(candidates), _DRAWS, p=weights / weights.sum()):
        drawn = candidates[index]
        columns = [bundle.NAMES.index(name) for name in drawn.free if name in bundle.NAMES]
        covariance = drawn.covariance[: len(columns), : len(columns)]
        lens = drawn.lens.copy()
        lens[columns] += random.multivariate_normal(np.zeros(len(columns)), covariance, method="eigh")
        found = refine_pose(sheet, seen, lens, start)
        plane = PlaneMap(bundle.camera_of(lens, size), invert(pose_from_rvec(found[:3], found[3:])))
        errors.append(np.linalg.norm(plane.to_plane(picture) - truth, axis=1))
    worst = np.nan_to_num(np.array(errors), nan=np.inf)
    return float(np.percentile(worst, 95))


def refine_pose(points: Array, pixels: Array, lens: Array, start: Array) -> Array:
    """Pose (6,) of board points (N, 3) in `camera` that fits pixels (N, 2) best, from a near start."""
    pose = start.copy()
    for _ in range(20):
        model, jacobian = bundle.project(points, pose, lens)
        step = np.linalg.lstsq(jacobian[:, :6], (pixels - model).ravel(), rcond=None)[0]
        pose = pose + step
        if np.abs(step).max() < 1e-9:
            break
    return pose


# --- the parts of the fit -------------------------------------------------------------------------------


def _start(views: Sequence[tuple[str, BoardView]], size: tuple[int, int]) -> bundle.Fit:
    """First fit by OpenCV, with two radial terms, which converges from no start at all."""
    objects = [np.ascontiguousarray(view.object_points, np.float32) for _, view in views]
    pixels = [np.ascontiguousarray(view.image_points, np.float32) for _, view in views]
    matrix: Any = np.eye(3)
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    try:
        _, matrix, distortion, rotations, translations = cv2.calibrateCamera(
            objects, pixels, size, matrix, np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise CalibrationPoorFit("no lens fits these views at all", "show the board tilted, in 20 places") from error
    lens = np.zeros(12)
    lens[:4] = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    lens[4:9] = np.asarray(distortion, np.float64).ravel()[:5]
    poses = np.hstack([np.reshape(rotations, (-1, 3)), np.reshape(translations, (-1, 3))]).astype(np.float64)
    if not (np.isfinite(lens).all() and np.isfinite(poses).all()):
        raise CalibrationPoorFit("no lens fits these views at all", "show the board tilted, in 20 places")
    return _refit(views, lens, poses, LensModel.RADIAL_3)


def _refit(
    views: Sequence[tuple[str, BoardView]], lens: Array, poses: Array, model: LensModel, *, bow: bool = False
) -> bundle.Fit:
    start = lens.copy()
    start[len(model.free) :] = 0.0
    return bundle.solve(
        [view.object_points for _, view in views],
        [view.image_points for _, view in views],
        start,
        poses,
        model.free,
        bow=bow,
    )


def _choose(
    views: Sequence[tuple[str, BoardView]],
    fit: bundle.Fit,
    model: LensModel | None,
    coverage: float,
    consider_bow: bool,
) -> tuple[bundle.Fit, LensModel, list[bundle.Fit]]:
    """The candidate with the lowest BIC, and all candidates; the board's bow is tried on the best one."""
    if model is not None:
        candidates = [model]
    else:
        wide = len(views) >= RATIONAL_VIEWS and coverage >= RATIONAL_COVERAGE
        candidates = [m for m in LensModel if m is not LensModel.RATIONAL or wide]
    fits = [(_refit(views, fit.lens, fit.poses, candidate), candidate) for candidate in candidates]
    best, chosen = min(fits, key=lambda pair: pair[0].bic)
    if consider_bow and best.rms <= BOW_MAX_RMS:
        bowed = [(_refit(views, best.lens, best.poses, candidate, bow=True), candidate) for candidate in candidates]
        with_bow, its_model = min(bowed, key=lambda pair: pair[0].bic)
        if with_bow.bic < best.bic:
            return with_bow, its_model, [fit for fit, _ in bowed]
    return best, chosen, [fit for fit, _ in fits]


def _check_count(views: Sequence[tuple[str, BoardView]], out: Sequence[tuple[str, str]], board: Board) -> None:
    if len(views) >= MIN_VIEWS:
        return
    first = next((item for item in out if ", but " in item[1]), out[0]) if out else None
    why = f"; {first[0]}: {first[1]}" if first else ""
    raise CalibrationPoorFit(
        f"only {len(views)} of {len(views) + len(out)} pictures show {board.spec}, {MIN_VIEWS} are needed{why}",
        "check the board's SPEC; take 20 pictures, tilted, reaching into every corner",
    )


def _check_pinned(fit: bundle.Fit, board: Board) -> None:
    """Refuse a fit whose focal length could as well be another, whatever its RMS says."""
    normals = np.array([np.asarray(cv2.Rodrigues(pose[:3])[0])[:, 2] for pose in fit.poses])
    turn = float(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)).max())
    deviation = float(np.sqrt(max(fit.covariance[0, 0], fit.covariance[1, 1])) / min(fit.lens[:2]))
    remedy = f"add views of {board.spec} tilted by 15 to 45 degrees in several directions"
    if turn < MIN_TURN:
        raise CalibrationPoorFit(
            f"the focal length is not pinned: the boards are turned by only {np.rad2deg(turn):.1f} degrees against "
            f"each other (RMS {fit.rms:.2f} px says nothing about it)",
            remedy,
        )
    if not deviation <= MAX_FOCAL_SIGMA:
        raise CalibrationPoorFit(
            f"the focal length is not pinned: its standard deviation is {100 * deviation:.1f} % "
            f"(RMS {fit.rms:.2f} px says nothing about it)",
            remedy,
        )


def _coverage(views: Sequence[BoardView], size: tuple[int, int]) -> float:
    points = np.vstack([view.image_points for view in views])
    cells = np.floor(points / np.array(size) * np.array(_CELLS)).astype(int)
    inside = cells[((cells >= 0) & (cells < np.array(_CELLS))).all(axis=1)]
    return len({(int(x), int(y)) for x, y in inside}) / (_CELLS[0] * _CELLS[1])

"""Published figures of real cameras beside ours, on the photographs of the folder of shared data.

    python -m tests.benchmarks.published

Lens: RMS and focal lengths with the lens model of the source. Robot: a camera and a robot that knows its pose.
Squares: prints of known size measured on the plane that their own middles span.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from controller.calibration.board_search import BoardView
from controller.calibration.board_spec import parse_board
from controller.calibration.boards import T_TABLE_BOARD
from controller.calibration.camera import CameraCalibration, LensModel, calibrate_camera, fit_views
from controller.calibration.hand_eye import Carried, HandEye, fit_hand_eye, read_robot_pose
from controller.calibration.marker import refine_square
from controller.calibration.table import board_pose, calibrate_table
from controller.calibration.views import find_views
from controller.errors import CalibrationPoorFit
from controller.geometry import CameraModel, PlaneMap, invert

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
SHARED = Path(__file__).resolve().parents[3] / "shared"


@dataclass(frozen=True, slots=True)
class Published:
    """What a source says of a set.

    Attributes:
        pattern: Its pictures below `data/`.
        board: SPEC.
        model: The source's lens model.
        rms: px, None where none is published.
        focal: (fx, fy), px.
        views: Fewest pictures that can be used.
    """

    pattern: str
    board: str
    model: LensModel
    rms: float | None
    focal: tuple[float, float]
    views: int


SETS = (
    Published("opencv_stereo_chess/*.jpg", "chessboard:9x6:25", LensModel.RADIAL_3, 0.19633, (532.81, 532.93), 13),
    Published("boofcv_bumblebee_chess/*.jpg", "chessboard:6x4:30", LensModel.RADIAL_2, 0.089, (524.61, 526.92), 11),
    Published("boofcv_sony_targets/chess*.jpg", "chessboard:6x4:30", LensModel.RADIAL_2, 0.16, (701.01, 698.65), 13),
    Published("boofcv_trinocular/*.jpg", "chessboard:13x9:30", LensModel.RADIAL_2, 0.099, (1839.0, 1842.0), 14),
    Published(
        "pycalib_charuco/*.jpg", "charuco:18x9:20:15:DICT_4X4_250", LensModel.RATIONAL, 0.3011, (586.83, 586.83), 9
    ),
    Published(
        "pycalib_charuco/*.jpg", "charuco:18x9:20:15:DICT_4X4_250", LensModel.RADIAL_3, 0.322, (586.83, 586.83), 9
    ),
    Published("udacity_wide/*.jpg", "chessboard:9x6:25", LensModel.RADIAL_3, 0.90, (1159.0, 1154.0), 15),
    Published("sick_metric/camera_*.png", "chessboard:any:15.09", LensModel.RADIAL_3, 0.68, (2328.0, 2330.0), 10),
    Published(
        "rosi_charuco_robot/charuco*.jpg",
        "charuco:5x7:36.195:18.256:DICT_6X6_250",
        LensModel.RADIAL_2,
        None,
        (1352.0, 1356.1),
        8,
    ),
    Published("rosi_charuco_robot/grid*.png", "circles:10x10:25.4", LensModel.RADIAL_3, None, (542.3, 543.5), 8),
)
#: The tutorial's four views say nothing about the focal length.
NOT_PINNED = "opencv_aruco_tutorial/img_*.jpg", "charuco:5x7:40:20:DICT_6X6_250:legacy"
#: Source: square_intrinsic.yaml beside the pictures.
SONY = CameraModel(
    np.array([[703.0800240596807, 0.0, 324.33160122230845], [0.0, 704.7901849110278, 239.42858763512353], [0, 0, 1.0]]),
    np.array([-0.24911457714344737, 0.03485636058344325, 0.0, 0.0, 0.0]),
    (640, 480),
)


def load(shared: Path, pattern: str) -> list[tuple[str, Image]]:
    """(name, picture) of every file, by name."""
    paths = sorted((shared / "data").glob(pattern))
    return [(path.name, np.asarray(cv2.imread(str(path)), np.uint8)) for path in paths]


@cache
def lens(shared: Path, published: Published) -> CameraCalibration:
    """Our calibration of a set with its source's lens model."""
    return calibrate_camera(load(shared, published.pattern), parse_board(published.board), model=published.model)


# --- robot ----------------------------------------------------------------------------------------------


def robot(shared: Path, kind: str) -> HandEye:
    """The camera and the robot of `rosi_charuco_robot`, with our own lens: `charuco` (carried) or `grid` (lying)."""
    pattern, spec, carried = {
        "charuco": ("charuco*.jpg", "charuco:5x7:36.195:18.256:DICT_6X6_250", Carried.BOARD),
        "grid": ("grid*.png", "circles:10x10:25.4", Carried.CAMERA),
    }[kind]
    folder, board = shared / "data" / "rosi_charuco_robot", parse_board(spec)
    views, rejected = find_views(load(shared, f"rosi_charuco_robot/{pattern}"), board)
    camera = fit_views(views, rejected, board).camera
    poses = [read_robot_pose(folder / f"{Path(name).stem}_pose.yaml") for name, _ in views]
    return fit_hand_eye([view for _, view in views], poses, camera, board, carried)


def repeatability(views: list[BoardView], camera: CameraModel) -> tuple[Array, Array]:
    """By how much the poses from one and the other half of a view's corners differ, mm and deg, (V,) each."""
    apart = []
    for view in views:
        halves = [board_pose(view.object_points[k::2], view.image_points[k::2], camera) for k in (0, 1)]
        apart.append(invert(halves[0]) @ halves[1])
    turned = Rotation.from_matrix(np.array(apart)[:, :3, :3]).magnitude()
    return np.linalg.norm(np.array(apart)[:, :3, 3], axis=1), np.rad2deg(turned)


# --- squares --------------------------------------------------------------------------------------------


def squares(shared: Path) -> Array:
    """Measured sides (N,) minus 30 mm, of every square of the seven pictures.

    The plane is that of the twelve middles, 60 mm apart; the sides are measured on it.
    """
    errors = []
    for _, image in load(shared, "boofcv_sony_targets/square_frame*.jpg"):
        gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        quads = np.array([refine_square(gray, quad, SONY) for quad in _quads(gray)])
        rays = SONY.rays(quads.reshape(-1, 2))[:, :2].reshape(-1, 4, 2)
        middles = SONY.project(np.column_stack([_diagonals(rays), np.ones(len(rays))]))
        kept, cells = _lattice(middles)
        quads, middles = quads[kept], middles[kept]
        places = np.column_stack([cells * 60.0, np.zeros(len(cells))])
        plane = PlaneMap(SONY, T_TABLE_BOARD @ invert(board_pose(places, middles, SONY)))
        corners = plane.to_plane(quads.reshape(-1, 2)).reshape(-1, 4, 2)
        errors.append(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).ravel() - 30.0)
    return np.concatenate(errors)


def _quads(gray: Image) -> Array:
    """Corners (N, 4, 2), px, of dark squares: in turn, of about the commonest size."""
    dark = cv2.adaptiveThreshold(gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, 101, 25)
    outlines, _ = cv2.findContours(dark, cv2.RETR_EXTERNAL | cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    found = []
    for outline in outlines:
        corners = cv2.approxPolyDP(outline, 0.06 * cv2.arcLength(outline, True), True).reshape(-1, 2)
        area = cv2.contourArea(outline)
        if len(corners) == 4 and area > 200 and area > 0.8 * cv2.contourArea(cv2.convexHull(outline)):
            inside = np.zeros_like(gray)
            cv2.fillConvexPoly(inside, corners, (255.0,))
            if gray[inside > 0].mean() < 70.0:
                found.append((area, corners[::-1].astype(np.float64)))
    usual = float(np.median([area for area, _ in found]))
    return np.array([corners for area, corners in found if 0.4 * usual < area < 2.5 * usual])


def _diagonals(quads: Array) -> Array:
    """Where (N, 2) the diagonals of quadrilaterals (N, 4, 2) cross: the middles of squares, perspective or not."""
    a, b, c, d = (np.column_stack([quads[:, k], np.ones(len(quads))]) for k in range(4))
    cross = np.cross(np.cross(a, c), np.cross(b, d))
    return np.asarray(cross[:, :2] / cross[:, 2:])


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _lattice(middles: Array) -> tuple[NDArray[np.int64], Array]:
    """Which middles lie on one lattice seen in perspective, and their whole-numbered places (N, 2) on it.

    Steps from neighbour to neighbour; what cannot be reached is none of the print's squares.
    """
    apart = middles[:, None] - middles[None]
    far = np.linalg.norm(apart, axis=2) + 1e9 * np.eye(len(middles))
    start = int(np.argmin(np.linalg.norm(middles - middles.mean(axis=0), axis=1)))
    order = np.argsort(far[start])
    first = middles[order[0]] - middles[start]
    sine = [abs(_cross(first, middles[k] - middles[start])) / np.linalg.norm(first) / far[start, k] for k in order[:6]]
    second = middles[order[int(np.argmax(np.array(sine) > 0.7))]] - middles[start]
    if _cross(first, second) < 0.0:
        second = -second
    cells, queue = {start: np.zeros(2)}, [start]
    while queue:
        here = queue.pop(0)
        for other in range(len(middles)):
            if other in cells:
                continue
            step = np.linalg.solve(np.column_stack([first, second]), middles[other] - middles[here])
            whole = np.rint(step)
            if np.abs(whole).sum() == 1.0 and np.abs(step - whole).max() < 0.45:
                cells[other] = cells[here] + whole
                queue.append(other)
    kept = np.array(sorted(cells))
    return kept, np.array([cells[int(k)] for k in kept])


# --- ruler ----------------------------------------------------------------------------------------------


def ruler(shared: Path) -> float:
    """Distance of a ruler's finest marks beside the board of `sick_metric/pose.png`, by our lens and table, mm."""
    made = lens(shared, next(item for item in SETS if item.board == "chessboard:any:15.09"))
    picture = load(shared, "sick_metric/pose.png")
    table = calibrate_table(picture, made, parse_board("chessboard:any:15.09"))
    plane = PlaneMap(made.camera, table.T_table_camera)
    gray = cv2.cvtColor(picture[0][1], cv2.COLOR_BGR2GRAY)
    # Along the ruler as the picture has it: its left border, from top to bottom.
    height = gray.shape[0]
    best = (0.0, 0.0)
    for u in np.arange(4.0, 60.0, 4.0):
        ends = plane.to_plane(np.array([[u, 40.0], [u + 0.075 * (height - 80.0), height - 40.0]]))
        length = float(np.linalg.norm(ends[1] - ends[0]))
        shares = np.arange(0.0, length, 0.05) / length
        pixels = plane.to_pixels(ends[0] + shares[:, None] * (ends[1] - ends[0]))
        seen = cv2.remap(gray, pixels.astype(np.float32)[:, None], np.empty(0), cv2.INTER_LINEAR)
        profile = seen.ravel().astype(np.float64)
        profile -= cv2.GaussianBlur(profile[:, None], (0, 0), 20.0).ravel()
        pitches = np.arange(0.94, 1.06, 0.0005)
        phase = np.exp(2j * np.pi * np.arange(len(profile)) * 0.05 / pitches[:, None])
        power = np.abs(phase @ (profile * np.hanning(len(profile))))
        peak = int(power.argmax())
        if power[peak] > best[0]:
            best = float(power[peak]), float(pitches[peak])
    return best[1]


# --- the table ------------------------------------------------------------------------------------------


#: What is asked: RMS over the published one, px; focal lengths off the published ones, a share.
_RMS_MORE, _FOCAL_OFF = 0.02, 0.01
#: The limits of the source's own tests: px per axis, mm, deg.
_CHAIN_PX, _CHAIN_MM, _CHAIN_DEG = 1.5, 10.0, 2.0
#: Of the printed squares of 30 mm: median and 95th percentile of |side - 30 mm|; of a millimetre of the ruler, mm.
_SIDE_MEDIAN, _SIDE_P95, _RULER = 0.35, 1.0, 0.005

Row = tuple[str, str, str, str, bool | None]


def _rows(shared: Path) -> Iterator[Row]:
    for item in SETS:
        found = lens(shared, item)
        name = f"{item.pattern.split('/')[0]} {item.board.split(':')[0]}, {item.model}"
        if item.rms is not None:
            yield name, "RMS, px", f"{item.rms:.3f}", f"{found.rms_px:.3f}", found.rms_px <= item.rms + _RMS_MORE
        fx, fy = found.camera.matrix[0, 0], found.camera.matrix[1, 1]
        off = max(abs(fx / item.focal[0] - 1.0), abs(fy / item.focal[1] - 1.0))
        ours = f"{fx:.1f}, {fy:.1f} ({100 * off:.2f} % off)"
        yield name, "fx, fy, px", "{:.1f}, {:.1f}".format(*item.focal), ours, off <= _FOCAL_OFF
        counts = f"{found.views_used}, {len(found.views_rejected)}"
        yield name, "views used, left out", f"at least {item.views}", counts, found.views_used >= item.views
    try:
        calibrate_camera(load(shared, NOT_PINNED[0]), parse_board(NOT_PINNED[1]))
    except CalibrationPoorFit as error:
        yield "opencv_aruco_tutorial", "four views", "refused", f"refused: {error.cause}", True
    else:
        yield "opencv_aruco_tutorial", "four views", "refused", "accepted", False
    for kind in ("charuco", "grid"):
        name, found_robot = f"rosi_charuco_robot {kind}", robot(shared, kind)
        pixels = found_robot.rms_px / 2**0.5
        yield name, "robot's chain, px per axis", f"< {_CHAIN_PX}", f"{pixels:.2f}", pixels < _CHAIN_PX
        for what, values, limit in (
            ("mm", found_robot.apart_mm, _CHAIN_MM),
            ("deg", found_robot.apart_deg, _CHAIN_DEG),
        ):
            far = float(values.mean())
            yield name, f"view against chain, {what}", f"< {limit:g}", f"{far:.2f}", far < limit
        size = f"{found_robot.board_scale:.3f} +- {found_robot.scale_sigma:.3f}"
        yield name, "board's size by the robot's moves, as a share", "", size, None
    board = parse_board("circles:10x10:25.4")
    views, rejected = find_views(load(shared, "rosi_charuco_robot/grid*.png"), board)
    mm, deg = repeatability([view for _, view in views], fit_views(views, rejected, board).camera)
    asked_of, ours = f"< {_CHAIN_MM:g}, < {_CHAIN_DEG:g}", f"{mm.mean():.2f}, {deg.mean():.2f}"
    good = bool(mm.mean() < _CHAIN_MM and deg.mean() < _CHAIN_DEG)
    yield "rosi_charuco_robot grid", "half against half, mm, deg", asked_of, ours, good
    errors = np.abs(squares(shared))
    middle, far = float(np.median(errors)), float(np.percentile(errors, 95))
    name = "boofcv_sony_targets squares"
    yield name, "|side - 30 mm|: median", f"{_SIDE_MEDIAN}", f"{middle:.2f}", middle <= _SIDE_MEDIAN
    yield name, "95 %", f"{_SIDE_P95}", f"{far:.2f} ({len(errors)} sides)", far <= _SIDE_P95
    one = ruler(shared)
    yield "sick_metric ruler", "one millimetre, mm", "1.000", f"{one:.4f}", abs(one - 1.0) <= _RULER


def main() -> None:
    """Print the table."""
    if not SHARED.is_dir():
        raise SystemExit("the folder of shared data is not beside this checkout")
    grid = Table("set", "figure", "published or asked", "ours", "verdict", box=None, pad_edge=False)
    last, missed = "", 0
    for name, what, theirs, ours, good in _rows(SHARED):
        word = "" if good is None else "met" if good else "NOT MET"
        grid.add_row("" if name == last else name, what, theirs, ours, word)
        last = name
        missed += good is False
    Console(width=160).print(grid)
    print("all met" if not missed else f"NOT MET: {missed}")


if __name__ == "__main__":
    main()

"""The table: where the camera is, from pictures of a printed board that lies on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration import bundle, edges, files
from controller.calibration.board_search import BoardNotFound, find_board
from controller.calibration.boards import T_TABLE_BOARD, Board, BoardKind
from controller.calibration.camera import refine_pose
from controller.calibration.lens import CameraCalibration
from controller.calibration.views import seen_instead
from controller.errors import CalibrationPoorFit, CalibrationStale, InputError
from controller.geometry import CameraModel, PlaneMap, invert, pose_from_rvec, rvec_tvec
from controller.vision.landmarks import find_landmarks

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: The sheet fits the lens about as well as the lens' own views did; three times worse, and not below half
#: a pixel, means another camera, focus or board.
RMS_RATIO, RMS_FLOOR_PX = 3.0, 0.5
#: A corner this far from its place, px, and this many times as far as the middle one, is none ...
STRAY_PX, STRAY_RATIO = 1.0, 5.0
#: ... while at most this share of them is so.
STRAY_SHARE = 0.1
#: With fewer points on edges than this the corners alone decide.
_LEAST_EDGE_POINTS = 100
#: A board's outer squares lie beyond its corners: its sheet is so many times as wide.
_SHEET = 1.5
#: The limit when the lens' own figure is not known.
MAX_RMS_PX = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class TableCalibration:
    """The camera's pose over the table.

    Attributes:
        calibration_id: Hash of the content, the lens' id included.
        camera_id: Id of the lens it was made with.
        T_table_camera: ndarray of shape (4, 4), maps `camera` into `table`.
        rms_px: Root mean squared distance of seen and projected corners, of the averaged frames.
        rms_mm: The same on the table.
        frames: Number of pictures averaged.
        rejected: (image, reason) of the others.
        board: SPEC of the board.
        landmarks: Corners (4, 2), px, of the table's corner markers by id, where there are any.
    """

    calibration_id: str
    camera_id: str
    T_table_camera: Array
    rms_px: float
    rms_mm: float
    frames: int
    rejected: tuple[tuple[str, str], ...] = ()
    board: str = ""
    landmarks: Mapping[int, Array] = field(default_factory=dict)

    def to_json(self, camera: CameraCalibration) -> dict[str, Any]:
        """The JSON object of `calibrate table`: the lens' keys and the pose; its id is the table's."""
        content = {**camera.to_json(), "camera_rms_px": camera.rms_px, "camera_id": self.camera_id}
        del content["calibration_id"]
        return {**content, **_content(self), "calibration_id": self.calibration_id}

    def own_json(self) -> dict[str, Any]:
        """The JSON object of the table's own file, without the lens' keys."""
        return {**_content(self), "calibration_id": self.calibration_id}

    def save(self, path: Path, provenance: Mapping[str, str] | None = None) -> None:
        """Write the table's own file; the previous one is kept beside it."""
        files.write(path, self.own_json() | ({"provenance": dict(provenance)} if provenance else {}))

    @staticmethod
    def load(path: Path, camera: CameraCalibration) -> TableCalibration:
        """Read a file written by `save`.

        Raises:
            CalibrationStale: It was made with another lens calibration.
            CalibrationMissing, InputError: See `files.read`.
        """
        content = files.read(path, "table")
        found = table_from_json(content, str(path))
        if found.camera_id and found.camera_id != camera.calibration_id:
            raise CalibrationStale(
                f"{path}: made with the lens {found.camera_id}, this one is {camera.calibration_id}",
                "run `controller calibrate table` again",
            )
        return found


def table_from_json(content: Mapping[str, Any], where: str) -> TableCalibration:
    """A table calibration from its JSON object; `where` names it in errors.

    Raises:
        InputError: A key is missing or makes no sense.
    """
    pose = files.rigid(content, "T_table_camera", where=where)
    if pose[2, 3] <= 0.0:
        raise InputError(f"{where}: T_table_camera puts the camera under the table", "make the file again")
    rejected = content.get("rejected", [])
    if not isinstance(rejected, list) or not all(isinstance(item, dict) for item in rejected):
        raise InputError(f"{where}: rejected is not a list of objects", "make the file again")
    partial = TableCalibration(
        "",
        str(content.get("camera_id", "")),
        pose,
        files.number(content, "rms_px", where=where, default=0.0),
        files.number(content, "rms_mm", where=where, default=0.0),
        int(files.number(content, "frames", where=where, default=1.0)),
        tuple((str(item.get("image")), str(item.get("reason"))) for item in rejected),
        str(content.get("board", "")),
        _landmarks_from(content, where),
    )
    stated = content.get("calibration_id")
    return _named(partial, stated if isinstance(stated, str) else None)


def calibrate_table(
    images: Sequence[tuple[str, Image]], camera: CameraCalibration, board: Board
) -> TableCalibration:
    """The camera's pose from one or more pictures of a board lying still on the table.

    Corners are averaged over the pictures, which divides their noise by the root of their number.

    Args:
        images: (name, picture) pairs of an unmoved scene.
        camera: The lens.
        board: The print on the table; its middle becomes the origin of `table`.

    Raises:
        InputError: A picture's size is not the lens'; the board has no middle (overfilled view).
        CalibrationPoorFit: No picture shows the board, it moved, or the lens does not fit.
    """
    if board.kind is BoardKind.OVERFILLED and len(images) != 1:
        raise InputError(f"{board.spec}: its corners have no numbers to average over pictures", "give one picture")
    used: list[tuple[Array, Array, NDArray[np.int64]]] = []
    rejected: list[tuple[str, str]] = []
    for name, image in images:
        size = (image.shape[1], image.shape[0])
        if size != camera.camera.image_size:
            known = camera.camera.image_size
            raise InputError(
                f"{name}: {size[0]}x{size[1]} px, the lens was calibrated at {known[0]}x{known[1]}",
                "take the picture with the same camera settings",
            )
        try:
            view = find_board(board, image)
        except BoardNotFound as error:
            rejected.append((name, seen_instead(board, image, False) or error.cause))
            continue
        used.append((view.object_points, view.image_points, view.ids))
    # Nothing moves between the pictures: one tells whether the board is only part of a larger one.
    larger = next((seen_instead(board, image, True) for name, image in images if name not in dict(rejected)), None)
    if larger is not None:
        raise CalibrationPoorFit(f"another board is on the table: {larger}", "check the board's SPEC")
    if not used:
        why = f"{rejected[0][0]}: {rejected[0][1]}" if rejected else "no picture"
        raise CalibrationPoorFit(
            f"the board is not on the table: {why}", "lay it flat, whole in view, evenly lit; check its SPEC"
        )
    points, pixels, moved = _average(used)
    if moved > 1.0:
        raise CalibrationPoorFit(
            f"the board or the camera moved by {moved:.1f} px between the pictures", "let nothing move; repeat"
        )
    T_camera_board = board_pose(points, pixels, camera.camera)
    good = _in_place(np.linalg.norm(_seen(points, T_camera_board, camera.camera) - pixels, axis=1))
    if not good.all():
        points, pixels = points[good], pixels[good]
        T_camera_board = board_pose(points, pixels, camera.camera)
    if board.kind in (BoardKind.CHESSBOARD, BoardKind.CHARUCO):
        bad = {name for name, _ in rejected}
        mean = np.mean([_gray(image) for name, image in images if name not in bad], axis=0, dtype=np.float32)
        T_camera_board = _along_edges(np.asarray(mean), T_camera_board, camera.camera, board)
    rms_px = float(np.sqrt(((_seen(points, T_camera_board, camera.camera) - pixels) ** 2).sum(axis=1).mean()))
    limit = max(RMS_RATIO * camera.rms_px, RMS_FLOOR_PX) if camera.rms_px > 0.0 else MAX_RMS_PX
    if not rms_px <= limit:
        raise CalibrationPoorFit(
            f"the lens does not fit the board on the table: {rms_px:.2f} px, limit {limit:.2f} px",
            "check the board's SPEC and that the lens file belongs to this camera and focus",
        )
    T_table_camera = T_TABLE_BOARD @ invert(T_camera_board)
    flat = PlaneMap(camera.camera, T_table_camera).to_plane(pixels)
    wanted = points[:, :2] * np.array([1.0, -1.0])
    rms_mm = float(np.sqrt(((flat - wanted) ** 2).sum(axis=1).mean()))
    return _named(
        TableCalibration(
            "",
            camera.calibration_id,
            T_table_camera,
            rms_px,
            rms_mm,
            len(used),
            tuple(rejected),
            board.spec,
            _mean_landmarks([image for _, image in images], pixels),
        )
    )


def _in_place(errors: Array) -> NDArray[np.bool_]:
    """Which corners (N,) are where the board has them; all, when more than a few are not: then the fit is at fault.

    What covers part of the sheet, such as the arm at rest, may end in something like a corner.
    """
    good = errors <= max(STRAY_PX, STRAY_RATIO * float(np.median(errors)))
    return good if (~good).mean() <= STRAY_SHARE else np.ones(len(errors), np.bool_)


def _mean_landmarks(images: Sequence[Image], board: Array) -> dict[int, Array]:
    """Corners of the corner markers that every picture shows, averaged.

    A ChArUco board may have markers of the same names on it: what lies on it or at its rim is none.
    """
    found = [find_landmarks(image) for image in images]
    common = set.intersection(*(set(one) for one in found)) if found else set()
    mean = {name: np.mean([one[name] for one in found], axis=0) for name in sorted(common)}
    middle = board.mean(axis=0)
    sheet = cv2.convexHull((middle + _SHEET * (board - middle)).astype(np.float32))
    return {
        name: place
        for name, place in mean.items()
        if cv2.pointPolygonTest(sheet, (float(place[:, 0].mean()), float(place[:, 1].mean())), False) < 0.0
    }


def _landmarks_from(content: Mapping[str, Any], where: str) -> dict[int, Array]:
    value = content.get("landmarks", {})
    if not isinstance(value, dict) or not all(str(name).isdecimal() for name in value):
        raise InputError(f"{where}: landmarks are not by number", "make the file again")
    return {int(name): files.numbers(value, name, (4, 2), where=f"{where}: landmarks") for name in value}


def board_pose(points: Array, pixels: Array, camera: CameraModel) -> Array:
    """Pose (4, 4) of flat `board` points (N, 3) in `camera` from their pixels (N, 2), least squares.

    Raises:
        CalibrationPoorFit: No pose puts the board in front of the camera.
    """
    rays = camera.rays(pixels)[:, :2]
    found, rotations, translations, _ = cv2.solvePnPGeneric(
        np.ascontiguousarray(points), np.ascontiguousarray(rays), np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
    )
    lens = bundle.lens_of(camera)
    best, least = None, np.inf
    # A planar target has two mirrored poses; both are refined and the better one is the truth.
    for rotation, translation in zip(rotations, translations, strict=True) if found else ():
        start = np.concatenate([np.ravel(rotation), np.ravel(translation)]).astype(np.float64)
        refined = refine_pose(points, pixels, lens, start)
        pose = pose_from_rvec(refined[:3], refined[3:])
        error = float(((_seen(points, pose, camera) - pixels) ** 2).sum()) if np.isfinite(refined).all() else np.inf
        if error < least and pose[2, 3] > 0.0:
            best, least = pose, error
    if best is None:
        raise CalibrationPoorFit("no pose of the board explains the picture", "check the board's SPEC and the lens")
    return best


def _along_edges(gray: NDArray[np.float32], T_camera_board: Array, camera: CameraModel, board: Board) -> Array:
    """The pose that puts every edge between two squares where the picture has it.

    The edges hold far more of the picture than the corners, and the tilt of a sheet that fills only the
    middle of the view needs all of it: 0.3 mrad left by corners alone are 0.2 mm at the picture's border.
    """
    places, ahead = board.edge_points()
    lens = bundle.lens_of(camera)
    pose = np.concatenate(rvec_tvec(T_camera_board))
    for _ in range(4):
        seen, jacobian = bundle.project(places, pose, lens)
        along = bundle.project(places + ahead, pose, lens)[0] - seen
        pitch = np.linalg.norm(along, axis=1)
        normals = np.column_stack([along[:, 1], -along[:, 0]]) / pitch[:, None]
        reach = np.clip(board.free * pitch, 1.5, 4.0)
        off = edges.offsets(gray, seen, normals, reach)
        good = np.isfinite(off)
        if good.sum() < _LEAST_EDGE_POINTS:
            return T_camera_board
        # Scratches and shadow borders on the sheet: bounded influence beyond three times the usual.
        usual = 1.5 * float(np.median(np.abs(off[good]))) + 1e-6
        weights = np.sqrt(np.minimum(1.0, 3.0 * usual / np.maximum(np.abs(off[good]), 1e-12)))
        rows = np.einsum("ni,nij->nj", normals, jacobian[:, :6].reshape(-1, 2, 6))[good]
        step = np.linalg.lstsq(rows * weights[:, None], off[good] * weights, rcond=None)[0]
        pose = pose + step
        if np.abs(step).max() < 1e-7:
            break
    return pose_from_rvec(pose[:3], pose[3:])


def _gray(image: Image) -> Image:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _seen(points: Array, T_camera_board: Array, camera: CameraModel) -> Array:
    return camera.project(points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])


def _average(used: Sequence[tuple[Array, Array, NDArray[np.int64]]]) -> tuple[Array, Array, float]:
    """Mean corner positions by id, and how far the whole board wandered between pictures, px."""
    ids = np.concatenate([item[2] for item in used])
    points = np.vstack([item[0] for item in used])
    pixels = np.vstack([item[1] for item in used])
    unique, first, inverse, counts = np.unique(ids, return_index=True, return_inverse=True, return_counts=True)
    mean = np.column_stack([np.bincount(inverse, pixels[:, axis]) for axis in (0, 1)]) / counts[:, None]
    shifts = [
        np.median(item[1] - mean[np.searchsorted(unique, item[2])], axis=0) for item in used
    ]
    return points[first], mean, float(np.linalg.norm(shifts, axis=1).max())


def _content(table: TableCalibration) -> dict[str, Any]:
    plain = files.plain(
        {
            "T_table_camera": table.T_table_camera,
            "rms_px": table.rms_px,
            "rms_mm": table.rms_mm,
            "frames": table.frames,
            "rejected": [{"image": name, "reason": why} for name, why in table.rejected],
            "board": table.board,
            **({"landmarks": {str(name): place for name, place in table.landmarks.items()}} if table.landmarks else {}),
            "camera_id": table.camera_id,
        }
    )
    assert isinstance(plain, dict)
    return plain


def _named(table: TableCalibration, stated: str | None = None) -> TableCalibration:
    name = stated or files.identity("table", _content(table))
    fields = {f: getattr(table, f) for f in TableCalibration.__dataclass_fields__}
    return TableCalibration(**{**fields, "calibration_id": name})

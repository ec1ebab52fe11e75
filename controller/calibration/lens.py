"""What is known about a lens: its terms, how sure they are, and the file that keeps them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from controller.calibration import bundle, files
from controller.errors import InputError
from controller.geometry import CameraModel


class LensModel(StrEnum):
    """Which distortion terms are fitted."""

    RADIAL_1 = "k1"
    RADIAL_2 = "k1k2"
    TANGENTIAL = "k1k2p1p2"
    RADIAL_3 = "k1k2p1p2k3"
    RATIONAL = "rational"

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free unknowns, see `bundle.NAMES`."""
        count = {"k1": 5, "k1k2": 6, "k1k2p1p2": 8, "k1k2p1p2k3": 9, "rational": 12}[self.value]
        return bundle.NAMES[:count]


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A lens and how well it is known.

    Attributes:
        calibration_id: Hash of the content.
        camera: The lens.
        rms_px: Root mean squared reprojection error, OpenCV's definition.
        views_used: Number of views in the fit.
        views_rejected: (image, reason) of the others.
        sigma: Standard deviation of each fitted lens term, by `bundle.NAMES`.
        model: Which terms were fitted.
        board: SPEC of the board; "" when unknown.
        bow_mm: The board's out-of-plane terms (xx, xy, yy) at its edge; zeros for a flat board.
        uncertainty_mm: 95th percentile, over the picture and draws from the fit's covariance, of the error
            on a plane at `distance_mm` whose pose is refitted for each draw; 0 when unknown.
        distance_mm: Median distance of the boards.
        coverage: Share of 8 x 6 cells of the picture that hold corners.
    """

    calibration_id: str
    camera: CameraModel
    rms_px: float
    views_used: int
    views_rejected: tuple[tuple[str, str], ...] = ()
    sigma: Mapping[str, float] = field(default_factory=dict)
    model: str = ""
    board: str = ""
    bow_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    uncertainty_mm: float = 0.0
    distance_mm: float = 0.0
    coverage: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """The JSON object of `calibrate camera`, ready to be written."""
        return {**_content(self), "calibration_id": self.calibration_id}

    def save(self, path: Path, provenance: Mapping[str, str] | None = None) -> None:
        """Write the file that `--camera` reads; the previous one is kept beside it."""
        files.write(path, self.to_json() | ({"provenance": dict(provenance)} if provenance else {}))

    @staticmethod
    def load(path: Path) -> CameraCalibration:
        """Read a file written by `save`, or by hand with the camera's keys alone.

        Raises:
            CalibrationMissing, InputError, CalibrationStale: See `files.read`.
        """
        return camera_from_json(files.read(path, "camera"), str(path))


def camera_from_json(content: Mapping[str, Any], where: str) -> CameraCalibration:
    """A camera calibration from its JSON object; `where` names it in errors.

    Raises:
        InputError: A key is missing or makes no sense.
    """
    matrix = files.numbers(content, "camera_matrix", (3, 3), where=where)
    distortion = files.numbers(content, "dist_coeffs", (4,), (5,), (8,), (12,), (14,), where=where)
    size = files.numbers(content, "image_size", (2,), where=where)
    skeleton = np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
    if min(matrix[0, 0], matrix[1, 1]) <= 0.0 or not np.array_equal(skeleton, matrix):
        raise InputError(f"{where}: camera_matrix is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", "make the file again")
    if not (np.array_equal(size, np.rint(size)) and (size >= 16).all() and (size <= 65536).all()):
        raise InputError(f"{where}: image_size {size.tolist()} is no picture's size", "make the file again")
    camera = CameraModel(matrix, distortion, (int(size[0]), int(size[1])))
    rejected = content.get("views_rejected", [])
    sigma = content.get("sigma", {})
    if not isinstance(rejected, list) or not all(isinstance(item, dict) for item in rejected):
        raise InputError(f"{where}: views_rejected is not a list of objects", "make the file again")
    if not isinstance(sigma, dict):
        raise InputError(f"{where}: sigma is not an object", "make the file again")
    bow = tuple(files.numbers(content, "bow_mm", (3,), where=where)) if "bow_mm" in content else (0.0, 0.0, 0.0)
    partial = CameraCalibration(
        "",
        camera,
        files.number(content, "rms_px", where=where, default=0.0),
        int(files.number(content, "views_used", where=where, default=0.0)),
        tuple((str(item.get("image")), str(item.get("reason"))) for item in rejected),
        {str(key): files.number(sigma, key, where=f"{where}: sigma") for key in sigma},
        str(content.get("model", "")),
        str(content.get("board", "")),
        (float(bow[0]), float(bow[1]), float(bow[2])),
        files.number(content, "uncertainty_mm", where=where, default=0.0),
        files.number(content, "distance_mm", where=where, default=0.0),
        files.number(content, "coverage", where=where, default=0.0),
    )
    return named(partial, content.get("calibration_id"))


def _content(calibration: CameraCalibration) -> dict[str, Any]:
    content = {
        "rms_px": calibration.rms_px,
        "camera_matrix": calibration.camera.matrix,
        "dist_coeffs": calibration.camera.distortion,
        "image_size": list(calibration.camera.image_size),
        "views_used": calibration.views_used,
        "views_rejected": [{"image": name, "reason": why} for name, why in calibration.views_rejected],
        "sigma": dict(calibration.sigma),
        "model": calibration.model,
        "board": calibration.board,
        "bow_mm": list(calibration.bow_mm),
        "uncertainty_mm": calibration.uncertainty_mm,
        "distance_mm": calibration.distance_mm,
        "coverage": calibration.coverage,
    }
    plain = files.plain(content)
    assert isinstance(plain, dict)
    return plain


def named(calibration: CameraCalibration, stated: object = None) -> CameraCalibration:
    """The same under the hash of its content, or under the name its file states (already checked)."""
    name = stated if isinstance(stated, str) else files.identity("camera", _content(calibration))
    fields = {f: getattr(calibration, f) for f in CameraCalibration.__dataclass_fields__}
    return CameraCalibration(**{**fields, "calibration_id": name})

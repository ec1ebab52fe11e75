"""The arm: where its base stands on the table and how far its joints are mounted off their marks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.calibration import files
from controller.calibration.map_record import MapRecord, record_from_json
from controller.calibration.marker import ArmMarker
from controller.domain import Point
from controller.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Residual:
    """Distances between seen and modelled positions, mm."""

    mean: float
    p95: float
    max: float

    @staticmethod
    def of(distances: Array) -> Residual:
        """The three figures of distances of shape (N,)."""
        return Residual(float(distances.mean()), float(np.percentile(distances, 95)), float(distances.max()))

    def to_json(self) -> dict[str, float]:
        """As the command line prints it."""
        return {"mean": self.mean, "p95": self.p95, "max": self.max}


@dataclass(frozen=True, slots=True, eq=False)
class ArmCalibration:
    """The arm in the cell.

    Attributes:
        calibration_id: Hash of the content.
        camera_id, table_id: What its millimetres rest on.
        arm: Name of the arm's description.
        T_base_table: ndarray of shape (4, 4), maps `table` into `base`.
        joint_offsets: rad by joint name: added to a wanted joint angle before it is commanded.
        T_tool_marker: ndarray of shape (4, 4): how the marker turned out to be mounted.
        residual_mm: Marker positions, seen against modelled, of the poses the fit rests on.
        points: Number of those poses.
        singular_values: Of the scaled normal equations, largest first: a tiny last one is a direction
            that the poses do not determine.
        sigma: Standard deviations of the offsets (rad), of the base (`x`, `y`, `z` mm, `yaw` rad) and, where something
            was touched, of the jaws (`jaws_y`, `jaws_z` mm).
        places: Where the grasp point was at those poses, (x, y, z) in `table`, mm.
        touches: Number of pushes of a part that told where the tip is; 0: the marker alone.
        error_map: What the arm still misses by, where somebody looked.
        jaws: (y, z) of the middle of the jaws beside its place in the drawing, in `tool`, mm; 0 where nothing was
            touched.
    """

    calibration_id: str
    camera_id: str
    table_id: str
    arm: str
    T_base_table: Array
    joint_offsets: Mapping[str, float]
    T_tool_marker: Array
    residual_mm: Residual
    points: int
    singular_values: tuple[float, ...] = ()
    sigma: Mapping[str, float] = field(default_factory=dict)
    places: tuple[tuple[float, float, float], ...] = ()
    touches: int = 0
    error_map: MapRecord | None = None
    jaws: Point = (0.0, 0.0)

    def to_json(self) -> dict[str, Any]:
        """The JSON object of its file, and of `calibrate arm` apart from the time it took."""
        return {**_content(self), "calibration_id": self.calibration_id}


def by_ruler(T_base_table: Array, camera_id: str, table_id: str, arm: str) -> ArmCalibration:
    """An arm that was placed by ruler and never looked at: zero offsets, the marker by its drawing, zero points."""
    none = Residual(0.0, 0.0, 0.0)
    mount = ArmMarker().T_tool_marker
    return named(ArmCalibration("", camera_id, table_id, arm, T_base_table, {}, mount, none, 0))


def arm_from_json(content: Mapping[str, Any], where: str) -> ArmCalibration:
    """An arm calibration from its JSON object; `where` names it in errors.

    Raises:
        InputError: A key is missing or makes no sense.
    """
    offsets, residual, sigma = (content.get(key) for key in ("joint_offsets", "residual_mm", "sigma"))
    if not isinstance(offsets, dict) or not isinstance(residual, dict) or not isinstance(sigma, dict):
        raise InputError(f"{where}: joint_offsets, residual_mm or sigma is not an object", "make the file again")
    values = {str(name): files.number(offsets, name, where=f"{where}: joint_offsets") for name in offsets}
    if any(abs(value) > np.pi / 4 for value in values.values()):
        raise InputError(f"{where}: a joint offset of more than 45 degrees is no offset", "calibrate the arm again")
    singular = content.get("singular_values", [])
    if not isinstance(singular, list):
        raise InputError(f"{where}: singular_values is not a list", "make the file again")
    listed = content.get("places", [])
    if not isinstance(listed, list):
        raise InputError(f"{where}: places is not a list", "make the file again")
    places = files.numbers(content, "places", (len(listed), 3), where=where) if listed else np.empty((0, 3))
    jaws = files.numbers(content, "jaws", (2,), where=where) if "jaws" in content else np.zeros(2)
    partial = ArmCalibration(
        "",
        str(content.get("camera_id", "")),
        str(content.get("table_id", "")),
        str(content.get("arm", "")),
        files.rigid(content, "T_base_table", where=where),
        values,
        files.rigid(content, "T_tool_marker", where=where),
        Residual(*(files.number(residual, key, where=f"{where}: residual_mm") for key in ("mean", "p95", "max"))),
        int(files.number(content, "points", where=where)),
        tuple(float(v) for v in files.numbers(content, "singular_values", (len(singular),), where=where)),
        {str(name): files.number(sigma, name, where=f"{where}: sigma") for name in sigma},
        tuple((float(x), float(y), float(z)) for x, y, z in places),
        int(files.number(content, "touches", where=where, default=0)),
        record_from_json(content.get("error_map"), where),
        (float(jaws[0]), float(jaws[1])),
    )
    stated = content.get("calibration_id")
    return named(partial, stated if isinstance(stated, str) else None)


def named(calibration: ArmCalibration, stated: str | None = None) -> ArmCalibration:
    """The same under the hash of its content, or under the name its file states (already checked)."""
    name = stated or files.identity("arm", _content(calibration))
    fields = {f: getattr(calibration, f) for f in ArmCalibration.__dataclass_fields__}
    return ArmCalibration(**{**fields, "calibration_id": name})


def _content(calibration: ArmCalibration) -> dict[str, Any]:
    plain = files.plain(
        {
            "residual_mm": calibration.residual_mm.to_json(),
            "points": calibration.points,
            "T_base_table": calibration.T_base_table,
            "joint_offsets": dict(calibration.joint_offsets),
            "T_tool_marker": calibration.T_tool_marker,
            "singular_values": list(calibration.singular_values),
            "sigma": dict(calibration.sigma),
            "places": [list(place) for place in calibration.places],
            "touches": calibration.touches,
            "jaws": list(calibration.jaws),
            "error_map": calibration.error_map and calibration.error_map.to_json(),
            "arm": calibration.arm,
            "camera_id": calibration.camera_id,
            "table_id": calibration.table_id,
        }
    )
    assert isinstance(plain, dict)
    return plain

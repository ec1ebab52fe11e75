"""What is known about the cell: how pixels become millimetres, and where parts are put down."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from controller.domain.types import Array, Point
from controller.geometry import CameraModel, PlaneMap


@dataclass(frozen=True, slots=True)
class ErrorMap:
    """What a touch misses by after everything else was calibrated: a polynomial of degree 2 over the table.

    Attributes:
        center: (x, y) of `table` where its coordinates u and v are 0, mm.
        scale: mm of the table for 1 of u or v.
        x, y: Coefficients of 1, u, v, u^2, uv, v^2: how far beside its aim the tool comes down, mm.
    """

    center: Point
    scale: float
    x: tuple[float, ...]
    y: tuple[float, ...]

    @staticmethod
    def basis(places: Array) -> Array:
        """Terms (N, 6) at scaled places (N, 2)."""
        u, v = places[:, 0], places[:, 1]
        return np.column_stack([np.ones(len(u)), u, v, u * u, u * v, v * v])

    def at(self, point: Point) -> Point:
        """Where the tool comes down beside a point of `table` it is sent to, (dx, dy), mm.

        Beyond the looked at region the map goes on as it is at its border.
        """
        place = (np.array([point]) - self.center) / self.scale
        dx, dy = self.basis(np.clip(place, -1.0, 1.0))[0] @ np.array([self.x, self.y]).T
        return float(dx), float(dy)

    def aim(self, point: Point) -> Point:
        """Where to send the tool so that it comes down at a point of `table`, mm."""
        dx, dy = self.at(point)
        return point[0] - dx, point[1] - dy


@dataclass(frozen=True, slots=True, eq=False)
class CellCalibration:
    """Everything that turns pixels into millimetres, and millimetres into the arm's own.

    Attributes:
        calibration_id: Hash of the contents.
        camera: The lens.
        T_table_camera: ndarray of shape (4, 4), maps `camera` into `table`.
        T_base_table: ndarray of shape (4, 4), maps `table` into the arm's `base`.
        joint_offsets: rad by joint name: added to a wanted joint angle before it is commanded.
        sigma: Standard deviation of a point on the table, mm.
        error_map: What the tool still misses by, where that is known.
        jaws: (y, z) of the middle of the jaws beside its place in the drawing, in `tool`, mm.
    """

    calibration_id: str
    camera: CameraModel
    T_table_camera: Array
    T_base_table: Array
    joint_offsets: Mapping[str, float] = field(default_factory=dict)
    sigma: float = 0.0
    error_map: ErrorMap | None = None
    jaws: Point = (0.0, 0.0)

    def plane(self, height: float = 0.0) -> PlaneMap:
        """The map between pixels and the plane z = `height` (mm) of `table`."""
        return PlaneMap(self.camera, self.T_table_camera, height)


@dataclass(frozen=True, slots=True)
class Bin:
    """A place to put parts down.

    Attributes:
        name: As the sorting rules call it.
        center: (x, y) in `table`, mm.
        size: (x, y) inner size, mm.
        height: Height of its walls above the table, mm.
        capacity: Number of parts it takes.
    """

    name: str
    center: Point
    size: tuple[float, float]
    height: float
    capacity: int

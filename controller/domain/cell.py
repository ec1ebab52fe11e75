"""What is known about the cell: how pixels become millimetres, and where parts are put down."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from controller.domain.types import Array, Point
from controller.geometry import CameraModel, PlaneMap


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
    """

    calibration_id: str
    camera: CameraModel
    T_table_camera: Array
    T_base_table: Array
    joint_offsets: Mapping[str, float] = field(default_factory=dict)
    sigma: float = 0.0

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

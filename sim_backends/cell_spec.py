"""What a simulated cell is built from: one value that travels as JSON, e.g. to a process of its own."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from controller.domain import ArmDescription, Bin, Gripper, Joint, Link, ServoDynamics, Shape
from sim_backends.arm_shape import MarkerMount
from sim_backends.imperfections import Vector
from sim_backends.parts import Kind, WorkArea
from sim_backends.solids import Array

Rows = tuple[tuple[float, ...], ...]

HEIGHTS: Mapping[Shape, float] = {
    Shape.SQUARE: 20.0,
    Shape.RECTANGLE: 22.0,
    Shape.CIRCLE: 24.0,
    Shape.HEXAGON: 26.0,
    Shape.TRIANGLE: 28.0,
}
_TABLE: Rows = ((1.0, 0.0, 0.0, 230.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
# Straight above the table's origin, the top of the picture ahead of the arm, its left edge towards +y.
_CAMERA: Rows = ((0.0, -1.0, 0.0, 230.0), (-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, 600.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class CellSpec:
    """Everything that decides how a simulated cell behaves; equal specs behave the same, bit for bit.

    Attributes:
        arm: The arm as it is described to the controller.
        bins: Boxes on the table, in `table`.
        T_base_table: Nominal pose of `table` in `base`, row-major 4x4, mm.
        T_base_camera: Nominal pose of the camera in `base`, row-major 4x4, mm.
        image_size: (width, height), px.
        field_of_view: Horizontal, of the nominal lens without its distortion, rad.
        parts: How many lie on the table.
        seed: Which parts, where, and which imperfections.
        level: `ideal`, `static` or `dynamic`.
        heights: Height of each shape, mm.
        grips: Nominal extents between the jaws, mm.
        work_area: Where parts are scattered.
        marker: The printed marker on the gripper.
        kinds: What kinds of parts are scattered; none for all shapes in all colours.
        landmarks: (id, x, y) of the printed markers on the table, mm in `table`.
        overrides: Single imperfections that replace the level's, by field name.
        round_part: A round part is at hand, to be touched at calibration and not to be sorted.
        disturb: What happens while it works, as a wish of `disturbances`; "" for nothing.
    """

    arm: ArmDescription
    bins: tuple[Bin, ...] = ()
    T_base_table: Rows = _TABLE
    T_base_camera: Rows = _CAMERA
    image_size: tuple[int, int] = (1280, 720)
    field_of_view: float = math.radians(65.0)
    parts: int = 8
    seed: int = 0
    level: str = "static"
    heights: Mapping[Shape, float] = field(default_factory=lambda: dict(HEIGHTS))
    grips: tuple[float, ...] = (36.0, 43.0, 50.0)
    work_area: WorkArea = field(default_factory=WorkArea)
    marker: MarkerMount = field(default_factory=MarkerMount)
    kinds: tuple[Kind, ...] = ()
    landmarks: tuple[tuple[int, float, float], ...] = ()
    overrides: Mapping[str, float | Vector] = field(default_factory=dict)
    disturb: str = ""
    round_part: bool = False

    def nominal_matrix(self) -> Array:
        """Camera matrix by the data sheet, shape (3, 3), px."""
        width, height = self.image_size
        focal = width / 2.0 / math.tan(self.field_of_view / 2.0)
        return np.array([[focal, 0.0, (width - 1) / 2.0], [0.0, focal, (height - 1) / 2.0], [0.0, 0.0, 1.0]])

    def to_json(self) -> str:
        """The spec as JSON text."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> CellSpec:
        """The spec that `to_json` wrote."""
        data: dict[str, Any] = {name: _frozen(value) for name, value in json.loads(text).items()}
        data["arm"] = _arm(data["arm"])
        data["bins"] = tuple(Bin(**entry) for entry in data["bins"])
        data["heights"] = {Shape(name): height for name, height in data["heights"].items()}
        data["work_area"] = WorkArea(**data["work_area"])
        data["kinds"] = tuple(Kind(**{**entry, "shape": Shape(entry["shape"])}) for entry in data["kinds"])
        data["marker"] = MarkerMount(**data["marker"])
        return cls(**data)


def _frozen(value: Any) -> Any:
    """JSON's lists as tuples, all the way down."""
    if isinstance(value, list):
        return tuple(_frozen(v) for v in value)
    if isinstance(value, dict):
        return {k: _frozen(v) for k, v in value.items()}
    return value


def _arm(data: dict[str, Any]) -> ArmDescription:
    joints = tuple(Joint(**{**joint, "dynamics": ServoDynamics(**joint["dynamics"])}) for joint in data["joints"])
    links = tuple(Link(**link) for link in data["links"])
    return ArmDescription(**{**data, "joints": joints, "links": links, "gripper": Gripper(**data["gripper"])})

"""The cell's configuration: what a user writes down about his table, camera, arm, bins and rules."""

from __future__ import annotations

import difflib
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from controller.config.loader import StrictModel, load_toml
from controller.domain import Array, Bin, Detection, Shape
from controller.errors import ConfigError
from controller.geometry import invert, pose, transform

ColourName = Literal[
    "red", "orange", "yellow", "green", "cyan", "blue", "purple", "pink", "brown", "black", "gray", "white"
]
"""What vision calls colours: the names of its palette."""


class ArmSection(StrictModel):
    """The arm and its port."""

    description: str = "reactorx_150"
    """Name of a shipped arm description, or the path of one of your own."""
    port: str = "/dev/sorter-arm"
    """Serial port of the servo bus; best a link below /dev/serial/by-id."""
    speed_percent: float = Field(100.0, ge=5.0, le=100.0)
    """Share of the arm's speed limits used in automatic operation."""


class CameraSection(StrictModel):
    """The camera."""

    device: str = "/dev/sorter-cam"
    """Video device; best a link below /dev/v4l/by-id."""
    width: int = Field(1280, ge=160, le=8192)
    height: int = Field(720, ge=120, le=8192)
    frames_per_second: float = Field(30.0, gt=0.0, le=240.0)
    field_of_view_deg: float = Field(65.0, ge=10.0, le=170.0)
    """Horizontal field of view by the data sheet: only used before the camera is calibrated."""
    height_mm: float = Field(600.0, ge=50.0, le=5000.0)
    """Height of the lens above the table, by ruler: only used before the camera is calibrated."""
    above_mm: tuple[float, float] = (0.0, 0.0)
    """Point of `table` below the lens, by ruler: only used before the camera is calibrated."""
    frame_timeout_s: float = Field(2.0, gt=0.05, le=30.0)
    """How long to wait for a fresh frame before it is a fault."""
    settings: dict[str, float] = Field(default_factory=dict)
    """V4L2 settings to lock and read back, e.g. exposure, gain, white_balance_temperature, focus."""


class WorkArea(StrictModel):
    """Where parts may be picked: a sector of a ring around the arm's base axis."""

    inner_radius_mm: float = Field(150.0, ge=0.0, le=2000.0)
    outer_radius_mm: float = Field(260.0, gt=0.0, le=2000.0)
    azimuth_deg: tuple[float, float] = (-50.0, 50.0)
    """From, to, about the base's z axis, 0 straight ahead."""

    @model_validator(mode="after")
    def _ordered(self) -> WorkArea:
        if self.inner_radius_mm >= self.outer_radius_mm:
            raise ConfigError("inner_radius_mm is not below outer_radius_mm", "swap or change them")
        low, high = self.azimuth_deg
        if not -180.0 <= low < high <= 180.0:
            raise ConfigError("azimuth_deg is not [from, to] within -180..180", "put the smaller angle first")
        return self


class TableSection(StrictModel):
    """Where the table's coordinates lie before they are measured."""

    origin_in_base_mm: tuple[float, float, float] = (230.0, 0.0, 0.0)
    """Middle of the calibration sheet, seen from the arm's base, by ruler."""
    yaw_deg: float = Field(0.0, ge=-180.0, le=180.0)
    """Direction of the sheet's x axis, seen from the arm's base."""
    board: str = "charuco:10x7:28:21:DICT_5X5_100"
    """The calibration sheet, as for `controller board`."""
    corner_markers: bool = False
    """The printed corner markers (`controller board --corners`) lie on the table: one that is moved holds the cell."""
    work_area: WorkArea = WorkArea()

    def T_base_table(self) -> Array:
        """Pose of `table` in `base` as the ruler has it; shape (4, 4), mm."""
        return pose(*self.origin_in_base_mm, yaw=math.radians(self.yaw_deg))


class VisionSection(StrictModel):
    """What looks at the picture."""

    recipe: str = "precise"
    """Name of a shipped recipe, or the path of one of your own."""
    minimum_score: float = Field(0.5, ge=0.0, le=1.0)
    """Objects below this confidence are left alone."""
    smallest_mm: float = Field(5.0, ge=0.0, le=200.0)
    """Anything whose long side is shorter is dirt: neither a part nor in the way of one."""
    narrowest_mm: float = Field(0.0, ge=0.0, le=200.0)
    """No part that lies as it should is narrower: what is lies on its side, whatever it looks like, or is no part."""
    classes: str = ""
    """Folder of taught classes; without, the cell's own, which is read when a sorting rule asks for a label."""


class PartSection(StrictModel):
    """What is known of a kind of part."""

    shape: Shape
    height_mm: float = Field(gt=0.5, le=200.0)
    mass_g: float = Field(20.0, gt=0.0, le=2000.0)


class BinSection(StrictModel):
    """A place to put parts down."""

    name: str = Field(min_length=1, max_length=40)
    center_mm: tuple[float, float]
    """Middle of the bin in `table`."""
    size_mm: tuple[float, float] = (90.0, 90.0)
    """Inner size along x and y of `table`."""
    wall_mm: float = Field(60.0, ge=0.0, le=300.0)
    """Height of its walls."""
    capacity: int = Field(6, ge=1, le=10_000)

    def overlaps(self, other: BinSection) -> bool:
        """Whether the inner space of two bins meets: their walls, up to 4 mm thick, may be one."""
        gaps = [
            abs(a - b) - (s + t) / 2.0
            for a, b, s, t in zip(self.center_mm, other.center_mm, self.size_mm, other.size_mm, strict=True)
        ]
        return max(gaps) < 0.0

    def value(self) -> Bin:
        """The bin as the rest of the program knows it."""
        return Bin(self.name, self.center_mm, self.size_mm, self.wall_mm, self.capacity)


class RuleSection(StrictModel):
    """One sorting rule; the first that matches decides."""

    bin: str
    shape: Shape | None = None
    """Only this shape."""
    label: str | None = None
    """Only what vision labels so: a taught class."""
    colour: ColourName | None = None
    """Only parts of this colour."""
    size_mm: tuple[float, float] | None = None
    """Only parts whose long side lies in [from, to)."""

    @model_validator(mode="after")
    def _ordered(self) -> RuleSection:
        if self.size_mm is not None and not 0.0 <= self.size_mm[0] < self.size_mm[1]:
            raise ConfigError("size_mm is not [from, to] with from < to", "put the smaller size first")
        return self

    def matches(self, shape: Shape, label: str, long_side: float, colour: str | None = None) -> bool:
        """Whether the rule speaks of an object of this shape, label, long side (mm) and colour."""
        if self.shape is not None and shape is not self.shape:
            return False
        if self.label is not None and label != self.label:
            return False
        if self.colour is not None and colour != self.colour:
            return False
        return self.size_mm is None or self.size_mm[0] <= long_side < self.size_mm[1]


class KindSection(StrictModel):
    """A kind of part that lies on the simulated table."""

    name: str = Field(min_length=1, max_length=40)
    """What it is called: a label that rules may ask for once it has been taught."""
    shape: Shape
    colour: Literal["red", "orange", "yellow", "green", "blue", "purple"]
    marking: Literal["", "striped", "checked", "dotted", "cross", "target", "arrow"] = ""
    """What is on its top."""
    width_mm: float | None = Field(None, ge=10.0, le=80.0)
    """Between the jaws; without, any of the simulated cell's widths."""


class SortingSection(StrictModel):
    """What goes where."""

    rules: tuple[RuleSection, ...] = Field(min_length=1)
    otherwise: str = "leave"
    """Bin for what no rule names, or `leave` to let it lie."""


class CycleSection(StrictModel):
    """How persistent the cell is."""

    attempts: int = Field(3, ge=1, le=10)
    """How often one part is tried before it is left."""
    idle_look_s: float = Field(1.0, ge=0.05, le=600.0)
    """How often an empty table is looked at."""
    picks_per_look: int = Field(1, ge=1, le=100)
    """How many parts are picked from one picture before the next is taken."""
    resume_when_clear_s: float = Field(0.0, ge=0.0, le=600.0)
    """After a hand was over the table: go on when the view has been clear so long; 0: when an operator says so."""
    vision_budget_s: float = Field(0.15, ge=0.0, le=5.0)
    """Simulated time that finding and locating the parts of a picture is charged at; real runs take what they take."""
    planning_budget_s: float = Field(0.02, ge=0.0, le=5.0)
    """Simulated time that planning a pick is charged at."""
    pushing_budget_s: float = Field(0.3, ge=0.0, le=5.0)
    """Simulated time that planning a push for the sake of one part is charged at, whether there is one or not."""


class LedgerSection(StrictModel):
    """How long the record keeps single parts and events; their counts by day stay for ever."""

    keep_days: int = Field(400, ge=1, le=36_500)
    most_mb: int = Field(256, ge=1, le=1_000_000)
    """Room for single records; beyond it the oldest days go first."""


class CellConfig(StrictModel):
    """A whole cell."""

    schema_version: Literal[1] = 1
    name: str = Field("sorting cell", min_length=1, max_length=80)
    arm: ArmSection = ArmSection()
    camera: CameraSection = CameraSection()
    table: TableSection = TableSection()
    vision: VisionSection = VisionSection()
    parts: tuple[PartSection, ...] = ()
    """Heights and masses by shape; a shape not named here has `default_part`'s."""
    default_part: PartSection = PartSection(shape=Shape.OTHER, height_mm=20.0)
    bins: tuple[BinSection, ...] = Field(min_length=1)
    simulated_kinds: tuple[KindSection, ...] = ()
    """What lies on the simulated table; without, all shapes in all colours. A real cell ignores it."""
    sorting: SortingSection
    cycle: CycleSection = CycleSection()
    ledger: LedgerSection = LedgerSection()

    @model_validator(mode="after")
    def _consistent(self) -> CellConfig:
        names = [bin_.name for bin_ in self.bins]
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f"two bins are called {name!r}", "give every bin its own name")
        check_apart(self.bins)
        wanted = [(f"sorting.rules[{i}].bin", rule.bin) for i, rule in enumerate(self.sorting.rules)]
        if self.sorting.otherwise != "leave":
            wanted.append(("sorting.otherwise", self.sorting.otherwise))
        for key, name in wanted:
            if name not in names:
                close = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
                hint = f"did you mean {close[0]}? " if close else ""
                raise ConfigError(f"{key}: there is no bin {name!r}", f"{hint}bins: {', '.join(names)}")
        kinds = [kind.name for kind in self.simulated_kinds]
        if len(set(kinds)) < len(kinds):
            raise ConfigError("two simulated_kinds have the same name", "give every kind its own name")
        shapes = [part.shape for part in self.parts]
        for shape in shapes:
            if shapes.count(shape) > 1:
                raise ConfigError(f"two parts entries speak of {shape}", "keep one")
        return self

    def part(self, shape: Shape) -> PartSection:
        """What is known of parts of this shape."""
        return next((part for part in self.parts if part.shape is shape), self.default_part)

    def part_height(self, detection: Detection) -> float:
        """Height of the part a detection shows, mm."""
        return self.part(detection.shape).height_mm

    @property
    def shape_plane_mm(self) -> float:
        """Height of the plane in which shapes and sizes are judged: half of a common part, mm."""
        heights = [part.height_mm for part in self.parts] or [self.default_part.height_mm]
        return sum(heights) / len(heights) / 2.0

    def bin_values(self) -> tuple[Bin, ...]:
        """All bins."""
        return tuple(bin_.value() for bin_ in self.bins)

    def bin_for(self, shape: Shape, label: str, long_side: float, colour: str | None = None) -> str | None:
        """Name of the bin for an object of this shape, label, long side (mm) and colour, or None to let it lie."""
        for rule in self.sorting.rules:
            if rule.matches(shape, label, long_side, colour):
                return rule.bin
        return None if self.sorting.otherwise == "leave" else self.sorting.otherwise

    def in_work_area(
        self, center: tuple[float, float], T_base_table: Array, margin_mm: float = 0.0
    ) -> bool:
        """Whether a point of `table` (mm) lies where parts may be picked, or within a margin of it."""
        x, y, _ = transform(T_base_table, [*center, 0.0])
        area = self.table.work_area
        low, high = area.azimuth_deg
        radius, azimuth = math.hypot(x, y), math.degrees(math.atan2(y, x))
        aside = math.degrees(margin_mm / max(radius, 1.0))
        at_radius = area.inner_radius_mm - margin_mm <= radius <= area.outer_radius_mm + margin_mm
        return at_radius and low - aside <= azimuth <= high + aside

    def work_area_outline(self, T_base_table: Array, margin_mm: float = 0.0, step_deg: float = 5.0) -> Array:
        """Polygon (N, 2) around the work area in `table`, mm, widened by `margin_mm`."""
        area = self.table.work_area
        low, high = (math.radians(a) for a in area.azimuth_deg)
        inner, outer = max(area.inner_radius_mm - margin_mm, 0.0), area.outer_radius_mm + margin_mm
        widen = margin_mm / max(area.inner_radius_mm, 1.0)
        angles = np.arange(low - widen, high + widen + 1e-9, math.radians(step_deg))
        ring = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
        return transform(invert(T_base_table), np.vstack([outer * ring, (inner * ring)[::-1]]))[:, :2]

    @property
    def taught_labels(self) -> frozenset[str]:
        """Labels that rules ask for and no shape has: classes that must have been taught."""
        asked = {rule.label for rule in self.sorting.rules if rule.label is not None}
        return frozenset(asked - {str(shape) for shape in Shape})

    @property
    def digest(self) -> str:
        """Hash of the whole configuration, for the ledger."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]


def check_apart(bins: Sequence[BinSection]) -> None:
    """Refuse bins that stand in one another.

    Raises:
        ConfigError: It names the two.
    """
    for k, one in enumerate(bins):
        for other in bins[k + 1 :]:
            if one.overlaps(other):
                raise ConfigError(f"bins {one.name!r} and {other.name!r} stand in one another", "move one of them")


def load_cell(path: Path) -> CellConfig:
    """The configuration of a cell.

    Raises:
        ConfigError: See `controller.config.loader.load_toml`.
    """
    return load_toml(path, CellConfig)

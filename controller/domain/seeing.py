"""What is seen and where it lies: from a frame to an object on the table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from controller.domain.types import Array, Point


class Shape(StrEnum):
    """What vision can tell from an outline alone; `OTHER` is a verdict, not a failure."""

    SQUARE = "square"
    RECTANGLE = "rectangle"
    CIRCLE = "circle"
    HEXAGON = "hexagon"
    TRIANGLE = "triangle"
    OTHER = "other"

    @property
    def period(self) -> float | None:
        """Smallest turn (rad) that maps the shape onto itself; None for a circle, which has no direction."""
        return _PERIOD[self]


_PERIOD: Mapping[Shape, float | None] = {
    Shape.SQUARE: math.pi / 2,
    Shape.RECTANGLE: math.pi,
    Shape.CIRCLE: None,
    Shape.HEXAGON: math.pi / 3,
    Shape.TRIANGLE: 2 * math.pi / 3,
    Shape.OTHER: math.pi,
}


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image.

    Attributes:
        frame_id: Counts up from 1 within a run.
        captured_at: When the exposure ended, s of the cell's clock.
        image: ndarray of shape (H, W, 3), dtype uint8, BGR, read-only.
        source: File or device it came from.
    """

    frame_id: int
    captured_at: float
    image: NDArray[np.uint8]
    source: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return self.image.shape[1], self.image.shape[0]


@dataclass(frozen=True, slots=True)
class Descriptors:
    """The paper's three variables of one outline (its section III).

    Attributes:
        extent: Area of the axis-aligned bounding box over the object's area (the inverse of the toolbox's).
        compactness: perimeter^2 / (4 pi area), the paper's equation (1).
        side_difference: Absolute difference of two adjacent sides, px.
    """

    extent: float
    compactness: float
    side_difference: float


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """One object as seen in one frame, in pixels.

    Attributes:
        frame: The frame it was seen in.
        shape: Verdict of the outline.
        score: Confidence in [0, 1].
        outline_px: ndarray of shape (N, 2), the outer outline, sub-pixel, not closed,
            counter-clockwise as displayed.
        center_px: Centroid of the outer outline, holes filled.
        size_px: (long, short) side of the minimum-area rectangle; a circle has its diameter twice.
        angle: rad, counter-clockwise as displayed, in [0, period) of the shape: a rectangle's long side, a
            side of a square or hexagon, the direction of a triangle's side walked counter-clockwise, the
            long axis of anything else; None for a circle.
        area_px: Area of the outer outline, holes filled, px^2.
        bbox_px: (x, y, width, height) of the axis-aligned bounding box.
        descriptors: The paper's variables.
        label: What the sorting rules or a taught class call it; the shape's name until they do.
        flags: Any of `cut_by_border`, `touching`, `hole`, ...
        colour: Name of its colour, or None when it was not measured.
        texture: Name of its texture, or None when it was not measured.
    """

    frame: Frame
    shape: Shape
    score: float
    outline_px: Array
    center_px: Point
    size_px: tuple[float, float]
    angle: float | None
    area_px: float
    bbox_px: tuple[float, float, float, float]
    descriptors: Descriptors
    label: str = ""
    flags: frozenset[str] = frozenset()
    colour: str | None = None
    texture: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LocatedObject:
    """One object on the table, in `table` coordinates (mm, rad, z up from the table's surface).

    Attributes:
        detection: What was seen.
        target_id: Follows one physical object over its retries; "" until the cycle gives it one.
        center: (x, y) of the footprint's centroid, mm.
        yaw: Direction as for `Detection.angle`, but counter-clockwise about z of `table` seen from above.
        size: (long, short) side of the footprint's minimum-area rectangle, mm.
        height: Height of the part above the table, mm.
        footprint: ndarray of shape (N, 2), the outline on the table, mm, counter-clockwise, not closed.
        sigma: Standard deviation of the centre, mm, the larger axis.
        calibration_id: The calibration the millimetres rest on.
    """

    detection: Detection
    center: Point
    yaw: float | None
    size: tuple[float, float]
    height: float
    footprint: Array
    sigma: float
    calibration_id: str
    target_id: str = ""

    @property
    def shape(self) -> Shape:
        """Verdict of the outline."""
        return self.detection.shape

"""What only a simulated world can tell."""

from __future__ import annotations

from dataclasses import dataclass

from controller.domain.seeing import Shape
from controller.domain.types import Point


@dataclass(frozen=True, slots=True)
class TruePart:
    """What a simulated world knows about one part; never an input of the controller.

    Attributes:
        part_id: Index within the world.
        shape: What it is.
        colour: Name of its colour.
        center: (x, y) of its footprint's centroid in `table` (the frame of the sheet as it was laid), mm.
        yaw: As for `LocatedObject.yaw`; None for a circle.
        size: (long, short) side of the footprint's minimum-area rectangle, mm.
        height: mm.
        upright: It stands on the face it was laid on.
        place: `table`, `gripper`, `floor`, `away` (a person has it), or the name of the bin it lies in.
        reachable: It lay within the arm's reach at the start.
        kind: Name of its kind, where the table was laid with chosen kinds; else "".
    """

    part_id: int
    shape: Shape
    colour: str
    center: Point
    yaw: float | None
    size: tuple[float, float]
    height: float
    upright: bool
    place: str
    reachable: bool
    kind: str = ""

"""The nouns: what travels through the cell from a frame to an outcome, and what is known about the cell.

    Frame -> Detection -> LocatedObject -> PickPlan -> Outcome

Every value is frozen and keeps its parent, so that a line of the ledger leads back to the frame and the
calibration that caused it. Lengths are mm, angles rad, times s of the cell's clock.
"""

from __future__ import annotations

from controller.domain.arm import (
    ArmDescription,
    ArmState,
    Gripper,
    GripReport,
    Joint,
    Link,
    MoveReport,
    ServoCycle,
    ServoDynamics,
    Trajectory,
)
from controller.domain.cell import (
    Bin,
    CellCalibration,
    ErrorMap,
)
from controller.domain.picking import (
    Grasp,
    NudgePlan,
    Outcome,
    PickPlan,
    Result,
)
from controller.domain.seeing import (
    Descriptors,
    Detection,
    Frame,
    LocatedObject,
    Shape,
)
from controller.domain.truth import (
    TruePart,
)
from controller.domain.types import Array, Point

__all__ = [
    "ArmDescription",
    "ArmState",
    "Array",
    "Bin",
    "CellCalibration",
    "Descriptors",
    "Detection",
    "ErrorMap",
    "Frame",
    "Grasp",
    "GripReport",
    "Gripper",
    "Joint",
    "Link",
    "LocatedObject",
    "MoveReport",
    "NudgePlan",
    "Outcome",
    "PickPlan",
    "Point",
    "Result",
    "ServoCycle",
    "ServoDynamics",
    "Shape",
    "Trajectory",
    "TruePart",
]

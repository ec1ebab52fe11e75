"""What the cycle works with, put together once by the composition root."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from controller.config.cell import CellConfig
from controller.cycle.guard import ClearView
from controller.cycle.machine import State
from controller.domain import CellCalibration, Detection, Frame, LocatedObject, NudgePlan, Outcome, PickPlan
from controller.errors import SorterError
from controller.motion.planner import Planner
from controller.ports import Arm, Camera, Clock, Ledger
from controller.vision.classes.taught import Taught
from controller.vision.recipe import Recipe


@dataclass(frozen=True, slots=True)
class Look:
    """What one frame showed.

    Attributes:
        frame: The frame.
        detections: Everything vision found in the work area.
        located: What of it is known in mm well enough to be picked, with target ids where they are known.
        refused: What was seen but could not be located, and why.
    """

    frame: Frame
    detections: tuple[Detection, ...]
    located: tuple[LocatedObject, ...]
    refused: tuple[tuple[Detection, str], ...] = ()


class Observer:
    """Someone who watches a run: progress on a terminal, pictures, statistics. Must not block."""

    def entered(self, state: State, at: float) -> None:
        """The machine entered a state at `at` (s of the cell's clock)."""

    def looked(self, look: Look) -> None:
        """A frame was worked out."""

    def planned(self, plan: PickPlan) -> None:
        """A plan was approved and is about to be carried out."""

    def attempted(self, plan: PickPlan, attempt: int) -> None:
        """Motion for a target began."""

    def nudging(self, plan: NudgePlan) -> None:
        """The jaws are about to push a part to make room."""

    def nudged(self, plan: NudgePlan) -> None:
        """They have."""

    def worked_ahead(self, began: float, ended: float) -> None:
        """A look was worked out while the arm was placing: from when to when by its budget, s of the cell's clock."""

    def failed(self, plan: PickPlan, reason: str) -> None:
        """An attempt failed; the target is tried again or gets its outcome."""

    def concluded(self, outcome: Outcome) -> None:
        """A target got its outcome."""

    def held(self, cause: SorterError, at: float) -> None:
        """The cell holds for something that may pass; told once for each cause."""

    def resumed(self, at: float) -> None:
        """What the cell held for has passed."""

    def faulted(self, error: SorterError, at: float) -> None:
        """The first fault latched."""

    def warned(self, code: str, cause: str, at: float) -> None:
        """Something is not in order, and the cell goes on; `code` is the fault catalogue's."""

    def eased(self, code: str, at: float) -> None:
        """What was warned of is over."""


@dataclass(frozen=True, slots=True)
class Rig:
    """Devices, knowledge and rules of one cell.

    Attributes:
        concerns: What the devices say is not in order yet no reason to hold: causes by code of the fault catalogue.
        clear_view: How the table looks with nothing over it, as far as an earlier start has seen it.
        pick_proof: Off, the jaws are believed to hold what they were sent for: only to see what the proof is worth.
    """

    config: CellConfig
    camera: Camera
    arm: Arm
    clock: Clock
    ledger: Ledger
    calibration: CellCalibration
    recipe: Recipe
    planner: Planner
    observers: tuple[Observer, ...] = ()
    confirm: Callable[[PickPlan], bool] = field(default=lambda plan: True)
    classes: Taught | None = None
    concerns: Callable[[], Mapping[str, str]] = field(default=dict)
    clear_view: ClearView = field(default_factory=ClearView)
    pick_proof: bool = True

    def part_height(self, detection: Detection) -> float:
        """Height of the part a detection shows, mm: a taught class's own, else the configuration's by its shape."""
        known = self.classes.heights.get(detection.label) if self.classes is not None else None
        return self.config.part_height(detection) if known is None else known

"""Rehearsals: the real camera, and an arm that moves nothing, or passes above the parts without gripping."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import Self

from controller.cycle.rig import Observer
from controller.domain import (
    ArmDescription,
    ArmState,
    Array,
    Bin,
    CellCalibration,
    Frame,
    Grasp,
    GripReport,
    LocatedObject,
    MoveReport,
    PickPlan,
    Point,
    Trajectory,
)
from controller.errors import CameraEnded
from controller.geometry import pose
from controller.motion.overhead import TALLEST_PART
from controller.motion.planner import Planner
from controller.ports import Arm, Camera

AIR_SPEED = 0.25
"""Share of the joints' speed limits in an air run."""

AIR_CLEARANCE = 10.0
"""mm that the jaws' tips keep over the tallest part in an air run."""


class Rehearsal(StrEnum):
    """What a run leaves out."""

    NONE = "none"
    DRY = "dry"
    """The arm: it has no torque, its moves are written down."""
    AIR = "air"
    """Touching: the arm moves above the parts, slowly, its jaws still."""


class ImaginedPart(Observer):
    """A part where there is none to grip: always where it was seen, as wide as it was measured."""

    def __init__(self) -> None:
        self._width = 0.0

    def planned(self, plan: PickPlan) -> None:
        """Remember how wide the part is that the jaws will close on."""
        self._width = plan.grasp.width

    def grip(self, before: float, wanted: float) -> tuple[bool, float]:
        """Whether the jaws touch the part on their way, and where they settle (mm)."""
        return (True, self._width) if wanted < self._width <= before else (False, wanted)


class OneLook:
    """A camera that shows one picture: what is not really picked would else be seen again and again.

    Args:
        camera: The camera.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._looked = False

    def open(self) -> None:
        """Open the camera."""
        self._camera.open()

    def close(self) -> None:
        """Release the camera."""
        self._camera.close()

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        """The camera's picture, once.

        Raises:
            CameraEnded: It has been shown.
            CameraError: See the camera.
        """
        if self._looked:
            raise CameraEnded("camera", "capture", "the rehearsal of this picture is over")
        frame = self._camera.capture(after, timeout)
        self._looked = True
        return frame


class EmptyHanded:
    """An arm that moves as it is told, but only pretends to move its jaws.

    Args:
        arm: The arm.
        part: What the jaws pretend to close on.
    """

    def __init__(self, arm: Arm, part: ImaginedPart) -> None:
        self._arm = arm
        self._part = part
        self._opening = arm.description.gripper.opening[1]

    @property
    def description(self) -> ArmDescription:
        """What kind of arm this is."""
        return self._arm.description

    def open(self, *, restart: bool = False) -> None:
        """Open the arm."""
        self._arm.open(restart=restart)

    def close(self) -> None:
        """Release the arm."""
        self._arm.close()

    def energise(self) -> ArmState:
        """Torque on where the arm stands."""
        return self._pretend(self._arm.energise())

    def relax(self) -> None:
        """Torque off."""
        self._arm.relax()

    def state(self) -> ArmState:
        """The arm's state, its jaws where they pretend to be."""
        return self._pretend(self._arm.state())

    def follow(self, trajectory: Trajectory, opening: float | None = None, after: float = 0.0) -> MoveReport:
        """Follow the trajectory, only pretending to open the jaws on the way (mm); blocks, moves metal."""
        if opening is not None:
            self._opening = opening
        return self._arm.follow(trajectory)

    def grip(self, opening: float, effort: float = 1.0) -> GripReport:
        """Pretend to move the jaws; nothing moves."""
        contact, self._opening = self._part.grip(self._opening, opening)
        return GripReport(True, contact, self._opening, effort if contact else 0.0)

    def request_stop(self) -> None:
        """Stop the arm along its path."""
        self._arm.request_stop()

    def clear_stop(self) -> None:
        """Allow motion again."""
        self._arm.clear_stop()

    def pause(self) -> None:
        """Hold the arm on its path."""
        self._arm.pause()

    def resume(self) -> None:
        """Go on from there."""
        self._arm.resume()

    @property
    def holds(self) -> bool:
        """It has come to stand for a pause."""
        return self._arm.holds

    def _pretend(self, state: ArmState) -> ArmState:
        return replace(state, opening=self._opening)


class AirPlanner(Planner):
    """Plans picks on a table that it takes to stand as much higher as the jaws must pass over everything.

    Args:
        arm: The arm.
        calibration: The cell's calibration.
        bins: All bins.
        speed: Share of the arm's speed limits, in (0, 1].
    """

    def __init__(
        self, arm: ArmDescription, calibration: CellCalibration, bins: Sequence[Bin], *, speed: float
    ) -> None:
        super().__init__(arm, calibration, bins, speed=speed)
        raised = pose(z=TALLEST_PART + AIR_CLEARANCE) @ calibration.T_base_table
        self._above = Planner(arm, replace(calibration, T_base_table=raised), bins, speed=speed, part_mass=0.0)

    def filled(self, piles: Mapping[str, float]) -> Self:
        """As `Planner.filled`."""
        over = super().filled(piles)
        over._above = self._above.filled(piles)
        return over

    def plan_pick(
        self,
        target: LocatedObject,
        others: Sequence[LocatedObject],
        bin: Bin,
        drop: Point,
        start: Array,
        *,
        view: Array | None = None,
        climb: float = 0.0,
        corners: bool = False,
        avoid: Sequence[Grasp] = (),
    ) -> PickPlan:
        """As `Planner.plan_pick`, above the parts."""
        return self._above.plan_pick(
            target, others, bin, drop, start, view=view, climb=climb, corners=corners, avoid=avoid
        )

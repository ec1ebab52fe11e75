"""The plan for one part, and what became of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from controller.domain.arm import Trajectory
from controller.domain.cell import Bin
from controller.domain.seeing import LocatedObject
from controller.domain.types import Point


@dataclass(frozen=True, slots=True)
class Grasp:
    """How the jaws take a part.

    Attributes:
        center: (x, y) of the grasp point in `table`, mm.
        height: z of the grasp point in `table`, mm.
        direction: Closing direction, rad about z of `table`, in [0, pi).
        width: Extent of the part along the closing direction, mm: the opening at contact.
        opening: Clear opening before closing, mm.
        clearance: Smallest distance of a jaw's swept area from anything else, mm.
        flush: Extent once the closing jaws have turned the part flush, mm: `width` or less, and where they settle.
    """

    center: Point
    height: float
    direction: float
    width: float
    opening: float
    clearance: float
    flush: float


@dataclass(frozen=True, slots=True, eq=False)
class PickPlan:
    """Everything that will move for one target, approved as a whole before anything does.

    The gripper opens to `grasp.opening` before `approach` descends, closes at its end, and opens at the
    end of `carry`.
    """

    target: LocatedObject
    bin: Bin
    grasp: Grasp
    approach: Trajectory
    carry: Trajectory
    retreat: Trajectory

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """All moves in order."""
        return self.approach, self.carry, self.retreat


@dataclass(frozen=True, slots=True, eq=False)
class NudgePlan:
    """A push that makes room for the jaws, approved as a whole before anything moves.

    The jaws close to `opening` on the way and stay so.

    Attributes:
        target: The part that is to be freed.
        moved: What is pushed: the target, or a neighbour.
        by: (dx, dy) that the jaws go with it, mm in `table`.
        ends: How it may come to lie.
        opening: Clear opening of the jaws during all of it, mm.
        approach: Down to the table beside it.
        push: Straight along the table.
        retreat: Up, and to the ready pose.
    """

    target: LocatedObject
    moved: LocatedObject
    by: Point
    ends: tuple[LocatedObject, ...]
    opening: float
    approach: Trajectory
    push: Trajectory
    retreat: Trajectory

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """All moves in order."""
        return self.approach, self.push, self.retreat


class Result(StrEnum):
    """What became of a target; every target gets exactly one."""

    PLACED = "placed"
    GRASP_MISSED = "grasp_missed"
    DROPPED = "dropped"
    REJECTED = "rejected"
    SKIPPED = "skipped"
    ABORTED = "aborted"
    INDETERMINATE = "indeterminate"


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """The one final word about a target.

    Attributes:
        target: The object as it was last located before the last attempt.
        plan: The last plan, or None when none was found.
        result: What became of it.
        reason: One line for people.
        attempts: How often it was tried.
        started_at, finished_at: s of the cell's clock.
    """

    target: LocatedObject
    plan: PickPlan | None
    result: Result
    reason: str
    attempts: int
    started_at: float
    finished_at: float

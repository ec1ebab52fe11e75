"""Which part comes next, and how: the surest and nearest first, and nothing that was given up or has no bin."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from controller.cycle.rig import Rig
from controller.cycle.stock import Stock
from controller.cycle.targets import Target, TargetBook
from controller.domain import Array, Grasp, LocatedObject, NudgePlan, PickPlan, Shape
from controller.errors import NoClearGrasp, PlanError
from controller.geometry import transform
from controller.motion.planner import Planner

_SURE = 0.8
"""Of two candidates of which only one is this sure, that one comes first, however far it is."""

_RIM_MM = 25.0
"""What lies this far beyond the work area's rim may have been pushed there by the jaws, alone or by its neighbour: half
a part's width."""

NUDGES = 8
"""Pushes for the sake of one part until another is gone: a long one may need three turns and a way out of a corner."""

_AVOIDED = 20
"""Grasps that are remembered as blocked: as many as a crowded table has parts."""


class Chooser:
    """Chooses among the things of one look.

    Attributes:
        queue: Candidates of the look that are not yet tried, the best first.
        blocked: Those for which the jaws had no room.

    Args:
        rig: The cell.
        book: The open targets.
        stock: What the bins hold.
        view: ndarray of shape (N, 2): what the camera must see after a part was placed; `table`, mm.
    """

    def __init__(self, rig: Rig, book: TargetBook, stock: Stock, view: NDArray[np.float64]) -> None:
        self._rig, self._book, self._stock, self._view = rig, book, stock, view
        self._others: tuple[LocatedObject, ...] = ()
        self._looked_at: list[LocatedObject] = []
        self._avoided: deque[Grasp] = deque(maxlen=_AVOIDED)
        self._concluded = 0
        self.queue: list[LocatedObject] = []
        self.blocked: list[LocatedObject] = []

    def offer(
        self, named: Sequence[LocatedObject], in_the_way: Sequence[LocatedObject], start: Array, concluded: int
    ) -> None:
        """The things of a new look; what of them may be picked comes into the queue.

        What has no name comes after all that has one: two parts that touch may look like one of no known shape,
        until the other is gone. Of the others the one comes first that the waist turns least to.

        Args:
            named: What was located, with the ids of the open targets.
            in_the_way: What could not be, roughly, and what the look has overlooked.
            start: ndarray of shape (J,): where the arm stands, rad.
            concluded: How many targets have their outcome: some rest until it is enough.
        """
        self._others, self._concluded = (*named, *in_the_way), concluded
        tried = {target.target_id: target.attempts for target in self._book.open}
        resting = {target.target_id for target in self._book.resting if target.rests_until > concluded}

        def rank(thing: LocatedObject) -> tuple[int, bool, bool, float]:
            unsure = thing.detection.score < _SURE
            return tried.get(thing.target_id, 0), thing.shape is Shape.OTHER, unsure, self._turn(thing, start)

        awake = [thing for thing in named if thing.target_id not in resting]
        self._looked_at = sorted((thing for thing in awake if self._may_be_picked(thing)), key=rank)
        self.queue = list(self._looked_at)

    def anew(self) -> None:
        """All candidates of the look again that were not chosen yet: the arm stands elsewhere now."""
        self.queue = list(self._looked_at)

    def next(
        self, planner: Planner, start: Array, climb: float, corners: bool = False
    ) -> tuple[Target, PickPlan] | None:
        """The first candidate that a safe plan exists for, or None.

        Args:
            planner: Plans it.
            start: ndarray of shape (J,): where the arm stands, rad.
            climb: See `Planner.plan_pick`.
            corners: See `Planner.plan_pick`.
        """
        self.blocked = []
        while self.queue:
            thing = self.queue.pop(0)
            bin_ = self._stock.bin_for(thing)
            if bin_ is None:
                continue
            others = self._apart_from(thing)
            try:
                plan = planner.plan_pick(
                    thing, others, bin_, self._stock.drop_point(bin_), start,
                    view=self._view, climb=climb, corners=corners, avoid=self._avoided,
                )  # fmt: skip
            except PlanError as error:
                if isinstance(error, NoClearGrasp):
                    # Found before any path is looked for.
                    self.blocked.append(thing)
                else:
                    self._charge()
                now = self._rig.clock.now()
                self._rig.ledger.note("unplannable", now, center=thing.center, reason=str(error))
                continue
            self._charge()
            target = self._book.choose(thing, self._rig.clock.now())
            target.plan = plan
            self._others = others
            self._looked_at = [other for other in self._looked_at if other is not thing]
            return target, plan
        return None

    def avoid(self, grasp: Grasp) -> None:
        """The jaws came down on something: the next try is another grasp."""
        self._avoided.append(grasp)

    def nudge(self, planner: Planner, start: Array, climb: float) -> tuple[Target, NudgePlan] | None:
        """A push that makes room for one of those that are blocked, or None.

        Args:
            planner: Plans it.
            start: ndarray of shape (J,): where the arm stands, rad.
            climb: See `Planner.plan_pick`.
        """
        outline = self._rig.config.work_area_outline(self._rig.calibration.T_base_table)
        widest = self._rig.arm.description.gripper.opening[1]
        # What no push makes fit between the jaws may not even be a thing.
        fitting = [thing for thing in self.blocked if thing.size[1] <= widest]
        targets: dict[int, Target] = {}
        # What is foreseen to free any of them comes before what only may free the first.
        for unsure, (index, thing) in itertools.product((False, True), enumerate(fitting)):
            target = targets.get(index) or self._book.choose(thing, self._rig.clock.now())
            targets[index] = target
            if target.nudged_among != self._concluded:
                target.nudges, target.nudged_among = 0, self._concluded
            if target.nudges >= NUDGES:
                continue
            # What loosens a heap for one part must not undo what was tried for another.
            tried = [push for each in self._book.open for push in each.pushed] if unsure else target.pushed
            others = self._apart_from(thing)
            try:
                plan = planner.plan_nudge(thing, others, outline, start, climb=climb, tried=tried, unsure=unsure)
            except PlanError:
                continue
            finally:
                self._rig.clock.charge(self._rig.config.cycle.pushing_budget_s)
            target.nudges += 1
            target.pushed.append((plan.moved.center, plan.by))
            return target, plan
        return None

    def _may_be_picked(self, thing: LocatedObject) -> bool:
        config = self._rig.config
        # What was worked on may have been dropped beyond the area's rim, and still be in reach.
        inside = thing.target_id != "" or config.in_work_area(
            thing.center, self._rig.calibration.T_base_table, _RIM_MM
        )
        return (
            inside
            and thing.detection.score >= config.vision.minimum_score
            and "cut_by_border" not in thing.detection.flags
            and not self._book.is_given_up(thing)
            and self._stock.bin_for(thing) is not None
        )

    def _turn(self, thing: LocatedObject, start: Array) -> float:
        """How far the waist turns to a thing, rad."""
        x, y, _ = transform(self._rig.calibration.T_base_table, [*thing.center, 0.0])
        return abs(math.atan2(y, x) - float(start[0]))

    def _apart_from(self, thing: LocatedObject) -> tuple[LocatedObject, ...]:
        return tuple(other for other in self._others if other.detection is not thing.detection)

    def _charge(self) -> None:
        self._rig.clock.charge(self._rig.config.cycle.planning_budget_s)

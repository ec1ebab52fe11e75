"""The figures of a run: counted from outcomes, and beside a simulated world's truth where there is one."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.config.cell import CellConfig
from controller.cycle.machine import State
from controller.cycle.rig import Look, Observer
from controller.domain import LocatedObject, NudgePlan, Outcome, PickPlan, Result, TruePart
from controller.geometry import angle_difference
from controller.ports import Truth

SAME_PART_MM = 30.0
"""Half of a part and more: a located object belongs to the true part nearest to it within this distance."""


@dataclass(frozen=True, slots=True)
class Error:
    """How far a located object was from the truth.

    Attributes:
        position: mm.
        angle: rad modulo the symmetry, or None for a circle or a wrong shape.
    """

    position: float
    angle: float | None


def nearest(parts: Sequence[TruePart], located: LocatedObject) -> TruePart | None:
    """The part on the table that a located object must be, or None when there is none near."""
    on_table = [part for part in parts if part.place == "table"]
    if not on_table:
        return None
    best = min(on_table, key=lambda part: math.dist(part.center, located.center))
    return best if math.dist(best.center, located.center) <= SAME_PART_MM else None


def error_of(part: TruePart, located: LocatedObject) -> Error:
    """Error of one located object against the part it shows."""
    angle = None
    period = part.shape.period
    if part.shape is located.shape and period is not None and part.yaw is not None and located.yaw is not None:
        angle = abs(angle_difference(located.yaw, part.yaw, period))
    return Error(math.dist(part.center, located.center), angle)


def right_bin(config: CellConfig, part: TruePart) -> str | None:
    """Where the rules want a true part; a taught class is a true part's when it is called as its kind is, or by its
    colour and shape.
    """
    names = (part.kind, f"{part.colour} {part.shape}")
    label = next((name for name in names if name in config.taught_labels), str(part.shape))
    return config.bin_for(part.shape, label, part.size[0], part.colour)


class Statistics(Observer):
    """Counts a run as it goes; keeps no pictures, so that it may go on for months.

    Args:
        config: For the rules that say what was right.
        truth: The simulated world, or None on real hardware.
    """

    def __init__(self, config: CellConfig, truth: Truth | None = None) -> None:
        self._config = config
        self._truth = truth
        self._count: Counter[Result] = Counter()
        self._first_try = 0
        self._fates: list[tuple[Result, int | None, str]] = []
        self.attempts = 0
        self.nudges = 0
        self._touches_before = self._touches_meant = 0
        self.errors: list[Error] = []

    def attempted(self, plan: PickPlan, attempt: int) -> None:
        """Count the attempt, and compare where the part was thought to be with where it was."""
        self.attempts += 1
        if self._truth is not None:
            part = nearest(self._truth.at(plan.target.detection.frame.captured_at), plan.target)
            if part is not None:
                self.errors.append(error_of(part, plan.target))

    def nudging(self, plan: NudgePlan) -> None:
        """Count the push, and what it is about to touch apart from collisions."""
        self.nudges += 1
        self._touches_before = 0 if self._truth is None else self._truth.collisions()

    def nudged(self, plan: NudgePlan) -> None:
        """The push is over."""
        if self._truth is not None:
            self._touches_meant += self._truth.collisions() - self._touches_before

    def concluded(self, outcome: Outcome) -> None:
        """Count the outcome, and note which true part it is about."""
        self._count[outcome.result] += 1
        self._first_try += outcome.attempts == 1 and outcome.result in (Result.PLACED, Result.REJECTED)
        if self._truth is not None:
            seen = nearest(self._truth.at(outcome.target.detection.frame.captured_at), outcome.target)
            bin_ = "" if outcome.plan is None else outcome.plan.bin.name
            self._fates.append((outcome.result, None if seen is None else seen.part_id, bin_))

    def summary(self, left_seen: int, cycle_times: Sequence[float]) -> dict[str, Any]:
        """The counts of the contract of `controller run --json`; lengths mm, angles degrees, times s.

        Args:
            left_seen: Objects that the last look showed on the table.
            cycle_times: s for each part dealt with.
        """
        count = self._count
        tried_left = count[Result.SKIPPED] + count[Result.GRASP_MISSED] + count[Result.ABORTED]
        figures: dict[str, Any] = {
            "sorted": count[Result.PLACED],
            "rejected": count[Result.REJECTED],
            "left": max(left_seen, tried_left),
            "dropped": count[Result.DROPPED],
            "indeterminate": count[Result.INDETERMINATE],
            "attempts": self.attempts,
            "nudges": self.nudges,
            "first_try": self._first_try,
            "cycle_s": spread(cycle_times, ("median", "p95")),
        }
        figures["parts"] = sum(figures[key] for key in ("sorted", "rejected", "left", "dropped", "indeterminate"))
        if self._truth is not None:
            figures |= self._against_truth(figures)
        return figures

    def _against_truth(self, figures: Mapping[str, Any]) -> dict[str, Any]:
        assert self._truth is not None
        final = {part.part_id: part for part in self._truth.now()}
        bins = {bin_.name for bin_ in self._config.bins}
        verdicts: Counter[str] = Counter()
        phantoms: Counter[Result] = Counter()
        last = {part_id: number for number, (_, part_id, _) in enumerate(self._fates) if part_id is not None}
        never_told = [part for part in final.values() if part.part_id not in last]
        again = 0
        for number, (result, part_id, bin_) in enumerate(self._fates):
            part = final[part_id] if part_id is not None else None
            if part_id is None or (result is not Result.PLACED and last[part_id] != number):
                phantoms[result] += 1
            if result is not Result.PLACED:
                continue
            if part_id is not None and last[part_id] != number:
                # It was worked on again later: another part lies there in its stead, exchanged unseen, or none.
                part = next((other for other in never_told if other.place == bin_), None)
                if part is None:
                    again += 1
                else:
                    never_told.remove(part)
            if part is None or part.place not in bins:
                verdicts["silent"] += 1
            elif part.place == right_bin(self._config, part):
                verdicts["correct"] += 1
            else:
                verdicts["missorted"] += 1
        # What a person has taken is no part of the run, unless the cell was at work on it.
        final = {number: part for number, part in final.items() if part.place != "away" or number in last}
        # A target that never was a part is none of the parts, whatever became of the attempt; and one that was lost
        # and turned up again has its fate from the last attempt.
        true_counts = {
            key: figures[key] - phantoms[Result(key)] for key in ("rejected", "dropped", "indeterminate")
        }
        accounted = figures["sorted"] - again + sum(true_counts.values())
        return {
            **true_counts,
            "phantoms": sum(phantoms.values()),
            "parts": len(final),
            "reachable": sum(part.reachable for part in final.values()),
            "left": len(final) - accounted,
            "correct": verdicts["correct"],
            "missorted": verdicts["missorted"],
            "silent": verdicts["silent"],
            "collisions": self._truth.collisions() - self._touches_meant,
            "localization_error_mm": spread([e.position for e in self.errors], ("mean", "p95", "max")),
            "orientation_error_deg": spread(
                [math.degrees(e.angle) for e in self.errors if e.angle is not None], ("mean", "p95")
            ),
        }


def spread(values: Sequence[float], wanted: Sequence[str]) -> dict[str, float | None]:
    """Any of mean, median, p95 and max of some values, rounded to a thousandth; None where there are none."""
    functions: dict[str, Callable[[Any], Any]] = {
        "mean": np.mean,
        "median": np.median,
        "p95": lambda v: np.percentile(v, 95),
        "max": np.max,
    }
    return {name: round(float(functions[name](values)), 3) if len(values) else None for name in wanted}


class Album(Observer):
    """Keeps the pictures of a run: the first look, the last one, and the cell at its first grasp.

    Args:
        portrait: Takes a picture of the whole cell, (H, W, 3), where there is someone to take it.
    """

    def __init__(self, portrait: Callable[[], NDArray[np.uint8]] | None = None) -> None:
        self._portrait = portrait
        self.first: Look | None = None
        self.last: Look | None = None
        self.at_work: NDArray[np.uint8] | None = None

    def looked(self, look: Look) -> None:
        """Remember the look."""
        self.first = self.first or look
        self.last = look

    def entered(self, state: State, at: float) -> None:
        """Take the portrait when the first part is between the jaws."""
        if state is State.PLACE and self._portrait is not None and self.at_work is None:
            self.at_work = self._portrait()

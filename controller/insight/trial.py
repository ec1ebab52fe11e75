"""One run of the simulated cell beside its truth, written down in full: what every look showed, what every attempt
did, where everything ended, and pictures of all that went wrong. The record is plain JSON, so that runs of many
processes can be put together.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.backends import Devices, Touch
from controller.config.cell import CellConfig
from controller.cycle.machine import State
from controller.cycle.rig import Look, Observer
from controller.domain import NudgePlan, Outcome, PickPlan, Point, Result, TruePart
from controller.errors import SorterError
from controller.insight.report import annotated
from controller.insight.statistics import error_of, nearest, right_bin
from controller.insight.timeline import Timeline
from controller.ports import Truth

_CROP_PX = 180
"""Half the side of the pictures of a failure."""

Record = dict[str, Any]
"""What `Trial.record` returns: JSON."""


@dataclass(slots=True)
class _Attempt:
    at: float
    look: int
    plan: PickPlan
    number: int
    part: int | None
    failed: str = ""


@dataclass(slots=True)
class Trial(Observer):
    """Writes down a run of the simulated cell; give `watch` to the session.

    Args:
        config: The cell's.
        timed: Note what camera, arm and clock do, for a breakdown of the cycle.
    """

    config: CellConfig
    timed: bool = True
    _began: float | None = None
    _truth: Truth | None = None
    _touches: Callable[[], Sequence[Touch]] = lambda: ()
    _disturbed: Callable[[], Sequence[tuple[float, str]]] = lambda: ()
    _holds: list[Record] = field(default_factory=list)
    _nudges: list[Record] = field(default_factory=list)
    _timeline: Timeline = field(default_factory=Timeline)
    _looks: list[Look] = field(default_factory=list)
    _seen: list[Record] = field(default_factory=list)
    _missed: list[Record] = field(default_factory=list)
    _false: int = 0
    _refused: list[Record] = field(default_factory=list)
    _attempts: list[_Attempt] = field(default_factory=list)
    _outcomes: list[Outcome] = field(default_factory=list)

    def watch(self, devices: Devices) -> Sequence[Observer]:
        """Put the watchers before the devices; the observers the run shall tell."""
        assert devices.truth is not None
        # Nobody looks at the portraits of so many cells, and the painter of one takes a tenth of the whole run.
        devices.portrait = None
        self._truth, self._touches, self._disturbed = devices.truth, devices.touches, devices.disturbed
        if not self.timed:
            return (self,)
        self._timeline.watch(devices)
        return (self, self._timeline)

    # --- told by the run ------------------------------------------------------------------------------

    def entered(self, state: State, at: float) -> None:
        """The work begins with the first state."""
        self._began = at if self._began is None else self._began

    def looked(self, look: Look) -> None:
        """Compare every located object with the truth at the moment of the exposure."""
        assert self._truth is not None
        self._looks.append(look)
        parts = self._truth.at(look.frame.captured_at)
        found: set[int] = set()
        for thing in look.located:
            part = nearest(parts, thing)
            if part is None or part.part_id in found:
                self._false += 1
                continue
            found.add(part.part_id)
            error = error_of(part, thing)
            self._seen.append({
                "look": len(self._looks),
                "part": part.part_id,
                "true": str(part.shape),
                "seen": str(thing.shape),
                "x": round(part.center[0], 2),
                "y": round(part.center[1], 2),
                "dx": round(thing.center[0] - part.center[0], 4),
                "dy": round(thing.center[1] - part.center[1], 4),
                "angle_deg": None if error.angle is None else round(math.degrees(error.angle), 4),
                "size_mm": round(max(abs(a - b) for a, b in zip(thing.size, part.size, strict=True)), 4),
                "score": round(thing.detection.score, 3),
                "upright": part.upright,
            })  # fmt: skip
        for detection, reason in look.refused:
            self._refused.append({"look": len(self._looks), "seen": str(detection.shape), "reason": reason})
        table = self.config.table.T_base_table()
        for part in parts:
            if part.place == "table" and part.part_id not in found and self.config.in_work_area(part.center, table):
                self._missed.append({"look": len(self._looks), **_part_json(part)})

    def attempted(self, plan: PickPlan, attempt: int) -> None:
        """Remember the look and the part it aims at; the attempt before, if any, has failed."""
        assert self._truth is not None
        target = plan.target
        part = nearest(self._truth.at(target.detection.frame.captured_at), target)
        at = self._timeline.spans[-1].end if self._timeline.spans else target.detection.frame.captured_at
        part_id = part.part_id if part is not None else None
        self._attempts.append(_Attempt(at, len(self._looks) - 1, plan, attempt, part_id))

    def failed(self, plan: PickPlan, reason: str) -> None:
        """Remember why."""
        self._attempts[-1].failed = reason

    def concluded(self, outcome: Outcome) -> None:
        """Remember the outcome."""
        self._outcomes.append(outcome)

    def nudging(self, plan: NudgePlan) -> None:
        """Remember what is pushed."""
        self._nudges.append({"touches": [len(self._touches())], "moved": str(plan.moved.shape), "by": list(plan.by)})

    def nudged(self, plan: NudgePlan) -> None:
        """What it touched is no collision."""
        self._nudges[-1]["touches"].append(len(self._touches()))

    def held(self, cause: SorterError, at: float) -> None:
        """Remember what the cell held for."""
        self._holds.append({"at_s": round(at, 3), "cause": str(cause)})

    # --- afterwards -----------------------------------------------------------------------------------

    def record(self, figures: Mapping[str, Any]) -> Record:
        """Everything about the run.

        Args:
            figures: The figures of the contract of `controller run --json`.
        """
        assert self._truth is not None
        final = self._truth.now()
        return {
            "figures": dict(figures),
            "seen": self._seen,
            "missed": self._missed,
            "false": self._false,
            "refused": self._refused,
            "parts": [_part_json(part) for part in final],
            "attempts": [
                {
                    "at_s": round(attempt.at, 3),
                    "target": attempt.plan.target.target_id,
                    "part": attempt.part,
                    "attempt": attempt.number,
                    "clearance_mm": round(attempt.plan.grasp.clearance, 2),
                    "failed": attempt.failed,
                }
                for attempt in self._attempts
            ],
            "outcomes": [self._outcome_json(outcome, final) for outcome in self._outcomes],
            "disturbed": [{"at_s": at, "kind": kind} for at, kind in self._disturbed()],
            "holds": self._holds,
            "nudges": self._nudges,
            "touches": [
                {"at_s": round(touch.at, 3), "what": touch.what, "disturbed": self._is_disturbed(touch)}
                for touch in self._collisions()
            ],
            "spans": [asdict(span) for span in self._timeline.spans],
            "failures": self._failures(final),
        }

    def _outcome_json(self, outcome: Outcome, final: Sequence[TruePart]) -> Record:
        part = self._part_of(outcome, final)
        return {
            "result": str(outcome.result),
            "reason": outcome.reason,
            "attempts": outcome.attempts,
            "seen": str(outcome.target.shape),
            "true": str(part.shape) if part is not None else None,
            "bin": outcome.plan.bin.name if outcome.plan is not None else None,
            "place": part.place if part is not None else None,
            "verdict": self._verdict(outcome, part),
            "started_s": round(outcome.started_at, 3),
            "finished_s": round(outcome.finished_at, 3),
        }

    def _part_of(self, outcome: Outcome, final: Sequence[TruePart]) -> TruePart | None:
        assert self._truth is not None
        then = nearest(self._truth.at(outcome.target.detection.frame.captured_at), outcome.target)
        return None if then is None else next(part for part in final if part.part_id == then.part_id)

    def _belongs_there(self, outcome: Outcome, part: TruePart | None) -> bool:
        """Whether the rules want a part in the bin it was taken to."""
        right = right_bin(self.config, part) if part is not None else None
        return outcome.plan is not None and outcome.plan.bin.name == right

    def _verdict(self, outcome: Outcome, part: TruePart | None) -> str:
        if outcome.result is not Result.PLACED:
            return str(outcome.result)
        if part is None or part.place not in {bin_.name for bin_ in self.config.bins}:
            return "silent"
        return "correct" if part.place == right_bin(self.config, part) else "missorted"

    # --- what went wrong ------------------------------------------------------------------------------

    def _failures(self, final: Sequence[TruePart]) -> list[Record]:
        found = [
            self._failure("attempt failed", a.failed, a.at, a.look, a.plan.target.detection.center_px)
            for a in self._attempts
            if a.failed
        ]
        for outcome in self._outcomes:
            part = self._part_of(outcome, final)
            verdict = self._verdict(outcome, part)
            if verdict == "correct" or (outcome.result is Result.REJECTED and self._belongs_there(outcome, part)):
                continue
            frame = outcome.target.detection.frame
            look = next((i for i, look in enumerate(self._looks) if look.frame is frame), len(self._looks) - 1)
            center = outcome.target.detection.center_px
            found.append(self._failure(verdict, outcome.reason, outcome.finished_at, look, center))
        found += [self._touch(touch.at, touch.what) for touch in self._collisions()]
        if self._looks:
            last = len(self._looks) - 1
            at = self._looks[last].frame.captured_at
            for part in final:
                if part.place in ("table", "floor", "gripper"):
                    text = f"{part.shape} at {part.center[0]:.0f}, {part.center[1]:.0f} mm"
                    text += "" if part.upright else ", toppled"
                    text += "" if part.reachable else ", out of reach from the start"
                    found.append(self._failure(f"left: {part.place}", text, at, last, self._pixel(part.center)))
        return sorted(found, key=lambda failure: float(failure["at_s"]))

    def _collisions(self) -> list[Touch]:
        """Touches that were not meant."""
        touches = self._touches()
        meant = {n for nudge in self._nudges for n in range(*[*nudge["touches"], len(touches)][:2])}
        return [touch for number, touch in enumerate(touches) if number not in meant]

    def _is_disturbed(self, touch: Touch) -> bool:
        """A disturbance has moved what was touched after the picture by which the arm moved."""
        attempt = self._attempt_at(touch.at)
        if attempt is None or touch.disturbed is None:
            return False
        return touch.disturbed > attempt.plan.target.detection.frame.captured_at

    def _attempt_at(self, at: float) -> _Attempt | None:
        return next((a for a in reversed(self._attempts) if a.at <= at), None)

    def _touch(self, at: float, what: str) -> Record:
        attempt = self._attempt_at(at)
        if attempt is None:
            return self._failure("collision", what, at, 0, None)
        center = attempt.plan.target.detection.center_px
        what += f" while at work on the {attempt.plan.target.shape} {attempt.plan.target.target_id}"
        return self._failure("collision", what, at, attempt.look, center)

    def _failure(self, kind: str, text: str, at: float, look: int, center: Point | None) -> Record:
        after = min(look + 1, len(self._looks) - 1)
        pictures = {}
        if self._looks:
            pictures["before"] = _jpeg(_crop(annotated(self._looks[look]), center))
            if after != look:
                pictures["after"] = _jpeg(_crop(annotated(self._looks[after]), center))
        # Since the work began, as `controller run` tells it.
        return {"kind": kind, "text": text, "at_s": round(at - (self._began or 0.0), 3), **pictures}

    def _pixel(self, center: Point) -> Point | None:
        """About where a point of the table lies in the picture, from the objects that were located."""
        pairs = [(thing.center, thing.detection.center_px) for look in self._looks for thing in look.located]
        if len(pairs) < 3:
            return None
        here = np.array([[*mm, 1.0] for mm, _ in pairs])
        fit, _, rank, _ = np.linalg.lstsq(here, np.array([px for _, px in pairs]), rcond=None)
        if rank < 3:
            return None
        u, v = np.array([*center, 1.0]) @ fit
        return float(u), float(v)


def _part_json(part: TruePart) -> Record:
    return {
        "part": part.part_id,
        "shape": str(part.shape),
        "colour": part.colour,
        "size_mm": [round(side, 2) for side in part.size],
        "x": round(part.center[0], 1),
        "y": round(part.center[1], 1),
        "upright": part.upright,
        "place": part.place,
        "reachable": part.reachable,
    }


def _crop(picture: NDArray[np.uint8], center: Point | None) -> NDArray[np.uint8]:
    """The surroundings of a place, or the whole picture at half its size."""
    if center is None:
        return np.asarray(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
    side = 2 * _CROP_PX
    height, width = picture.shape[:2]
    u = min(max(round(center[0]) - _CROP_PX, 0), max(width - side, 0))
    v = min(max(round(center[1]) - _CROP_PX, 0), max(height - side, 0))
    return picture[v : v + side, u : u + side]


def _jpeg(picture: NDArray[np.uint8]) -> str:
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return base64.b64encode(data.tobytes()).decode()

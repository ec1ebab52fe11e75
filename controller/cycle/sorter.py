"""The sorting cycle at work: one handler a state, each returns the trigger of the next transition.

Reading order is the walk of the data: capture, detect, localize, pick, place. Motion happens only between
`started` and `stopped`; every target tried gets exactly one outcome, whatever happens on the way.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from controller.cycle import proof
from controller.cycle.concerns import GOOD_SUPPLY, LOW_SUPPLY, SLOW, Concerns
from controller.cycle.holding import RELEASES, SLICE, Hold
from controller.cycle.machine import CellMachine, State
from controller.cycle.rig import Look, Rig
from controller.cycle.stock import Stock
from controller.cycle.targets import Target, TargetBook
from controller.cycle.view import MARGIN_MM, region_mask
from controller.domain import (
    Frame,
    Grasp,
    LocatedObject,
    MoveReport,
    Outcome,
    PickPlan,
    Result,
    Shape,
    Trajectory,
)
from controller.errors import ArmError, CameraEnded, CameraError, LedgerError, PartHeld, PlanError, SorterError
from controller.localization.locate import locate
from controller.vision.detect import Detected, detect

_FALL_MM = 8.0
"""The planner lets a part fall this far: what lies below the jaws when they have opened is that much lower."""


class _Interrupted(Exception):
    """A move was ended by a stop request."""


class Sorter:
    """Runs the cycle on a rig until it is stopped, faulted, or (when asked) nothing is left to pick.

    Attributes:
        machine: The cell's state.
        fault: The first fault, or None.
        left: Objects seen by the last look and not dealt with since.
        cycle_times: From look to retreat, s, one for every part taken to a bin.

    Args:
        rig: The cell.
        until_empty: Stop when the table is empty or nothing on it can be picked.
        most_parts: Stop after so many parts were dealt with; None for no limit.
        filled: Parts in each bin already, by name; counted up as they are placed.
        target_prefix: Makes the ids of this sorter's targets unique within a run of the ledger.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        until_empty: bool = False,
        most_parts: int | None = None,
        filled: Counter[str] | None = None,
        target_prefix: str = "t",
    ) -> None:
        self.rig = rig
        self.machine = CellMachine()
        self.fault: SorterError | None = None
        self.left = 0
        self.cycle_times: list[float] = []
        self._until_empty = until_empty
        self._most_parts = most_parts
        self._book = TargetBook(target_prefix)
        self._filled = Counter() if filled is None else filled
        self._energised = False
        self._concluded = 0
        self._stop = threading.Event()
        self._pause = threading.Event()
        self._holding: Target | None = None
        self._frame: Frame | None = None
        self._detected: Detected | None = None
        self._queue: list[LocatedObject] = []
        self._others: tuple[LocatedObject, ...] = ()
        self._cycle_started = 0.0
        self._last_motion = 0.0
        self._retreat: Trajectory | None = None
        self._placed_height = 0.0
        self._held: Hold | None = None
        self._go_on = threading.Event()
        self._unwritten: list[Outcome] = []
        self._concerns = Concerns(rig)
        self._picks_from_look = 0
        self._next_rig: Rig | None = None
        self._adopt(rig)
        self._handlers: dict[State, Callable[[], str]] = {
            State.HOMING: self._home,
            State.CAPTURE: self._capture,
            State.DETECT: self._detect,
            State.LOCALIZE: self._localize,
            State.PICK: self._pick,
            State.PLACE: self._place,
            State.IDLE: self._idle,
            State.HELD: self._hold,
        }

    def _adopt(self, rig: Rig) -> None:
        """Take over a rig, and what follows from its configuration."""
        self.rig, self._next_rig = rig, None
        self._planner = rig.planner
        self._stock = Stock(rig.config, self._filled)
        self._plane = rig.calibration.plane(_typical_half_height(rig))
        self._region: NDArray[np.uint8] | None = None
        self._view = rig.config.work_area_outline(rig.calibration.T_base_table, MARGIN_MM)

    # --- from outside ---------------------------------------------------------------------------------

    def request_stop(self) -> None:
        """Stop along the path, park and let go of the torque; from any thread or signal handler."""
        self._stop.set()
        self.rig.arm.request_stop()

    def request_pause(self) -> None:
        """Hold before the next look; from any thread."""
        self._pause.set()

    def resume(self) -> None:
        """Go on after `request_pause`, or when the part that stuck to the jaws is gone; from any thread."""
        self._pause.clear()
        self._go_on.set()

    def change(self, rig: Rig) -> None:
        """Work with another configuration from the next look on; from any thread.

        Args:
            rig: The same devices, record and observers.
        """
        self._next_rig = rig

    def run(self) -> None:
        """Sort. Moves metal, blocks until the cell is STOPPED or FAULT."""
        self._fire("started")
        while self.machine.state not in (State.STOPPED, State.FAULT):
            try:
                trigger = self._work()
            except (_Interrupted, CameraEnded):
                trigger = "stopped"
            except (CameraError, LedgerError, PartHeld) as error:
                trigger = self._hold_for(error)
            except SorterError as error:
                trigger = self._latch(error)
            except BaseException:
                self._settle("the controller failed")
                self._come_to_rest()
                raise
            if trigger == "stopped":
                trigger = self._shut_down()
            self._fire(trigger)
        self._conclude_open()

    def _work(self) -> str:
        """Do what the state asks for; nothing new begins before what has happened is on record."""
        if self._stop.is_set():
            return "stopped"
        if self.machine.state is not State.HELD:
            self._write_outcomes()
        return self._handlers[self.machine.state]()

    # --- the states -----------------------------------------------------------------------------------

    def _home(self) -> str:
        state = self.rig.arm.energise()
        self._energised = True
        target = self._holding
        if target is not None and target.plan is not None:
            self._let_go(target.plan.grasp)
            self._holding = None
            self._conclude(target, Result.INDETERMINATE, "it stuck to the jaws over the bin, until somebody helped")
            self._overcome(PartHeld)
        self._follow(self._planner.home(state.positions))
        return "homed"

    def _capture(self) -> str:
        if self._pause.is_set():
            self._step_back()
            return "held"
        if self._most_parts is not None and self._concluded >= self._most_parts:
            return "stopped"
        if self._next_rig is not None:
            self._adopt(self._next_rig)
        if self._retreat is not None and not self._view_is_clear():
            self._step_back()
        if self._retreat is None:
            self._cycle_started = self.rig.clock.now()
        self._frame = self.rig.camera.capture(self._last_motion, self.rig.config.camera.frame_timeout_s)
        self._overcome(CameraError)
        self._picks_from_look = 0
        return "captured"

    def _detect(self) -> str:
        assert self._frame is not None
        if self._region is None or self._region.shape != self._frame.image.shape[:2]:
            self._region = region_mask(self.rig.config, self.rig.calibration, self._frame.size)
        self._detected = detect(
            self._frame, self.rig.recipe, plane=self._plane, region=self._region, classes=self.rig.classes
        )
        self.rig.clock.charge(self.rig.config.cycle.vision_budget_s)
        return "detected"

    def _localize(self) -> str:
        assert self._frame is not None
        assert self._detected is not None
        config = self.rig.config
        found = locate(self._detected.detections, self.rig.calibration, config.part_height)
        things = [thing for thing in found.objects if thing.size[0] >= config.vision.smallest_mm]
        named, gone = self._book.identify(things)
        for target in gone:
            self._give_up(target)
        look = Look(self._frame, self._detected.detections, tuple(named), found.refused)
        for observer in self.rig.observers:
            observer.looked(look)
        self._others = (*named, *found.in_the_way)
        self._queue = self._candidates(named)
        self.left = len(named) + len(found.refused)
        self._note_concerns(named)
        return "located" if self._queue else "emptied"

    def _pick(self) -> str:
        candidates = list(self._queue)
        chosen = self._plan_next()
        if chosen is None and self._retreat is not None:
            # From deep in a bin there may be no way where there is one from above it.
            self._step_back()
            self._queue = candidates
            chosen = self._plan_next()
        if chosen is None:
            return "emptied"
        target, plan = chosen
        for observer in self.rig.observers:
            observer.planned(plan)
        if not self.rig.confirm(plan):
            self._conclude(target, Result.SKIPPED, "refused by the operator")
            return "missed"
        self.rig.ledger.intend(target.target_id, plan, target.attempts + 1, self.rig.clock.now())
        self._overcome(LedgerError)
        target.attempts += 1
        for observer in self.rig.observers:
            observer.attempted(plan, target.attempts)
        self._holding = target
        out_of_bin = self._planner.rise_time(plan.approach, self._climb) if self._climb else 0.0
        self._retreat = None
        arrival = self._follow(plan.approach, plan.grasp.opening, out_of_bin)
        refusal = proof.obstruction(arrival, plan.approach)
        if refusal is None:
            report = self.rig.arm.grip(proof.closing_target(plan.grasp, self.rig.arm.description.gripper))
            self._moved(report.finished)
            refusal = proof.refusal(report, plan.grasp)
            if refusal is None:
                return "picked"
        self._holding = None
        target.reason = refusal
        for observer in self.rig.observers:
            observer.failed(plan, refusal)
        self._grip(plan.grasp.opening)
        self._follow(self._planner.home(self.rig.arm.state().positions))
        if target.attempts >= self.rig.config.cycle.attempts:
            self._conclude(target, Result.GRASP_MISSED, refusal)
        return "missed"

    def _place(self) -> str:
        target = self._holding
        assert target is not None
        assert target.plan is not None
        plan = target.plan
        self._follow(plan.carry)
        dropped = proof.lost(self.rig.arm.state(), plan.grasp)
        self._let_go(plan.grasp)
        self._retreat, self._placed_height = plan.retreat, target.located.height
        self._holding = None
        if dropped is not None:
            target.lost, target.reason = True, dropped
            for observer in self.rig.observers:
                observer.failed(plan, dropped)
            if target.attempts >= self.rig.config.cycle.attempts:
                self._conclude(target, Result.DROPPED, dropped)
        else:
            self.left -= 1
            self._stock.placed(plan.bin)
            rejected = plan.bin.name == self.rig.config.sorting.otherwise
            self._conclude(target, Result.REJECTED if rejected else Result.PLACED, f"in {plan.bin.name}")
        self.cycle_times.append(self.rig.clock.now() - self._cycle_started)
        self._cycle_started = self.rig.clock.now()
        self._picks_from_look += 1
        if self._queue and self._picks_from_look < self.rig.config.cycle.picks_per_look and dropped is None:
            return "continued"
        return "placed"

    def _idle(self) -> str:
        self._overcome(LedgerError)
        self._step_back()
        if self._until_empty:
            return "stopped"
        if self.rig.config.cycle.idle_look_s > 0:
            self.rig.clock.sleep(self.rig.config.cycle.idle_look_s)
        return "woken"

    def _hold(self) -> str:
        held = self._held
        if held is not None and isinstance(held.cause, PartHeld):
            return self._wait_for_help(held)
        if self._pause.is_set() or (held is not None and self.rig.clock.now() < held.next_try):
            self.rig.clock.sleep(SLICE)
            return "held_on"
        if held is not None and isinstance(held.cause, CameraError):
            self.rig.camera.close()
            self.rig.camera.open()
        elif held is not None:
            self._write_outcomes()
            self.rig.ledger.note("resumed", self.rig.clock.now(), held_s=self.rig.clock.now() - held.since)
        return "resumed"

    def _wait_for_help(self, held: Hold) -> str:
        """Nothing opens the jaws again before somebody who has looked says so."""
        if self._go_on.is_set():
            self._go_on.clear()
            return "rehomed"
        held.next_try = self.rig.clock.now()
        if self._until_empty and held.too_long:
            return self._latch(held.cause)
        self.rig.clock.sleep(SLICE)
        return "held_on"

    def _note_concerns(self, seen: Sequence[LocatedObject]) -> None:
        """Warn of what is not in order, and move slowly while the supply is weak."""
        found = dict(self.rig.concerns())
        if waiting := self._stock.waited_for(seen):
            found["bin_full"] = "; ".join(f"{name} is full, {count} parts wait" for name, count in waiting.items())
        voltage, weak = self.rig.arm.state().voltage, "supply_low" in self._concerns
        if voltage is not None and voltage < (GOOD_SUPPLY if weak else LOW_SUPPLY):
            found["supply_low"] = f"{voltage:.1f} V at the servos"
        self._concerns.update(found)
        self._planner = self.rig.planner.slowed(SLOW) if "supply_low" in found else self.rig.planner

    # --- choosing -------------------------------------------------------------------------------------

    def _candidates(self, located: list[LocatedObject]) -> list[LocatedObject]:
        """What may be picked now, the surest first: old acquaintances last, then by confidence.

        What has no name comes after all that has one: two parts that touch may look like one of no known shape,
        until the other is gone.
        """
        config = self.rig.config
        tried = {target.target_id: target.attempts for target in self._book.open}
        wanted = [
            thing
            for thing in located
            if thing.detection.score >= config.vision.minimum_score
            and "cut_by_border" not in thing.detection.flags
            and not self._book.is_given_up(thing)
            and config.in_work_area(thing.center, self.rig.calibration.T_base_table)
            and self._stock.bin_for(thing) is not None
        ]

        def rank(thing: LocatedObject) -> tuple[int, bool, float]:
            return tried.get(thing.target_id, 0), thing.shape is Shape.OTHER, -thing.detection.score

        return sorted(wanted, key=rank)

    def _plan_next(self) -> tuple[Target, PickPlan] | None:
        """The first candidate that a safe plan exists for."""
        start = self.rig.arm.state().positions
        while self._queue:
            thing = self._queue.pop(0)
            bin_ = self._stock.bin_for(thing)
            if bin_ is None:
                continue
            others = tuple(other for other in self._others if other.detection is not thing.detection)
            self.rig.clock.charge(self.rig.config.cycle.planning_budget_s)
            try:
                plan = self._planner.plan_pick(
                    thing, others, bin_, self._stock.drop_point(bin_), start,
                    pile=self._stock.pile(bin_), view=self._view, climb=self._climb,
                )  # fmt: skip
            except PlanError as error:
                self.rig.ledger.note("unplannable", self.rig.clock.now(), center=thing.center, reason=str(error))
                continue
            target = self._book.choose(thing, self.rig.clock.now())
            target.plan = plan
            self._others = others
            return target, plan
        return None

    # --- motion ---------------------------------------------------------------------------------------

    def _view_is_clear(self) -> bool:
        """Whether the camera sees the work area past the arm as it stands over a bin."""
        return self._planner.leaves_view_clear(self.rig.arm.state().positions, self._view)

    def _step_back(self) -> None:
        """Carry out the retreat that is due since the last part was let go, if it is."""
        if self._retreat is not None:
            retreat, self._retreat = self._retreat, None
            self._follow(retreat)

    @property
    def _climb(self) -> float:
        """How far the arm must go straight up before it may turn or open its jaws further, mm: out of the bin that
        it stands in, past the part it has just let go.
        """
        return 0.0 if self._retreat is None else self._placed_height + _FALL_MM

    def _follow(self, trajectory: Trajectory, opening: float | None = None, after: float = 0.0) -> MoveReport:
        report = self.rig.arm.follow(trajectory, opening, after)
        self._moved(report.finished)
        return report

    def _grip(self, opening: float) -> None:
        self._moved(self.rig.arm.grip(opening).finished)

    def _let_go(self, grasp: Grasp) -> None:
        """Open the jaws, and again if they keep what is between them.

        Raises:
            PartHeld: They still do.
        """
        for _ in range(RELEASES):
            report = self.rig.arm.grip(grasp.opening)
            self._moved(report.finished)
            kept = proof.kept(report, grasp)
            if kept is None:
                return
        arm = self.rig.arm.description.name
        raise PartHeld(arm, "let go", kept or "", "take the part out of the jaws, then controller resume")

    def _moved(self, finished: bool) -> None:
        self._last_motion = self.rig.clock.now()
        if not finished:
            raise _Interrupted

    def _shut_down(self) -> str:
        """Park and let go of the torque; the trigger says whether that went well."""
        try:
            if self._holding is not None:
                self._conclude(self._holding, Result.ABORTED, "stopped while the arm was at work on it")
                self._holding = None
            self._park()
        except SorterError as error:
            return self._latch(error)
        return "stopped"

    def _park(self) -> None:
        """Bring the arm to rest and let go of the torque; leaves an arm alone that was never energised."""
        if not self._energised:
            return
        self.rig.arm.clear_stop()
        if self.rig.arm.follow(self._planner.park(self.rig.arm.state().positions)).finished:
            self.rig.arm.relax()

    def _settle(self, reason: str) -> None:
        """Nobody knows any more what becomes of the part that the arm was at work on."""
        if self._holding is not None:
            self._conclude(self._holding, Result.INDETERMINATE, reason)
            self._holding = None

    def _come_to_rest(self) -> None:
        """Park and let go of the torque when the arm still does as it is told, else leave it holding."""
        try:
            self._park()
        except SorterError as error:
            self._try_note("park_failed", reason=str(error))

    # --- holds and faults -----------------------------------------------------------------------------

    def _hold_for(self, error: SorterError) -> str:
        """Hold for something that may pass; where nobody operates the cell, not for ever."""
        now = self.rig.clock.now()
        known = self._held is not None and type(self._held.cause) is type(error)
        self._held = self._held or Hold(error, now)
        self._held.failed(error, now)
        self._go_on.clear()
        if not known:
            for observer in self.rig.observers:
                observer.held(error, now)
        if self._until_empty and self._held.too_long:
            return self._latch(error)
        return "held_on" if self.machine.state is State.HELD else "held"

    def _overcome(self, kind: type[SorterError]) -> None:
        """What the cell held for works again."""
        if self._held is not None and isinstance(self._held.cause, kind):
            self._held = None
            for observer in self.rig.observers:
                observer.resumed(self.rig.clock.now())

    def _latch(self, error: SorterError) -> str:
        """Keep the first fault and bring the arm to rest; after one of the arm's own it is left holding still."""
        if self.fault is None:
            self.fault = error
            self._settle(f"fault: {error}")
            for observer in self.rig.observers:
                observer.faulted(error, self.rig.clock.now())
            if not isinstance(error, ArmError):
                self._come_to_rest()
        return "faulted"

    # --- outcomes -------------------------------------------------------------------------------------

    def _conclude(self, target: Target, result: Result, reason: str) -> None:
        now = self.rig.clock.now()
        outcome = Outcome(target.located, target.plan, result, reason, target.attempts, target.started_at, now)
        if result in (Result.GRASP_MISSED, Result.SKIPPED):
            self._book.give_up(target)
        else:
            self._book.close(target)
        self._concluded += 1
        self._unwritten.append(outcome)
        # What cannot be written now is kept, and holds the cell before anything new begins.
        with suppress(LedgerError):
            self._write_outcomes()

    def _write_outcomes(self) -> None:
        """Put on record what is not yet there, and tell it. Raises LedgerError."""
        while self._unwritten:
            self.rig.ledger.conclude(self._unwritten[0])
            outcome = self._unwritten.pop(0)
            for observer in self.rig.observers:
                observer.concluded(outcome)

    def _try_note(self, kind: str, **details: object) -> None:
        """Note it if the ledger can take it; if not, the next intent will hold the cell."""
        with suppress(LedgerError):
            self.rig.ledger.note(kind, self.rig.clock.now(), **details)

    def _give_up(self, target: Target) -> None:
        """A target that was tried and is nowhere to be seen."""
        if target.lost:
            self._conclude(target, Result.DROPPED, target.reason)
        else:
            self._conclude(target, Result.INDETERMINATE, f"gone after a missed grasp ({target.reason})")

    def _conclude_open(self) -> None:
        for target in self._book.open:
            if target.attempts:
                result = Result.DROPPED if target.lost else Result.GRASP_MISSED
                self._conclude(target, result, target.reason or "the run ended before the next attempt")
        try:
            self._write_outcomes()
        except LedgerError as error:
            if self.fault is None:
                self._fire(self._latch(error))

    def _fire(self, trigger: str) -> None:
        if trigger == "held_on":
            return
        state = self.machine.fire(trigger)
        for observer in self.rig.observers:
            observer.entered(state, self.rig.clock.now())


def _typical_half_height(rig: Rig) -> float:
    heights = [part.height_mm for part in rig.config.parts] or [rig.config.default_part.height_mm]
    return float(np.mean(heights)) / 2.0

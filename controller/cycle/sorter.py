"""The sorting cycle at work: one handler a state, each returns the trigger of the next transition.

Reading order is the walk of the data: capture, detect, localize, pick, place; then what holds the cell and what ends
it. Motion happens only between `started` and `stopped`; every target tried gets exactly one outcome, whatever happens
on the way.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress

from controller.cycle import proof
from controller.cycle.choice import Chooser
from controller.cycle.concerns import Concerns
from controller.cycle.holding import Holding
from controller.cycle.looking import Looker
from controller.cycle.machine import CellMachine, State
from controller.cycle.memory import Memory
from controller.cycle.motions import Interrupted, Motions
from controller.cycle.outcomes import Outcomes
from controller.cycle.requests import Requests
from controller.cycle.rig import Look, Rig
from controller.cycle.stock import Stock
from controller.cycle.targets import Target, TargetBook
from controller.cycle.view import MARGIN_MM
from controller.domain import Frame, PickPlan, Result
from controller.errors import (
    ArmError,
    CameraEnded,
    CameraError,
    Intruder,
    LedgerError,
    PartHeld,
    SorterError,
)
from controller.vision.detect import Detected

_LOOKS_AGAIN = (State.CAPTURE, State.DETECT, State.LOCALIZE, State.PICK, State.IDLE)
"""States that do not begin after a pause before a new look: somebody may have changed the table."""


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
        self._next_rig: Rig | None = None
        self.machine = CellMachine()
        self.fault: SorterError | None = None
        self.left = 0
        self.cycle_times: list[float] = []
        self._until_empty = until_empty
        self._most_parts = most_parts
        self._filled = Counter() if filled is None else filled
        self._book = TargetBook(target_prefix)
        self._motions = Motions(rig)
        self._outcomes = Outcomes(rig, self._book)
        self._concerns = Concerns(rig)
        self._requests = Requests(rig.arm)
        self._holding = Holding(rig, self._requests, self._outcomes, operated=not until_empty)
        self._adopt(rig)
        self._gripped: Target | None = None
        self._frame: Frame | None = None
        self._detected: Detected | None = None
        self._cycle_started = 0.0
        self._picks_from_look = 0
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
        view = rig.config.work_area_outline(rig.calibration.T_base_table, MARGIN_MM)
        self._stock = Stock(rig.config, self._filled)
        self._motions.adopt(rig, view)
        self._holding.adopt(rig)
        self._looker = Looker(rig, self._motions.pose_at)
        self._memory = Memory()
        self._chooser = Chooser(rig, self._book, self._stock, view)

    # --- from outside ---------------------------------------------------------------------------------

    def request_stop(self) -> None:
        """Stop along the path, park and let go of the torque; from any thread or signal handler."""
        self._requests.stop()

    def request_pause(self) -> None:
        """Hold on the path of the move under way, else before the next; from any thread. A stop ends it."""
        self._requests.pause()

    @property
    def holds(self) -> bool:
        """A pause is in force and the arm stands; from any thread."""
        return self._requests.stands

    def resume(self) -> None:
        """Go on after `request_pause`, or when what somebody has to put right is put right; from any thread."""
        self._requests.resume()

    def change(self, rig: Rig) -> None:
        """Work with another configuration from the next look on; from any thread.

        Args:
            rig: The same devices, record and observers.
        """
        self._next_rig = rig

    def run(self) -> None:
        """Sort. Moves metal, blocks until the cell is STOPPED or FAULT."""
        try:
            self._run()
        except BaseException:
            try:
                self._settle("the controller failed")
            finally:
                if self._may_park(self.fault):
                    self._come_to_rest()
            raise
        finally:
            self._requests.end_pause()
            self._looker.close()

    def _run(self) -> None:
        self._fire("started")
        while self.machine.state not in (State.STOPPED, State.FAULT):
            try:
                trigger = self._work()
            except (Interrupted, CameraEnded):
                trigger = "stopped"
            except (CameraError, LedgerError, PartHeld, Intruder) as error:
                trigger = self._hold_for(error)
            except SorterError as error:
                trigger = self._latch(error)
            if trigger == "stopped":
                trigger = self._shut_down()
            self._fire(trigger)
        try:
            self._outcomes.conclude_open()
        except LedgerError as error:
            if self.fault is None:
                self._fire(self._latch(error))

    def _work(self) -> str:
        """Do what the state asks for; nothing new begins before what has happened is on record."""
        if self._requests.stopped:
            return "stopped"
        if self.machine.state is not State.HELD:
            self._outcomes.write()
        if self._requests.was_paused and self.machine.state in _LOOKS_AGAIN:
            self._requests.took_pause()
            self._looker.forget()
            return "held"
        return self._handlers[self.machine.state]()

    def _fire(self, trigger: str) -> None:
        if trigger == "held_on":
            return
        state = self.machine.fire(trigger)
        for observer in self.rig.observers:
            observer.entered(state, self.rig.clock.now())

    # --- the states at work ---------------------------------------------------------------------------

    def _home(self) -> str:
        self._motions.start()
        target = self._gripped
        if target is not None and target.plan is not None:
            self._motions.let_go(target.plan.grasp)
            self._gripped = None
            reason = "it stuck to the jaws over the bin, until somebody helped"
            self._outcomes.conclude(target, Result.INDETERMINATE, reason)
            self._holding.overcome(PartHeld)
        self._motions.home()
        return "homed"

    def _capture(self) -> str:
        if self._next_rig is not None:
            self._looker.close()
            self._adopt(self._next_rig)
        if self._most_parts is not None and self._outcomes.concluded >= self._most_parts:
            return "stopped"
        motions = self._motions
        if not self._looker.is_ahead and motions.retreat is not None and not motions.view_is_clear():
            motions.step_back()
        if motions.retreat is None:
            self._cycle_started = self.rig.clock.now()
        self._frame = self._looker.capture(motions.last)
        self._holding.overcome(CameraError)
        self._picks_from_look = 0
        return "captured"

    def _detect(self) -> str:
        assert self._frame is not None
        self._detected = self._looker.detect(self._frame)
        return "detected"

    def _localize(self) -> str:
        assert self._frame is not None
        assert self._detected is not None
        found, things = self._looker.locate(self._detected)
        named, gone = self._book.identify(things)
        for target in gone:
            self._outcomes.give_up(target)
        look = Look(self._frame, self._detected.detections, tuple(named), found.refused)
        for observer in self.rig.observers:
            observer.looked(look)
        in_the_way = (*found.in_the_way, *self._memory.look((*things, *found.in_the_way), self._frame))
        self._chooser.offer(named, in_the_way, self._motions.positions, self._outcomes.concluded)
        self.left = len(named) + len(found.refused)
        self._motions.planner = self._concerns.review(named, self._stock)
        return "located" if self._chooser.queue else self._emptied()

    def _pick(self) -> str:
        chosen = self._next()
        if chosen is None and self._motions.retreat is not None:
            # From deep in a bin there may be no way where there is one from above it.
            self._motions.step_back()
            self._chooser.anew()
            chosen = self._next()
        if chosen is None and not self._motions.planner.turns_jaws:
            self._chooser.anew()
            chosen = self._next(corners=True)
        if chosen is None:
            return "nudged" if self._nudge() else self._emptied()
        target, plan = chosen
        for observer in self.rig.observers:
            observer.planned(plan)
        if not self.rig.confirm(plan):
            self._outcomes.conclude(target, Result.SKIPPED, "refused by the operator")
            return "missed"
        self.rig.ledger.intend(target.target_id, plan, target.attempts + 1, self.rig.clock.now())
        self._holding.overcome(LedgerError)
        target.attempts += 1
        for observer in self.rig.observers:
            observer.attempted(plan, target.attempts)
        self._gripped = target
        refusal = self._motions.take(plan, proved=self.rig.pick_proof)
        return "picked" if refusal is None else self._missed(target, plan, refusal)

    def _place(self) -> str:
        target = self._gripped
        assert target is not None
        assert target.plan is not None
        plan = target.plan
        arrival = self._motions.follow(plan.carry)
        dropped = proof.lost(arrival.state, plan.grasp) if self.rig.pick_proof else None
        self._look_ahead(plan)
        mistaken = dropped is None and self.rig.pick_proof and self._looker.shows_still(plan.target.detection)
        if mistaken:
            plan = self._divert(target, plan)
        self._motions.let_go(plan.grasp)
        self._motions.released(plan.retreat, target.located.height)
        self._gripped = None
        if dropped is not None:
            target.lost, target.reason = True, dropped
            for observer in self.rig.observers:
                observer.failed(plan, dropped)
            if target.attempts >= self.rig.config.cycle.attempts:
                self._outcomes.conclude(target, Result.DROPPED, dropped)
        else:
            self.left -= not mistaken
            self._stock.placed(plan.bin, target.located)
            rejected = plan.bin.name == self.rig.config.sorting.otherwise
            result = Result.REJECTED if rejected else Result.PLACED
            what = "; not what was to be taken, which still lies there" if mistaken else ""
            self._outcomes.conclude(target, result, f"in {plan.bin.name}{what}")
        self.cycle_times.append(self.rig.clock.now() - self._cycle_started)
        self._cycle_started = self.rig.clock.now()
        self._picks_from_look += 1
        if self._chooser.queue and self._picks_from_look < self.rig.config.cycle.picks_per_look and dropped is None:
            return "continued"
        return "placed"

    def _idle(self) -> str:
        self._holding.overcome(LedgerError)
        self._motions.step_back()
        if self._until_empty:
            return "stopped"
        if self.rig.config.cycle.idle_look_s > 0:
            self.rig.clock.sleep(self.rig.config.cycle.idle_look_s)
        return "woken"

    # --- parts of them --------------------------------------------------------------------------------

    def _next(self, corners: bool = False) -> tuple[Target, PickPlan] | None:
        motions = self._motions
        return self._chooser.next(motions.planner, self.rig.arm.state().positions, motions.climb, corners)

    def _emptied(self) -> str:
        """Nothing more can be picked now: what rested until something has changed has waited for nothing.

        Unless the look has overlooked something: then another one has the say.
        """
        if self._memory.overlooked:
            self._memory.forget()
            return "unsure"
        for target in self._book.resting:
            self._outcomes.conclude(target, Result.GRASP_MISSED, target.reason)
        return "emptied"

    def _nudge(self) -> bool:
        """Push a part or its neighbour so that the jaws find room at the next look; False when no push helps."""
        motions = self._motions
        chosen = self._chooser.nudge(motions.planner, self.rig.arm.state().positions, motions.climb)
        if chosen is None:
            return False
        _, plan = chosen
        self.rig.ledger.note("nudge", self.rig.clock.now(), center=plan.moved.center, by=plan.by)
        self._holding.overcome(LedgerError)
        for observer in self.rig.observers:
            observer.nudging(plan)
        motions.push(plan)
        for observer in self.rig.observers:
            observer.nudged(plan)
        return True

    def _divert(self, target: Target, plan: PickPlan) -> PickPlan:
        """Take what is not what the jaws were sent for on to the rejects, and come to stand over them.

        Raises:
            PartHeld: There is no such bin, or it is full.
        """
        rejects, motions = self._stock.rejects(), self._motions
        if rejects is None:
            cause = "the jaws hold something else than the part they were sent for"
            raise PartHeld(
                self.rig.arm.description.name, "place", cause, "take it out of the jaws, then controller resume"
            )
        if rejects.name == plan.bin.name:
            return plan
        target.plan = motions.planner.plan_diverted(
            plan, rejects, self._stock.drop_point(rejects), self.rig.arm.state().positions,
            pile=self._stock.pile(rejects), view=motions.view,
        )  # fmt: skip
        motions.follow(target.plan.carry)
        return target.plan

    def _missed(self, target: Target, plan: PickPlan, refusal: str) -> str:
        """Let go of whatever it is, and go where the camera sees all."""
        self._gripped = None
        target.reason = refusal
        for observer in self.rig.observers:
            observer.failed(plan, refusal)
        self._motions.grip(plan.grasp.opening)
        self._motions.home()
        if not self._book.rests(target, self.rig.config.cycle.attempts, self._outcomes.concluded):
            self._outcomes.conclude(target, Result.GRASP_MISSED, refusal)
        return "missed"

    def _look_ahead(self, plan: PickPlan) -> None:
        """Begin the next look, when the camera sees past the arm and somebody will want it."""
        if self.rig.config.cycle.picks_per_look > 1 or self._requests.paused:
            return
        since = self._motions.clear_from(plan.carry)
        if since is not None:
            self._looker.look_ahead(since)

    # --- holding: what may pass, or what somebody has to put right --------------------------------------

    def _hold_for(self, error: SorterError) -> str:
        """Hold for something that may pass; where nobody operates the cell, not for ever."""
        self._looker.forget()
        try:
            self._holding.failed(error)
        except SorterError as lasting:
            return self._latch(lasting)
        return "held_on" if self.machine.state is State.HELD else "held"

    def _hold(self) -> str:
        return self._holding.step(self._looker)

    # --- the end --------------------------------------------------------------------------------------

    def _latch(self, error: SorterError) -> str:
        """Keep the first fault, and bring the arm to rest if it may move."""
        if self.fault is None:
            self.fault = error
            self._settle(f"fault: {error}")
            for observer in self.rig.observers:
                observer.faulted(error, self.rig.clock.now())
            if self._may_park(error):
                self._come_to_rest()
        return "faulted"

    def _may_park(self, fault: SorterError | None) -> bool:
        """Not after a fault of the arm's own, nor while it is paused: somebody may have a hand in its way."""
        return not isinstance(fault, ArmError) and not self._requests.paused

    def _shut_down(self) -> str:
        """Park and let go of the torque; the trigger says whether that went well."""
        try:
            if self._gripped is not None:
                self._outcomes.conclude(self._gripped, Result.ABORTED, "stopped while the arm was at work on it")
                self._gripped = None
            self._motions.park()
        except SorterError as error:
            return self._latch(error)
        return "stopped"

    def _settle(self, reason: str) -> None:
        """Nobody knows any more what becomes of the part that the arm was at work on."""
        if self._gripped is not None:
            self._outcomes.conclude(self._gripped, Result.INDETERMINATE, reason)
            self._gripped = None

    def _come_to_rest(self) -> None:
        """Park and let go of the torque when the arm still does as it is told, else leave it holding."""
        try:
            self._motions.park()
        except SorterError as error:
            # If the ledger cannot take it either, the next intent will hold the cell.
            with suppress(LedgerError):
                self.rig.ledger.note("park_failed", self.rig.clock.now(), reason=str(error))

"""The states at work: one handler a state, each returns the trigger of the next transition.

Reading order is the walk of the data: capture, detect, localize, pick, place; then what they consist of. Every target
tried gets exactly one outcome, whatever happens on the way.
"""

from __future__ import annotations

from collections import Counter

from controller.cycle import proof
from controller.cycle.choice import Chooser
from controller.cycle.concerns import Concerns
from controller.cycle.holding import Holding
from controller.cycle.looking import Looker
from controller.cycle.memory import Memory
from controller.cycle.motions import Motions
from controller.cycle.outcomes import Outcomes
from controller.cycle.requests import Requests
from controller.cycle.rig import Look, Rig
from controller.cycle.sentry import Sentry
from controller.cycle.stock import Stock
from controller.cycle.targets import Target, TargetBook
from controller.cycle.view import MARGIN_MM
from controller.domain import Frame, PickPlan, Result, Shape
from controller.errors import CameraError, Intruder, LedgerError, PartHeld
from controller.vision.detect import Detected


class Handlers:
    """Do on a rig what each state asks for; `close` ends their thread.

    Attributes:
        left: Objects seen by the last look and not dealt with since.
        cycle_times: From look to retreat, s, one for every part taken to a bin.
        looker: Looks at the table.
        next_rig: What to work with from the next look on, when that changes; from any thread.

    Args:
        rig: The cell.
        book: The open targets.
        motions: Of its arm.
        outcomes: Of the targets.
        requests: What is asked for from outside.
        holding: Is told what works again.
        filled: Parts in each bin already, by name; counted up as they are placed.
        until_empty: Stop when the table is empty or nothing on it can be picked.
        most_parts: Stop after so many parts were dealt with; None for no limit.
    """

    def __init__(
        self,
        rig: Rig,
        book: TargetBook,
        motions: Motions,
        outcomes: Outcomes,
        requests: Requests,
        holding: Holding,
        filled: Counter[str],
        *,
        until_empty: bool,
        most_parts: int | None,
    ) -> None:
        self.left = 0
        self.cycle_times: list[float] = []
        self.next_rig: Rig | None = None
        self._book, self._motions, self._outcomes = book, motions, outcomes
        self._requests, self._holding, self._filled = requests, holding, filled
        self._until_empty, self._most_parts = until_empty, most_parts
        self._concerns = Concerns(rig)
        self._adopt(rig)
        self._frame: Frame | None = None
        self._detected: Detected | None = None
        self._cycle_started = 0.0
        self._picks_from_look = 0

    def _adopt(self, rig: Rig) -> None:
        """Take over a rig, and what follows from its configuration."""
        self._rig, self.next_rig = rig, None
        view = rig.config.work_area_outline(rig.calibration.T_base_table, MARGIN_MM)
        self._stock = Stock(rig.config, self._filled)
        self.looker = Looker(rig, self._motions.pose_at)
        self._motions.adopt(rig, view, Sentry(rig.camera, self.looker.guard, self._requests).on_duty)
        self._motions.planner = rig.planner.filled(self._stock.piles())
        self._holding.adopt(rig)
        self._memory = Memory()
        self._chooser = Chooser(rig, self._book, self._stock, view)

    def close(self) -> None:
        """Nothing is looked at afterwards."""
        self.looker.close()

    # --- the states -----------------------------------------------------------------------------------

    def home(self) -> str:
        """Torque on, whatever the jaws hold out of them, and out of the sight of the camera."""
        state = self._motions.start()
        target = self._outcomes.at_work
        if target is not None and target.plan is not None:
            self._motions.let_go(target.plan.grasp)
            self._outcomes.at_work = None
            reason = "it stuck to the jaws over the bin, until somebody helped"
            self._outcomes.conclude(target, Result.INDETERMINATE, reason)
            self._holding.overcome(PartHeld)
        else:
            self._motions.empty_jaws(state)
        # Jaws that their watchdog had stopped squeeze again from the first move on.
        self._motions.empty_jaws(self._motions.home())
        return "homed"

    def capture(self) -> str:
        """Take the frame of the next look, with the arm out of the view."""
        if self.next_rig is not None:
            self.looker.close()
            self._adopt(self.next_rig)
        if self._most_parts is not None and self._outcomes.concluded >= self._most_parts:
            return "stopped"
        motions = self._motions
        if motions.stranded:
            motions.home()
        if not self.looker.is_ahead and motions.retreat is not None and not motions.view_is_clear():
            motions.step_back()
        if motions.retreat is None:
            self._cycle_started = self._rig.clock.now()
        self._frame = self.looker.capture(motions.last)
        self._holding.overcome(CameraError)
        self._picks_from_look = 0
        return "captured"

    def detect(self) -> str:
        """What vision finds in it."""
        assert self._frame is not None
        self._detected = self.looker.detect(self._frame)
        return "detected"

    def localize(self) -> str:
        """Where that is on the table, and which of it may be picked."""
        assert self._frame is not None
        assert self._detected is not None
        found, things = self.looker.locate(self._detected)
        named, gone = self._book.identify(things)
        for target in gone:
            self._outcomes.give_up(target)
        look = Look(self._frame, self._detected.detections, tuple(named), found.refused)
        for observer in self._rig.observers:
            observer.looked(look)
        pieces = (*(thing for thing in things if thing.shape is Shape.OTHER), *found.in_the_way)
        in_the_way = (
            *found.in_the_way,
            *self._memory.look((*things, *found.in_the_way), self._frame),
            *self.looker.under_the_arm(self._frame, pieces),
        )
        self._chooser.offer(named, in_the_way, self._motions.positions, self._outcomes.concluded)
        self.left = len(named) + len(found.refused)
        self._motions.planner = self._concerns.review(named, self._stock).filled(self._stock.piles())
        return "located" if self._chooser.queue else self._emptied()

    def pick(self) -> str:
        """Choose a part, plan for it, and take it between the jaws; when none can be, make room."""
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
        for observer in self._rig.observers:
            observer.planned(plan)
        if not self._rig.confirm(plan):
            self._outcomes.conclude(target, Result.SKIPPED, "refused by the operator")
            return "missed"
        self._rig.ledger.intend(target.target_id, plan, target.attempts + 1, self._rig.clock.now())
        self._holding.overcome(LedgerError)
        target.attempts += 1
        for observer in self._rig.observers:
            observer.attempted(plan, target.attempts)
        self._outcomes.at_work = target
        try:
            refusal = self._motions.take(plan, proved=self._rig.pick_proof)
        except Intruder as hand:
            self._failed(target, plan, hand.cause)
            raise
        return "picked" if refusal is None else self._missed(target, plan, refusal)

    def place(self) -> str:
        """Carry what the jaws hold to its bin, see that it is what it was taken for, and let go."""
        target = self._outcomes.at_work
        assert target is not None
        assert target.plan is not None
        plan, arrival = self._motions.carry(target.plan)
        dropped = proof.lost(arrival.state, plan.grasp) if self._rig.pick_proof else None
        self._look_ahead(plan)
        mistaken = dropped is None and self._rig.pick_proof and self.looker.shows_still(plan.target.detection)
        if mistaken:
            plan = self._divert(target, plan)
        before = self._motions.let_go(plan.grasp)
        if dropped is None and self._rig.pick_proof:
            # It may have gone while the arm stood over the bin.
            dropped = proof.lost(before, plan.grasp)
        self._motions.released(plan.retreat, target.located.height)
        self._outcomes.at_work = None
        if dropped is not None:
            target.lost, target.reason = True, dropped
            for observer in self._rig.observers:
                observer.failed(plan, dropped)
            if target.attempts >= self._rig.config.cycle.attempts:
                self._outcomes.conclude(target, Result.DROPPED, dropped)
        else:
            self.left -= not mistaken
            self._stock.placed(plan.bin, target.located)
            self._motions.planner = self._motions.planner.filled(self._stock.piles())
            rejected = plan.bin.name == self._rig.config.sorting.otherwise
            result = Result.REJECTED if rejected else Result.PLACED
            what = "; not what was to be taken, which still lies there" if mistaken else ""
            self._outcomes.conclude(target, result, f"in {plan.bin.name}{what}")
        self.cycle_times.append(self._rig.clock.now() - self._cycle_started)
        self._cycle_started = self._rig.clock.now()
        self._picks_from_look += 1
        if self._chooser.queue and self._picks_from_look < self._rig.config.cycle.picks_per_look and dropped is None:
            return "continued"
        return "placed"

    def idle(self) -> str:
        """Nothing can be picked now: wait for the next look, or end."""
        self._holding.overcome(LedgerError)
        self._motions.step_back()
        if self._until_empty:
            return "stopped"
        if self._rig.config.cycle.idle_look_s > 0:
            self._rig.clock.sleep(self._rig.config.cycle.idle_look_s)
        return "woken"

    # --- parts of them --------------------------------------------------------------------------------

    def _next(self, corners: bool = False) -> tuple[Target, PickPlan] | None:
        motions = self._motions
        return self._chooser.next(motions.planner, self._rig.arm.state().positions, motions.climb, corners)

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
        chosen = self._chooser.nudge(motions.planner, self._rig.arm.state().positions, motions.climb)
        if chosen is None:
            return False
        _, plan = chosen
        self._rig.ledger.note("nudge", self._rig.clock.now(), center=plan.moved.center, by=plan.by)
        self._holding.overcome(LedgerError)
        for observer in self._rig.observers:
            observer.nudging(plan)
        motions.push(plan)
        self._book.pushed(plan.ends)
        for observer in self._rig.observers:
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
                self._rig.arm.description.name, "place", cause, "take it out of the jaws, then controller resume"
            )
        if rejects.name == plan.bin.name:
            return plan
        target.plan = motions.planner.plan_diverted(
            plan, rejects, self._stock.drop_point(rejects), self._rig.arm.state().positions,
            view=motions.view,
        )  # fmt: skip
        motions.carry(target.plan)
        return target.plan

    def _missed(self, target: Target, plan: PickPlan, refusal: str) -> str:
        """Let go of whatever it is, and go where the camera sees all."""
        self._failed(target, plan, refusal)
        if self._motions.blocked:
            self._chooser.avoid(plan.grasp)
        self._motions.grip(plan.grasp.opening)
        self._motions.home()
        if not self._book.rests(target, self._rig.config.cycle.attempts, self._outcomes.concluded):
            self._outcomes.conclude(target, Result.GRASP_MISSED, refusal)
        return "missed"

    def _failed(self, target: Target, plan: PickPlan, reason: str) -> None:
        """The arm is no longer at work on a target, which may be tried again."""
        self._outcomes.at_work = None
        target.reason = reason
        for observer in self._rig.observers:
            observer.failed(plan, reason)

    def _look_ahead(self, plan: PickPlan) -> None:
        """Begin the next look, when the camera sees past the arm and somebody will want it."""
        if self._rig.config.cycle.picks_per_look > 1 or self._requests.paused:
            return
        since = self._motions.clear_from(plan.carry)
        if since is not None:
            self.looker.look_ahead(since)

"""What the arm is told to do: moves that end early when somebody asks for a stop, jaws that must let go, rest."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import numpy as np
from numpy.typing import NDArray

from controller.cycle import proof
from controller.cycle.guard import Hidden
from controller.cycle.holding import RELEASES
from controller.cycle.requests import Interrupted
from controller.cycle.rig import Rig
from controller.domain import ArmState, Grasp, GripReport, MoveReport, NudgePlan, PickPlan, Shape, Trajectory
from controller.errors import MotionTimeout, PartHeld
from controller.motion.grasps import RELEASE_MARGIN, release_opening
from controller.motion.planner import Planner

_FALL_MM = 8.0
"""The planner lets a part fall this far: what lies below the jaws when they have opened is that much lower."""

_SQUEEZES = 0.1
"""Share of their power by which jaws at rest squeeze something: the simulated arm's take 0.4 on a part and less than
0.01 on none.
"""

_CLEAR_STEP = 0.05
"""s between the poses of a move at which the view is judged."""

_BEHIND, _AHEAD = 0.3, 0.1
"""s by which a moving arm may be behind its plan, from a late start to the wait for its jaws, and ahead of it, by the
stamp of a picture."""

Watch = Callable[[Hidden], AbstractContextManager[None]]
"""In force while the arm is over the table."""


class Motions:
    """Moves the arm of a rig, and knows where it has come to stand.

    Attributes:
        planner: Plans the moves; a slow one while that is better.
        view: ndarray of shape (N, 2): outline in `table` that the camera must see past the arm, mm.
        last: When the last motion ended, s of the cell's clock.
        positions: ndarray of shape (J,): where the joints stood then, rad.
        blocked: The jaws came down on something when they last went for a part.
        retreat: The way out of the bin over which the last part was let go, not yet carried out; or None.
        stranded: The arm stands where it was stopped on its way, over the table.

    Args:
        rig: The cell.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.planner: Planner = rig.planner
        self.view: NDArray[np.float64] = np.empty((0, 2))
        self._energised = False
        self._placed_height = 0.0
        self.last = 0.0
        self.positions: NDArray[np.float64] = np.array(rig.arm.description.ready)
        self.blocked = False
        self.retreat: Trajectory | None = None
        self.stranded = False
        self._watch: Watch = lambda hidden: nullcontext()
        self._way: tuple[NDArray[np.float64], float, float] = (self.positions[None], 1.0, 0.0)

    def adopt(self, rig: Rig, view: NDArray[np.float64], watch: Watch) -> None:
        """Take over a rig with the same arm.

        Args:
            rig: The rig.
            view: ndarray of shape (N, 2): outline in `table` that the camera must see past the arm, mm.
            watch: In force while the arm is over the table; may end that move, and raises `Intruder` then.
        """
        self._rig, self.view, self.planner, self._watch = rig, view, rig.planner, watch

    def start(self) -> ArmState:
        """Torque on where the arm stands; how it stands."""
        state = self._rig.arm.energise()
        self._energised = True
        return state

    def empty_jaws(self, state: ArmState) -> None:
        """Let go of what an earlier run, cut off, has left between the jaws: the next look finds it.

        Args:
            state: Of the arm now.

        Raises:
            Interrupted: It was ended early by a stop.
        """
        if abs(state.gripper_load) > _SQUEEZES:
            widest = self._rig.arm.description.gripper.opening[1]
            self.grip(min(state.opening + 2.0 * RELEASE_MARGIN, widest))

    def home(self) -> ArmState:
        """To the ready pose, out of the camera's sight; how the arm stands there."""
        report = self.follow(self.planner.home(self._rig.arm.state().positions))
        self.stranded = False
        return report.state

    def follow(self, trajectory: Trajectory, opening: float | None = None, after: float = 0.0) -> MoveReport:
        """Carry out a move; see `Arm.follow`.

        Raises:
            Interrupted: It was ended early by a stop.
        """
        report = self._rig.arm.follow(trajectory, opening, after)
        self.positions = report.state.positions
        offsets = trajectory.positions[-1] - self.positions if report.finished else 0.0
        self._way = trajectory.positions - offsets, trajectory.period, self._rig.clock.now()
        self._moved(report.finished)
        return report

    def pose_at(self, at: float) -> NDArray[np.float64]:
        """Where the joints stood at a time, as far back as the last move: ndarray of shape (J,), rad.

        Args:
            at: s of the cell's clock.
        """
        positions, period, end = self._way
        before = round((end - at) / period)
        return self.positions if before <= 0 else positions[max(len(positions) - 1 - before, 0)]

    def grip(self, opening: float) -> GripReport:
        """Move the jaws; see `Arm.grip`.

        Raises:
            Interrupted: It was ended early by a stop.
        """
        report = self._rig.arm.grip(opening)
        self._moved(report.finished)
        return report

    def take(self, plan: PickPlan, *, proved: bool) -> str | None:
        """Go down and close the jaws on a part; None when they hold it, else why they do not.

        Args:
            plan: How.
            proved: Whether the settled jaws are asked what they hold, or believed.

        Raises:
            Interrupted: A move was ended early by a stop.
            Intruder: The way down was, by something that reaches over the table.
        """
        arrival = self._go_down(plan.approach, plan.grasp.opening)
        refusal = proof.obstruction(arrival, plan.approach)
        self.blocked = refusal is not None
        if refusal is None:
            report = self.grip(proof.closing_target(plan.grasp, self._rig.arm.description.gripper))
            target = plan.target
            named = target.shape is not Shape.OTHER or target.detection.label != str(target.shape)
            if proved:
                before = arrival.state.opening
                refusal = proof.refusal(report, plan.grasp, target.sigma, named=named, before=before)
        return refusal

    def push(self, plan: NudgePlan) -> bool:
        """Push a part with the closed jaws; False when something stood in the way, down or along the push.

        Raises:
            Interrupted: A move was ended early by a stop.
            Intruder: One was, by something that reaches over the table.
        """
        arrival = self._go_down(plan.approach, plan.opening)
        if proof.obstruction(arrival, plan.approach) is not None:
            self.home()
            return False
        try:
            stuck = proof.obstruction(self._follow_watched(plan.push), plan.push) is not None
        except MotionTimeout:
            # What is pushed may jam among its neighbours; the driver has let go of the pressure and holds.
            stuck = True
        if stuck:
            self.home()
            return False
        self._follow_watched(plan.retreat)
        return True

    def carry(self, plan: PickPlan) -> tuple[PickPlan, MoveReport]:
        """Take what the jaws hold to where it is let go; from where the arm was stopped on its way, the rest of it.

        Returns:
            The plan as it was carried out, and how the arm arrived.

        Raises:
            Interrupted: The move was ended early by a stop.
            Intruder: It was, by something that reaches over the table; the jaws still hold.
            LimitViolation: The arm no longer stands on its way.
        """
        if self.stranded:
            plan = self.planner.plan_rest(plan, self._rig.arm.state().positions)
        return plan, self._follow_watched(plan.carry)

    def _go_down(self, approach: Trajectory, opening: float) -> MoveReport:
        """An approach under watch; from deep in a bin the jaws move when they are past what lies there."""
        out_of_bin = self.planner.rise_time(approach, self.climb) if self.climb else 0.0
        self.retreat = None
        return self._follow_watched(approach, opening, out_of_bin)

    def _follow_watched(self, move: Trajectory, opening: float | None = None, after: float = 0.0) -> MoveReport:
        """As `follow`, under watch.

        Raises:
            Interrupted: See `follow`.
            Intruder: The move was ended by something that reaches over the table.
        """
        self.stranded = True
        with self._watch(self._hidden_on(move)):
            arrival = self.follow(move, opening, after)
        self.stranded = False
        return arrival

    def _hidden_on(self, move: Trajectory) -> Hidden:
        """What of the table the arm hides, by time, in a move that begins now; see `Planner.hidden`."""
        began, planner = self._rig.clock.now(), self.planner

        def hidden(at: float) -> NDArray[np.float64]:
            first, last = (round((at - began + apart) / move.period) for apart in (-_BEHIND, _AHEAD))
            step = max(round(_CLEAR_STEP / move.period), 1)
            indices = np.clip(np.arange(first, last + step, step), 0, len(move.positions) - 1)
            return np.vstack([planner.hidden(move.positions[index]) for index in np.unique(indices)])

        return hidden

    def let_go(self, grasp: Grasp) -> ArmState:
        """Open the jaws a little, and as wide as they came if they keep what is between them.

        Returns:
            How the arm stood just before.

        Raises:
            PartHeld: They still do.
        """
        before = self._rig.arm.state()
        opening = release_opening(grasp, before.opening)
        for _ in range(RELEASES):
            kept = proof.kept(self.grip(opening), grasp)
            if kept is None:
                return before
            opening = grasp.opening
        arm = self._rig.arm.description.name
        raise PartHeld(arm, "let go", kept or "", "take the part out of the jaws, then controller resume")

    def released(self, retreat: Trajectory, height: float) -> None:
        """A part of this height was let go; the way out is due."""
        self.retreat, self._placed_height = retreat, height

    def step_back(self) -> None:
        """Carry out the retreat that is due since the last part was let go, if it is."""
        if self.retreat is not None:
            retreat, self.retreat = self.retreat, None
            self.follow(retreat)

    @property
    def climb(self) -> float:
        """How far the arm must go straight up before it may turn or open its jaws further, mm: out of the bin that
        it stands in, past the part it has just let go.
        """
        return 0.0 if self.retreat is None else self._placed_height + _FALL_MM

    def view_is_clear(self) -> bool:
        """Whether the camera sees the work area past the arm as it stands."""
        return self.planner.leaves_view_clear(self._rig.arm.state().positions, self.view)

    def clear_from(self, move: Trajectory) -> float | None:
        """Since when the camera has seen the work area past the arm, s of the cell's clock.

        Args:
            move: The move that has just ended.

        Returns:
            None when the arm still stands in the view.
        """
        planner, offsets = self.planner, move.positions[-1] - self.positions
        step = max(round(_CLEAR_STEP / move.period), 1)
        since = None
        for index in range(len(move.positions) - 1, -1, -step):
            if not planner.leaves_view_clear(move.positions[index] - offsets, self.view):
                break
            since = self.last - (len(move.positions) - 1 - index) * move.period
        return since

    def park(self) -> None:
        """Bring the arm to rest and let go of the torque; leaves an arm alone that was never energised."""
        if not self._energised:
            return
        self._rig.arm.clear_stop()
        self._rig.arm.resume()
        if self._rig.arm.follow(self.planner.park(self._rig.arm.state().positions)).finished:
            self._rig.arm.relax()

    def _moved(self, finished: bool) -> None:
        self.last = self._rig.clock.now()
        if not finished:
            raise Interrupted

"""From a located part to a plan the arm may follow: grasp, drop, paths, timing, and the gate's approval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Self

import numpy as np

from controller.domain import (
    ArmDescription,
    Array,
    Bin,
    CellCalibration,
    Grasp,
    LocatedObject,
    NudgePlan,
    PickPlan,
    Point,
    Trajectory,
)
from controller.geometry import invert, transform
from controller.motion import dynamics, grasps, nudges, ways
from controller.motion.gate import Gate, workspace
from controller.motion.kinematics import points
from controller.motion.moves import Moves, first
from controller.motion.overhead import CLEARANCE, PART_BELOW_TIPS, Overhead
from controller.motion.path import Leg, line, rest_of, stroke
from controller.motion.postures import Postures, Stop
from controller.motion.shoves import Shoves
from controller.motion.view import discs, hides


class Planner:
    """Plans moves for one arm in one cell. Pure: it moves nothing and keeps no state between calls.

    Args:
        arm: The arm.
        calibration: Where `table` lies in `base`, and the joint offsets.
        bins: All bins, also those not used.
        speed: Share of the arm's speed limits, in (0, 1].
        part_mass: Expected mass of a part, kg.
    """

    def __init__(
        self,
        arm: ArmDescription,
        calibration: CellCalibration,
        bins: Sequence[Bin],
        *,
        speed: float = 1.0,
        part_mass: float = 0.02,
    ) -> None:
        self.arm = arm
        self.calibration = calibration
        self.bins = tuple(bins)
        self.speed = speed
        self.part_mass = part_mass
        self._offsets = dynamics.joint_offsets(arm, calibration.joint_offsets)
        self._T = np.asarray(calibration.T_base_table, np.float64)
        self._eye = transform(self._T, np.asarray(calibration.T_table_camera, np.float64)[:3, 3])
        self.gate = Gate(arm, self._T, self.bins, workspace(self.bins, self._T, arm), self._eye)
        self._postures = Postures(arm, self.gate, calibration.error_map, calibration.jaws)
        self._moves = Moves(arm, self.gate, self._offsets, Overhead(arm, self._T, self.bins), speed)

    @property
    def turns_jaws(self) -> bool:
        """The arm has a wrist roll: its jaws close along any direction."""
        return len(self.arm.joints) > 4

    def slowed(self, share: float) -> Self:
        """The same planner at a share of its speed, in (0, 1]."""
        slow = copy(self)
        slow.speed = share * self.speed
        slow._moves = replace(self._moves, speed=slow.speed)
        return slow

    def filled(self, piles: Mapping[str, float]) -> Self:
        """The same planner over bins that hold something.

        Args:
            piles: Height over the table that what lies in a bin may reach, mm, by the bin's name; where missing
                unknown, up to the brim.
        """
        over = copy(self)
        over._moves = replace(self._moves, overhead=replace(self._moves.overhead, piles=dict(piles)))
        return over

    # --- what the cycle asks for --------------------------------------------------------------------------

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
        """Everything that moves for one part, approved as a whole.

        Args:
            target: The part.
            others: Everything else on the table, whatever it is.
            bin: Where to put it.
            drop: (x, y) in `table` where the part's centre is let go, or as near as it falls on no wall, mm.
            start: ndarray of shape (J,): measured joint angles, rad.
            view: ndarray of shape (N, 2): outline in `table` (mm) that the camera must see after the retreat.
                When given and the arm hides nothing of it over the bin, the retreat ends there: half a second
                sooner than in the ready pose, and as near to the next part.
            climb: mm that the way begins straight up, because the arm stands deep in a bin.
            corners: Whether a part may be held by two corners, which may slip: for when nothing else can be taken.
            avoid: Grasps at which the jaws came down on something: not to be repeated while anything lies near, which
                may reach further than was seen.

        Raises:
            NoClearGrasp: The jaws have no room, or the part does not suit them.
            Unreachable: Part or drop lies outside the reach.
            LimitViolation: The gate refuses the plan.
        """
        q0 = self._moves.start(start)
        gripper = self.arm.gripper
        near = grasps.obstacles(others, self.bins, target.center, grasps.reach_about(target, gripper))
        choices = grasps.ways_to_take(target, gripper, near, self._tangent(target.center), corners, avoid)
        return first(choices, lambda choice: self._plan(target, bin, drop, q0, choice.grasp, others, view, climb))

    def plan_diverted(
        self, plan: PickPlan, bin: Bin, drop: Point, start: Array, *, view: Array | None
    ) -> PickPlan:
        """The same part taken on to another bin, from over the one it was carried to.

        Args:
            plan: How it came there; the part is still held.
            bin: The other bin.
            drop: (x, y) in `table` where the part's centre is let go, mm.
            start: ndarray of shape (J,): measured joint angles, rad.
            view: See `plan_pick`.

        Raises:
            Unreachable: The drop lies outside the reach.
            LimitViolation: The gate refuses the way.
        """
        q0, grasp = self._moves.start(start), plan.grasp
        clear = max(self._moves.clear(self._moves.below(q0), drop), self._moves.clear(drop))
        held = self._moves.start(plan.carry.positions[0])
        place = self._postures.drop(bin, drop, (plan.target, grasp), held, self._pile(bin), clear)
        out, inside = stroke(self.arm, place.low, place.rise), self._inside(place, clear)
        rise = clear - points(self.arm, q0)[3, 2]
        down = self._moves.approach(q0, out.reversed(), place.rise - inside, grasp.opening, max(rise, 1.0))
        carry = replace(down, name="carry", narrow=None)
        retreat = self._retreat(place, out, inside, view)
        self.gate.check_moves((retreat,), carry.positions[-1], grasp.opening)
        return replace(plan, bin=bin, carry=carry, retreat=retreat)

    def plan_rest(self, plan: PickPlan, start: Array) -> PickPlan:
        """The same plan with what is left of its carry, which has ended early.

        Args:
            plan: The plan.
            start: ndarray of shape (J,): measured joint angles, on the way of the carry, rad.

        Raises:
            LimitViolation: The arm stands elsewhere.
        """
        q0 = self._moves.start(start)
        held = self.part_mass, self.part_mass
        carry = self._moves.along("carry", [rest_of(self.arm, plan.carry.positions, q0)], [], payload=held)
        self.gate.check(carry, q0, opening=plan.grasp.opening)
        return replace(plan, carry=carry)

    def plan_nudge(
        self,
        target: LocatedObject,
        others: Sequence[LocatedObject],
        area: Array,
        start: Array,
        *,
        climb: float = 0.0,
        tried: Sequence[tuple[Point, Point]] = (),
        unsure: bool = False,
    ) -> NudgePlan:
        """A push of a part or its neighbour after which the part should be free to take, approved as a whole.

        Args:
            target: A part that `plan_pick` found no room for.
            others: Everything else on the table, whatever it is.
            area: ndarray of shape (N, 2): outline in `table` that what is pushed must stay in, mm.
            start: ndarray of shape (J,): measured joint angles, rad.
            climb: mm that the way begins straight up, because the arm stands deep in a bin.
            tried: Earlier pushes for this part, which have not freed it: where what was pushed lay, and by how much.
            unsure: A push that only may free it, for where none is foreseen to.

        Raises:
            NoClearGrasp: No push, or no other, would free it.
            Unreachable: Every push lies outside the reach.
            LimitViolation: The gate refuses every push.
        """
        q0 = self._moves.start(start)
        tangent = None if self.turns_jaws else self._postures.tangent
        found = nudges.pushes(target, others, self.bins, area, self.arm.gripper, tangent, tried, unsure=unsure)
        shoves = Shoves(self._moves, self._postures)
        return first(found, lambda push: shoves.nudge(target, push, others, q0, climb))

    def plan_touch(
        self, part: LocatedObject, beside: Point, by: Array, roll: float, start: Array
    ) -> tuple[Trajectory, Trajectory, Trajectory]:
        """Down beside a part that lies alone, a slow push with the closed jaws, and back to the ready pose.

        Args:
            part: What is pushed.
            beside: (x, y) in `table` where the jaws come down, mm.
            by: ndarray of shape (2,): how far the jaws go, `table`, mm.
            roll: Of the wrist while they go, rad.
            start: ndarray of shape (J,): measured joint angles, rad.

        Returns:
            Approach, push and retreat; between push and retreat the jaws stand against the part.

        Raises:
            Unreachable: A place lies outside the reach.
            LimitViolation: The gate refuses a move.
        """
        return Shoves(self._moves, self._postures).touch(part, beside, by, roll, self._moves.start(start))

    def plan_move(self, name: str, start: Array, goal: Array) -> Trajectory:
        """A move from a pose to another, over a safe height where the direct way passes low.

        Args:
            name: What it is for.
            start: ndarray of shape (J,): measured joint angles, rad.
            goal: ndarray of shape (J,): wanted joint angles, rad.

        Raises:
            LimitViolation: The gate refuses every way tried.
        """
        return self._moves.between(name, self._moves.start(start), np.asarray(goal, np.float64))

    def home(self, start: Array) -> Trajectory:
        """To the ready pose, out of the camera's view of the work area.

        Raises:
            LimitViolation: See `plan_move`.
        """
        return self.plan_move("home", start, np.array(self.arm.ready))

    def park(self, start: Array) -> Trajectory:
        """To the rest pose, where torque may go off.

        Raises:
            LimitViolation: See `plan_move`.
        """
        return self.plan_move("park", start, np.array(self.arm.rest))

    def rise_time(self, trajectory: Trajectory, rise: float) -> float:
        """When on a trajectory the tool has first risen by `rise` mm, s; its end when it never does."""
        height = points(self.arm, trajectory.positions)[:, 3, 2]
        risen = np.flatnonzero(height >= height[0] + rise)
        return (float(risen[0]) if len(risen) else len(height) - 1) * trajectory.period

    def leaves_view_clear(self, start: Array, view: Array) -> bool:
        """Whether the camera sees all of an outline of the table past the arm as it stands.

        Args:
            start: ndarray of shape (J,): measured joint angles, rad.
            view: ndarray of shape (N, 2): outline in `table`, mm.
        """
        q = np.asarray(start, np.float64) - self._offsets
        return not hides(self.arm, q, self._eye, self._flat(view))

    def hidden(self, start: Array) -> Array:
        """What of the table the arm hides from the camera as it stands: discs (N, 3), x, y, radius, in `table`, mm.

        Args:
            start: ndarray of shape (J,): measured joint angles, rad.
        """
        found = discs(self.arm, np.asarray(start, np.float64) - self._offsets, self._eye)
        centers = np.column_stack([found[:, :2], np.zeros(len(found))])
        return np.column_stack([transform(invert(self._T), centers)[:, :2], found[:, 2]])

    def bin_error(self, bin: Bin, drop: Point | None = None, pile: float | None = None) -> str | None:
        """Why no part can be let go in a bin, or None when it can; see `Postures.bin_error`."""
        return self._postures.bin_error(bin, drop, pile)

    def _tangent(self, point: Point) -> float | None:
        return None if self.turns_jaws else self._postures.tangent(point)

    # --- paths --------------------------------------------------------------------------------------------

    def _plan(
        self,
        target: LocatedObject,
        bin: Bin,
        drop: Point,
        q0: Array,
        grasp: Grasp,
        others: Sequence[LocatedObject],
        view: Array | None,
        climb: float,
    ) -> PickPlan:
        there, away = self._moves.clear(self._moves.below(q0), grasp.center), self._moves.clear(grasp.center, drop)
        pick = self._postures.over(grasp.center, grasp.height, None, grasp.direction, max(there, away))
        clear = max(away, self._moves.clear(drop))
        place = self._postures.drop(bin, drop, (target, grasp), pick.low, self._pile(bin), clear)
        tall = max([target.height, *(other.height for other in others), 0.0])
        # From here down the jaws are among the parts: exactly vertical.
        straight = min(tall + PART_BELOW_TIPS + self.arm.gripper.jaw_depth - grasp.height + 2.0, pick.rise)
        inside = self._inside(place, clear)
        out, in_ = stroke(self.arm, pick.low, pick.rise), stroke(self.arm, place.low, place.rise)
        approach = self._moves.approach(q0, out.reversed(), pick.rise - straight, grasp.opening, climb)
        carry = self._moves.along(
            "carry",
            [out, line(self.arm, pick.high, place.high), in_.reversed()],
            [(pick.rise - straight, ways.CORNER), (ways.CORNER, place.rise - inside)],
            payload=(0.0, self.part_mass),
        )
        retreat = self._retreat(place, in_, inside, view)
        plan = PickPlan(target, bin, grasp, approach, carry, retreat)
        self.gate.check_moves((carry, retreat), approach.positions[-1], grasp.opening)
        return plan

    def _pile(self, bin: Bin) -> float | None:
        return self._moves.overhead.piles.get(bin.name)

    def _inside(self, place: Stop, clear: float) -> float:
        """How far the arm rises from a place in a bin until it is over the walls and the bins beside it, mm."""
        height = float(points(self.arm, place.low)[3, 2])
        return min(max(clear - CLEARANCE - height, 5.0), place.rise)

    def _retreat(self, place: Stop, out: Leg, inside: float, view: Array | None) -> Trajectory:
        """Out of a bin, `inside` mm of it between its walls, and to the ready pose where the camera needs it."""
        legs, corners = [out], []
        if view is None or hides(self.arm, place.high, self._eye, self._flat(view)):
            legs.append(line(self.arm, place.high, np.array(self.arm.ready)))
            corners.append((place.rise - inside, ways.CORNER))
        return self._moves.along("retreat", legs, corners, payload=(self.part_mass, 0.0))

    def _flat(self, outline: Array) -> Array:
        """An outline (N, 2) of the table's surface, given in `table`, in `base`."""
        return transform(self._T, np.column_stack([outline, np.zeros(len(outline))]))[:, :2]

"""From a located part to a plan the arm may follow: grasp, drop, paths, timing, and the gate's approval."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from controller.domain import (
    ArmDescription,
    Array,
    Bin,
    CellCalibration,
    Grasp,
    LocatedObject,
    PickPlan,
    Point,
    Trajectory,
    Waypoint,
)
from controller.errors import LimitViolation, NoClearGrasp, PlanError, Unreachable
from controller.geometry import invert, transform
from controller.motion import dynamics, grasps
from controller.motion.gate import WALL_MARGIN, Gate, workspace
from controller.motion.kinematics import (
    TOP_DOWN,
    chain,
    closing_direction,
    inverse,
    points,
    roll_for,
    solutions,
)
from controller.motion.path import Leg, join, line, speed_limits, stroke
from controller.motion.trajectory import generate
from controller.motion.view import hides

# Beyond the top-down reach the tool may lean outwards, steepest first; flatter than 65 deg the fingers' backs
# come near the table.
PITCHES = tuple(math.radians(deg) for deg in (90.0, 85.0, 80.0, 75.0, 70.0, 65.0))
# The vertical stroke at part and bin. Lifts of 30 to 80 mm cost the same to 3 %; 60 clears every wall used.
LIFT = 60.0
CORNER = 100.0  # mm of sideways travel that are rounded into the stroke
CLEARANCE = 10.0  # mm over walls and parts in transit
TALLEST_PART = 30.0  # mm: assumed to lie where nothing was seen
PART_BELOW_TIPS = grasps.TIP_HEIGHT
TILT_ROOM = 3.0  # mm that a jaw's corner comes lower at the flattest pitch than pointing down
CALM_SPEED = 1000.0  # mm/s of the tool in moves that carry nothing anywhere: ready, rest, by hand
FALL = 8.0  # mm that a part may fall onto what lies in the bin
MIN_BEND = math.radians(8.0)
_START_CLIP = math.radians(3.0)  # a joint may rest this far outside its limits without being refused


@dataclass(frozen=True, slots=True, eq=False)
class _Stop:
    """A low pose, the pose straight above it, and the stroke's height."""

    low: Array
    high: Array
    rise: float


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
        self._yaw = math.atan2(self._T[1, 0], self._T[0, 0])
        self._eye = transform(self._T, np.asarray(calibration.T_table_camera, np.float64)[:3, 3])
        self.gate = Gate(arm, self._T, self.bins, workspace(self.bins, self._T, arm), self._eye)
        highest = max([TALLEST_PART, *(bin_.height for bin_ in self.bins)])
        # Height of the grasp point in transit: jaw tips and a held part pass over walls and parts.
        self._clear = highest + CLEARANCE + PART_BELOW_TIPS + arm.gripper.jaw_depth

    # --- what the cycle asks for --------------------------------------------------------------------------

    def plan_pick(
        self,
        target: LocatedObject,
        others: Sequence[LocatedObject],
        bin: Bin,
        drop: Point,
        start: Array,
        *,
        pile: float | None = None,
        finish: Array | None = None,
        view: Array | None = None,
        climb: float = 0.0,
    ) -> PickPlan:
        """Everything that moves for one part, approved as a whole.

        Args:
            target: The part.
            others: Everything else on the table, whatever it is.
            bin: Where to put it.
            drop: (x, y) in `table` where the part's centre is let go, mm.
            start: ndarray of shape (J,): measured joint angles, rad.
            pile: Height over the table of what lies in the bin already, mm; None: unknown, up to the brim.
            finish: ndarray of shape (J,): where the retreat ends, rad; the ready pose when None.
            view: ndarray of shape (N, 2): outline in `table` (mm) that the camera must see after the retreat.
                When given and the arm hides nothing of it over the bin, the retreat ends there: half a second
                sooner than in the ready pose, and as near to the next part.

            climb: mm that the way begins straight up, because the arm stands deep in a bin.

        Raises:
            NoClearGrasp: The jaws have no room, or the part does not suit them.
            Unreachable: Part or drop lies outside the reach.
            LimitViolation: The gate refuses the plan.
        """
        q0 = self._wanted(start)
        choices = self._choices(target, others)
        failure: PlanError | None = None
        for choice in choices:
            try:
                return self._plan(target, bin, drop, q0, choice.grasp, others, pile, finish, view, climb)
            except (Unreachable, LimitViolation) as error:
                failure = failure or error
        assert failure is not None
        raise failure

    def plan_move(self, name: str, start: Array, goal: Array) -> Trajectory:
        """A move from a pose to another, over a safe height where the direct way passes low.

        Args:
            name: What it is for.
            start: ndarray of shape (J,): measured joint angles, rad.
            goal: ndarray of shape (J,): wanted joint angles, rad.

        Raises:
            LimitViolation: The gate refuses every way tried.
        """
        q0 = self._wanted(start)
        goal = np.asarray(goal, np.float64)
        failure: LimitViolation | None = None
        for legs, corners in self._ways(q0, goal):
            trajectory = self._calm(name, legs, corners)
            try:
                self.gate.check(trajectory, q0)
            except LimitViolation as error:
                failure = failure or error
            else:
                return trajectory
        assert failure is not None
        raise failure

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

    def reach_error(self, point: Point, height: float) -> str | None:
        """Why the grasp point cannot come to a place of `table` (mm) from above, or None when it can."""
        try:
            self._stop(point, height, (0.0,))
        except PlanError as error:
            return error.cause
        return None

    def bin_error(self, bin: Bin) -> str | None:
        """Why no part can be let go in the middle of a bin, or None when it can."""
        try:
            self._drop_stop(bin, bin.center, None, np.array(self.arm.ready), (0.0, 0.0), None)
        except PlanError as error:
            return error.cause
        return None

    # --- grasp and drop -----------------------------------------------------------------------------------

    def _choices(self, target: LocatedObject, others: Sequence[LocatedObject]) -> list[grasps.Choice]:
        gripper = self.arm.gripper
        if len(self.arm.joints) > 4:
            offers = grasps.sides(target)
        else:
            x, y, _ = transform(self._T, [*target.center, 0.0])
            tangential = math.atan2(y, x - chain(self.arm).axis[0]) + math.pi / 2 - self._yaw
            side = grasps.fixed_side(target, tangential)
            if side is None:
                raise NoClearGrasp(
                    f"{target.shape} at ({target.center[0]:.0f}, {target.center[1]:.0f}) mm: lies turned so that the "
                    "jaws would squeeze it out",
                    "turn the part",
                )
            offers = (side,)
        within = gripper.opening[1] / 2.0 + sum(gripper.jaw_size) + grasps.ENOUGH_CLEARANCE + max(target.size)
        blocked = grasps.obstacles(others, self.bins, target.center, within)
        try:
            return grasps.choose(target, offers, gripper, blocked)
        except NoClearGrasp:
            oblique = grasps.oblique_sides(target) if len(self.arm.joints) > 4 else ()
            if not oblique:
                raise
            try:
                return grasps.choose(target, oblique, gripper, blocked)
            except NoClearGrasp:
                pass
            raise

    def _stop(self, point: Point, height: float, rolls: Sequence[float] | None, direction: float = 0.0) -> _Stop:
        """The pose at a place of `table` from above and the one `LIFT` over it or higher.

        Args:
            point: (x, y) in `table`, mm.
            height: z of the grasp point in `table`, mm.
            rolls: Rolls to choose from; None: those that close along `direction` (rad, `table`).
            direction: See `rolls`.
        """
        position = transform(self._T, [point[0], point[1], height])
        rise = max(LIFT, self._clear - height)
        azimuth = math.atan2(position[1], position[0] - chain(self.arm).axis[0])
        if rolls is None:
            rolls = roll_for(self.arm, azimuth, direction + self._yaw) or (0.0,)
        roll = min(rolls, key=abs)
        for pitch in PITCHES:
            ends = [
                next((q for k, q in solutions(self.arm, place, pitch, roll, within=True) if k == 0), None)
                for place in (position, position + np.array([0.0, 0.0, rise]))
            ]
            # A stretched arm would have to move infinitely fast along the stroke.
            if ends[0] and ends[1] and min(self._bend(ends[0]), self._bend(ends[1])) > MIN_BEND:
                return _Stop(np.array(ends[0]), np.array(ends[1]), rise)
        for over in (0.0, rise):
            inverse(self.arm, position + np.array([0.0, 0.0, over]), TOP_DOWN, roll)
        raise Unreachable(
            f"({position[0]:.0f}, {position[1]:.0f}) mm can only be reached with the arm stretched out or folded back",
            "move it nearer, or in front of the arm",
        )

    def _bend(self, q: Sequence[float]) -> float:
        """Angle by which the elbow is bent away from straight, rad."""
        c = chain(self.arm)
        return abs(q[2] - (c.fore[1] - c.upper[1]))

    def _drop_stop(
        self,
        bin: Bin,
        drop: Point,
        grasp: Grasp | None,
        held: Array,
        rest: Point,
        pile: float | None,
    ) -> _Stop:
        """The pose that lets the part go over `drop`, its centre there.

        Args:
            bin: The bin.
            drop: (x, y) in `table`, mm.
            grasp: How the part is held; None: nothing is.
            held: ndarray of shape (J,): the posture it was gripped in, rad.
            rest: Part's centre minus grasp point when it was gripped, `table`, mm.
            pile: Height of what lies in the bin, or None.
        """
        gripper = self.arm.gripper
        half = np.array(bin.size) / 2.0
        if (np.abs(np.array(drop) - bin.center) > half).any():
            raise Unreachable(f"drop ({drop[0]:.0f}, {drop[1]:.0f}) mm lies outside bin {bin.name}", "mend the drop")
        opening = grasp.opening if grasp is not None else gripper.opening[1]
        brim = bin.height + WALL_MARGIN + TILT_ROOM
        over = gripper.jaw_depth + max(brim, (pile if pile is not None else bin.height) + PART_BELOW_TIPS + 1.0)
        deep = gripper.jaw_depth + PART_BELOW_TIPS + FALL + (pile if pile is not None else bin.height)
        best: tuple[float, _Stop] | None = None
        failure: Unreachable | None = None
        held_yaw = closing_direction(held)
        for roll in self._drop_rolls(drop):
            try:
                place = drop
                for _ in range(2):
                    # The part hangs beside the grasp point and turns with the tool, which turns with the waist.
                    stop = self._stop(place, over, (roll,))
                    turn = closing_direction(stop.low) - held_yaw
                    c, s = math.cos(turn), math.sin(turn)
                    place = (drop[0] - c * rest[0] + s * rest[1], drop[1] - s * rest[0] - c * rest[1])
                if deep < over:
                    stop = self._stop(place, deep, (roll,))
                fits = deep < over and self.gate.jaws_inside(bin, stop.low, opening)
                if not fits:
                    stop = self._stop(place, over, (roll,))
            except Unreachable as error:
                failure = failure or error
                continue
            # Deeper is better than sooner: 1 mm of fall is worth 10 ms.
            cost = float((np.abs(stop.high - held) / speed_limits(self.arm)).max())
            cost += 0.0 if fits else 0.01 * max(over - deep, 0.0)
            if best is None or cost < best[0]:
                best = cost, stop
        if best is None:
            assert failure is not None
            raise failure
        return best[1]

    def _drop_rolls(self, drop: Point) -> tuple[float, ...]:
        """Rolls that set the jaws along the sides of the bin, or the only one there is."""
        x, y, _ = transform(self._T, [*drop, 0.0])
        azimuth = math.atan2(y, x - chain(self.arm).axis[0])
        rolls = [r for k in range(2) for r in roll_for(self.arm, azimuth, self._yaw + k * math.pi / 2)]
        return tuple(rolls) or (0.0,)

    # --- paths --------------------------------------------------------------------------------------------

    def _plan(
        self,
        target: LocatedObject,
        bin: Bin,
        drop: Point,
        q0: Array,
        grasp: Grasp,
        others: Sequence[LocatedObject],
        pile: float | None,
        finish: Array | None,
        view: Array | None,
        climb: float,
    ) -> PickPlan:
        pick = self._stop(grasp.center, grasp.height, None, grasp.direction)
        rest = (target.center[0] - grasp.center[0], target.center[1] - grasp.center[1])
        place = self._drop_stop(bin, drop, grasp, pick.low, rest, pile)
        tall = max([target.height, *(other.height for other in others), 0.0])
        # From here down the jaws are among the parts: exactly vertical.
        straight = min(tall + PART_BELOW_TIPS + self.arm.gripper.jaw_depth - grasp.height + 2.0, pick.rise)
        inside = min(max(self._clear - CLEARANCE - (points(self.arm, place.low)[3, 2]), 5.0), place.rise)
        out, in_ = stroke(self.arm, pick.low, pick.rise), stroke(self.arm, place.low, place.rise)
        approach = self._approach(q0, out.reversed(), pick.rise - straight, grasp.opening, climb)
        carry = self._trajectory(
            "carry",
            [out, line(self.arm, pick.high, place.high), in_.reversed()],
            [(pick.rise - straight, CORNER), (CORNER, place.rise - inside)],
            payload=(0.0, self.part_mass),
        )
        goal = np.array(self.arm.ready) if finish is None else np.asarray(finish, np.float64)
        if view is not None and not hides(self.arm, place.high, self._eye, self._flat(view)):
            goal, legs, corners = place.high, [in_], []
        else:
            legs, corners = [in_, line(self.arm, place.high, goal)], [(place.rise - inside, CORNER)]
        retreat = self._trajectory("retreat", legs, corners, payload=(self.part_mass, 0.0))
        plan = PickPlan(target, bin, grasp, self._waypoints(pick, place, goal), approach, carry, retreat)
        self.gate.check_plan(plan, q0)
        return plan

    def _approach(self, q0: Array, down: Leg, rounded: float, opening: float, climb: float) -> Trajectory:
        failure: LimitViolation | None = None
        ways = self._ways(q0, down.start) if climb <= 0.0 else self._climbing(q0, down.start, climb)
        for legs, corners in ways:
            last = (CORNER, rounded)
            trajectory = self._trajectory("approach", [*legs, down], [*corners, last])
            try:
                self.gate.check(trajectory, q0, opening=opening)
            except LimitViolation as error:
                failure = failure or error
            else:
                return trajectory
        assert failure is not None
        raise failure

    def _ways(self, q0: Array, goal: Array) -> Iterator[tuple[list[Leg], list[tuple[float, float]]]]:
        """Ways between two poses, the fastest sensible one first; the gate decides."""
        here = points(self.arm, q0)[3]
        there = points(self.arm, goal)[3]
        if here[2] >= min(self._clear, there[2]) - 1.0 or float(np.abs(q0 - goal).max()) < 1e-6:
            yield [line(self.arm, q0, goal)], []
        rise = self._clear - here[2]
        if rise > 1.0:
            try:
                up = stroke(self.arm, q0, rise)
            except Unreachable:
                pass
            else:
                yield [up, line(self.arm, up.end, goal)], [(max(rise - LIFT / 2.0, 0.0), CORNER)]
        for via in self._tucked(q0[0], goal[0]):
            yield [line(self.arm, q0, via[0]), line(self.arm, via[0], via[1]), line(self.arm, via[1], goal)], [
                (5.0, CORNER / 2.0),
                (CORNER / 2.0, 5.0),
            ]
        yield [line(self.arm, q0, goal)], []

    def _climbing(self, q0: Array, goal: Array, climb: float) -> Iterator[tuple[list[Leg], list[tuple[float, float]]]]:
        """The way out of a bin: straight up by `climb` mm and over the walls before it turns.

        Raises:
            Unreachable: The arm cannot go straight up from there.
        """
        rise = max(self._clear - points(self.arm, q0)[3, 2], climb + LIFT / 2.0)
        up = stroke(self.arm, q0, rise)
        yield [up, line(self.arm, up.end, goal)], [(max(rise - LIFT / 2.0, climb), CORNER)]

    def _tucked(self, waist: float, goal: float) -> Iterator[tuple[Array, Array]]:
        """Folded poses at two waist angles to pass through when the tool cannot go straight up."""
        for pose in (self.arm.ready, self.arm.rest):
            first, second = np.array(pose), np.array(pose)
            first[0], second[0] = waist, goal
            yield first, second

    def _trajectory(
        self,
        name: str,
        legs: Sequence[Leg],
        corners: Sequence[tuple[float, float]],
        payload: tuple[float, float] = (0.0, 0.0),
    ) -> Trajectory:
        path = join(self.arm, legs, corners)
        return generate(self.arm, path, name, speed=self.speed, joint_offsets=self._offsets, payload=payload)

    def _calm(self, name: str, legs: Sequence[Leg], corners: Sequence[tuple[float, float]]) -> Trajectory:
        """A trajectory slowed so far that the tool, swung out on a stretched arm, keeps its speed limit."""
        trajectory = self._trajectory(name, legs, corners)
        way = points(self.arm, trajectory.positions)[:, 3]
        top = float(np.linalg.norm(np.diff(way, axis=0), axis=1).max(initial=0.0)) / trajectory.period
        if top <= CALM_SPEED:
            return trajectory
        path = join(self.arm, legs, corners)
        speed = self.speed * CALM_SPEED / top
        return generate(self.arm, path, name, speed=speed, joint_offsets=self._offsets)

    def _waypoints(self, pick: _Stop, place: _Stop, finish: Array) -> tuple[Waypoint, ...]:
        T_table_base = invert(self._T)
        names = ("above part", "part", "above part", "above bin", "bin", "above bin", "finish")
        poses = np.array([pick.high, pick.low, pick.high, place.high, place.low, place.high, finish])
        way = transform(T_table_base, points(self.arm, poses)[:, 3])
        return tuple(
            Waypoint(name, (float(p[0]), float(p[1]), float(p[2]))) for name, p in zip(names, way, strict=True)
        )

    def _flat(self, outline: Array) -> Array:
        """An outline (N, 2) of the table's surface, given in `table`, in `base`."""
        return transform(self._T, np.column_stack([outline, np.zeros(len(outline))]))[:, :2]

    def _wanted(self, measured: Array) -> Array:
        """Joint angles without the calibrated offsets; a hair outside a limit counts as at it.

        Raises:
            LimitViolation: A joint stands outside its limits.
        """
        q = np.asarray(measured, np.float64) - self._offsets
        c = chain(self.arm)
        clipped = np.clip(q, c.low, c.high)
        for joint, value, inside in zip(self.arm.joints, q, clipped, strict=True):
            if not abs(value - inside) <= _START_CLIP:
                limit = math.degrees(inside)
                raise LimitViolation(
                    f"{joint.name} stands at {math.degrees(value):.1f} deg, limit {limit:.1f} deg",
                    "move it inside by hand with torque off",
                )
        return clipped

"""Following a trajectory: goals out, feedback in, every period, until it has ended and the joints stand.

A miss is a cycle without news; the goals go on. A servo's fault, silence for several cycles, or a joint that
strays from its path ends the move: the others slow down along the path and hold, then the error is raised.

A stop is one of category 1 (IEC 60204-1): power stays on to slow down, and goes off after parking. The first goal
that is slower than planned leaves within one cycle; the last that moves `SHORTEST_RAMP` later, or as much later as the
servos' torque asks for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from controller.domain import ArmState, MoveReport, ServoCycle, Trajectory
from controller.errors import ArmError, BusError, LimitViolation, MotionTimeout
from drivers.arm.body import WATCHDOG, Body, MissCounter, StopRequested
from drivers.arm.conversions import opening_from_angle, ticks_from_angles
from drivers.arm.servos import Telemetry
from drivers.arm.streaming import LONGEST_RAMP, Pace, Progress

START_TOLERANCE = 0.05
"""Largest distance of a joint from a trajectory's start, rad: sag and joint offsets stay below, other poses not."""

OFFSET_LIMIT = 0.15
"""Largest distance of a joint at rest from its goal, rad: sag and the offset against it reach 0.09."""

FOLLOWING_LIMIT = 0.30
"""Largest distance of a joint from its path, rad: an XM430 asks for its whole stall torque at 0.22."""

JAW_TOLERANCE = 2.0
"""Largest distance of the jaws from their opening when they get among other things, mm: half of the room that grasps
keep from everything."""

JAW_TIMEOUT = 2.0
"""s for which a move waits for its jaws: the whole way takes 1.3 at the slowest."""

_FOLLOWING_CYCLES = 5
_SETTLED_SPEED = 0.05  # rad/s: two units of Present_Velocity
_SETTLED_CYCLES = 4  # the turning point of a last swing of 0.01 rad lasts three
_SETTLE_TIME = 0.5  # s: joints whose sag is not modelled need up to 0.3
_SLIP_LIMIT = 2.0  # s a move may lose to late cycles beyond its own duration


def check_trajectory(body: Body, trajectory: Trajectory) -> None:
    """Refuse what must not be streamed, whatever the pose.

    Raises:
        LimitViolation: Wrong shape, not a number, or a goal the servos would refuse.
    """
    shape = (len(trajectory.positions), len(body.joints))
    told = (trajectory.positions, trajectory.goals, trajectory.resting, trajectory.braking)
    arrays = [array for array in told if array is not None]
    if shape[0] == 0 or any(array.shape != shape for array in arrays) or not trajectory.period > 0.0:
        raise LimitViolation(f"{trajectory.name}: not a trajectory of {len(body.joints)} joints")
    if not all(np.isfinite(array).all() for array in arrays):
        raise LimitViolation(f"{trajectory.name}: not a number among its samples")
    ticks = ticks_from_angles(trajectory.goals)
    for column, joint in zip(ticks.T, body.joints, strict=True):
        low, high = joint.limits
        if column.min() < low or column.max() > high:
            raise LimitViolation(f"{trajectory.name}: {joint.name} leaves its limits")


def check_start(body: Body, trajectory: Trajectory, state: ArmState) -> None:
    """Compare a trajectory's start with where the arm stands.

    Raises:
        LimitViolation: They differ.
    """
    from_pose = np.abs(trajectory.positions[0] - state.positions)
    from_goal = np.abs(trajectory.goals[0] - state.positions)
    for joint, pose, goal in zip(body.joints, from_pose, from_goal, strict=True):
        if pose > START_TOLERANCE or goal > OFFSET_LIMIT:
            cause = f"{trajectory.name}: {joint.name} stands {np.degrees(max(pose, goal)):.1f} deg from its start"
            raise LimitViolation(cause, "plan from the present pose")


class Follower:
    """One move under way.

    Args:
        body: The servos, their watchdog armed.
        trajectory: A checked trajectory.
        state: Where the arm stands.
        stop_requested: Asked every cycle.
        paused: Asked every cycle: whether to hold on the way.
        errands: (s along the trajectory, what to do there), in order.
        opening: Clear opening that the jaws take on the way, mm; None: they are left alone.
    """

    def __init__(
        self,
        body: Body,
        trajectory: Trajectory,
        state: ArmState,
        stop_requested: StopRequested,
        paused: Callable[[], bool],
        errands: Sequence[tuple[float, Callable[[], object]]] = (),
        opening: float | None = None,
    ) -> None:
        self._errands = list(errands)
        self._opening = opening
        self._jaws = state.opening
        self._waited = 0.0
        self._body = body
        self._trajectory = trajectory
        self._stop_requested = stop_requested
        self._paused = paused
        self._progress = Progress(trajectory, body.goals, body.stall)
        self._misses = MissCounter(body)
        self._present = state.positions.copy()
        self._speeds = np.abs(state.velocities)
        self._astray = np.zeros(len(body.joints), np.int64)
        self._failure: ArmError | None = None

    def stands(self) -> bool:
        """The goals do not move on and the joints have come to rest; from any thread."""
        return self._progress.standing and bool(self._speeds.max() <= _SETTLED_SPEED)

    def run(self) -> MoveReport:
        """Stream until the end, a stop or a failure; blocks.

        Raises:
            ArmError: What ended the move; the joints hold, unless the port is lost.
        """
        body, progress, clock = self._body, self._progress, self._body.clock
        if self._paused():
            progress.rest()
        last = tick = clock.now()
        ended_at: float | None = None
        settled = 0
        while True:
            sent_at = clock.now()
            body.send_goals(progress.goals)
            if self._errands and progress.phase >= self._errands[0][0]:
                self._guard(self._errands.pop(0)[1])
            news = self._look()
            if news and body.listener is not None:
                body.listener(ServoCycle(sent_at, clock.now(), body.goals, self._present.copy()))
            if progress.at_end or (self._ending and progress.standing):
                if self._failure is not None:
                    body.send_goals(progress.goals)
                    raise self._failure
                ended_at = clock.now() if ended_at is None else ended_at
                settled = settled + 1 if news and self._speeds.max() <= _SETTLED_SPEED else 0
                if settled >= _SETTLED_CYCLES or clock.now() - ended_at > _SETTLE_TIME:
                    return self._report()
            tick = body.next_tick(tick, self._trajectory.period)
            elapsed = clock.now() - last
            last += elapsed
            if elapsed > WATCHDOG / 2.0:
                self._guard(self._after_silence)
            progress.advance(elapsed, self._pace(elapsed))

    @property
    def _ending(self) -> bool:
        return self._failure is not None or self._stop_requested()

    def _pace(self, elapsed: float) -> Pace:
        waiting = self._wait_for_jaws(elapsed)
        if self._ending:
            return Pace.STOP
        return Pace.HOLD if waiting or self._paused() else Pace.GO

    def _wait_for_jaws(self, elapsed: float) -> bool:
        """Whether the move has to wait before it gets among other things: jaws too wide would come down on them."""
        narrow, wanted = self._trajectory.narrow, self._opening
        # Slowing down takes half of its time off the way that is left, and begins with the next goal.
        ahead = 0.5 * LONGEST_RAMP + 2.0 * self._trajectory.period
        if narrow is None or wanted is None or self._progress.phase < narrow - ahead:
            return False
        if not self._errands and abs(self._jaws - wanted) <= JAW_TOLERANCE:
            self._opening = None
            return False
        self._waited += elapsed
        if self._waited > JAW_TIMEOUT and self._failure is None:
            cause = f"the jaws stand at {self._jaws:.0f} mm, told {wanted:.0f}"
            remedy = "look what is between them, then reset"
            self._failure = MotionTimeout(self._body.gripper.title, self._trajectory.name, cause, remedy)
        return True

    def _report(self) -> MoveReport:
        state = self._body.state()
        off = np.abs(state.positions - self._progress.positions)
        if self._progress.at_end and off.max() > OFFSET_LIMIT:
            joint = self._body.joints[int(off.argmax())]
            cause = f"ends {np.degrees(off.max()):.0f} deg off its goal"
            raise MotionTimeout(joint.title, self._trajectory.name, cause, "clear the way, then reset")
        return MoveReport(self._progress.at_end, state)

    def _look(self) -> bool:
        """Take the servos' feedback in and judge it; True when every joint has answered."""
        found: Mapping[int, Telemetry | None] = {}

        def read() -> None:
            nonlocal found
            found = self._body.read(self._trajectory.name)

        self._guard(read)
        self._failure = self._failure or self._misses.failure(found, self._trajectory.name)
        joints = self._body.joints
        complete = True
        for index, joint in enumerate(joints):
            telemetry = found.get(joint.servo_id)
            if telemetry is None:
                complete = False
                continue
            self._present[index] = telemetry.position
            self._speeds[index] = abs(telemetry.velocity)
        jaw = found.get(self._body.gripper.servo_id)
        if jaw is not None:
            self._jaws = opening_from_angle(self._body.description.gripper, jaw.position)
        error = np.abs(self._present - self._progress.positions)
        largest = float(error.max())
        if largest > FOLLOWING_LIMIT:
            self._astray = np.where(error > FOLLOWING_LIMIT, self._astray + 1, 0)
        else:
            self._astray.fill(0)
        if self._failure is None and largest > FOLLOWING_LIMIT and self._astray.max() >= _FOLLOWING_CYCLES:
            index = int(self._astray.argmax())
            # The way is blocked: stop at once, and let go what stands off its goal before it overloads.
            offset = self._progress.goals - self._progress.positions
            held = np.where(self._astray > 0, self._present + offset, self._progress.goals)
            self._progress.rebase(held)
            cause = f"is {np.degrees(error[index]):.0f} deg off its path"
            remedy = "clear the way, then reset"
            self._failure = MotionTimeout(joints[index].title, self._trajectory.name, cause, remedy)
        if self._failure is None and self._progress.slipped > self._trajectory.duration + _SLIP_LIMIT:
            cause = f"{self._progress.slipped:.1f} s lost to late cycles"
            remedy = "relieve the machine; check the adapter's latency and the baud rate"
            self._failure = MotionTimeout(self._body.bus.name, self._trajectory.name, cause, remedy)
        return complete

    def _after_silence(self) -> None:
        """The servos' watchdog may have stopped them: go on from where they stand."""
        if self._body.recheck():
            self._progress.rebase(self._body.goals)

    def _guard(self, action: Callable[[], object]) -> None:
        """Do it; a failure ends the move, a lost port at once."""
        try:
            action()
        except ArmError as error:
            if isinstance(error, BusError) and error.code == "lost":
                raise
            self._failure = self._failure or error

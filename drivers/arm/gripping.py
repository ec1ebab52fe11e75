"""Closing and opening the jaws: a force limit, a goal, and when they have stopped.

Contact is found from motion alone, since an XL430's load only repeats its own power.
"""

from __future__ import annotations

from collections import deque

from controller.domain import GripReport
from controller.errors import MotionTimeout
from drivers.arm.body import WATCHDOG, Body, MissCounter, StopRequested
from drivers.arm.bring_up import set_register
from drivers.arm.conversions import angle_from_opening, opening_from_angle, opening_sign, ticks_from_angle

RATED_PWM = 350
"""Goal_PWM of effort 1: 22 to 28 N a finger on a crank gripper, 90 % of it 50 ms after contact.

The servo could give 885, which overloads it within seconds on a rigid part.
"""

OPENING_PWM = 600
"""Goal_PWM for opening, which meets nothing to be hurt: there in 0.2 s."""

SMALLEST_PWM = 130
"""Goal_PWM below which friction keeps the jaws from closing (100 does not move them)."""

GUARD = 0.060
"""s between the jaws' stop and a force worth lifting with."""

TIMEOUT = 0.8
"""s beyond the slowest sensible travel after which the jaws must have stopped."""

SLOWEST = 1.0
"""rad/s of the gripper's servo at the smallest force, for that travel."""

ARRIVED = 1.0
"""mm from the wanted opening that are no contact: friction leaves 0.3."""

_PERIOD = 0.010
_WINDOW = 0.020
_STOPPED = 0.3  # of the fastest travel so far
_MOVED = 0.006  # rad in one window: four ticks, more than an encoder's noise
_NEVER_MOVED = 0.150  # s: a gripper that moves at all starts within 50 ms
_STANDING_LOOKS = 4  # where answers are lost, two looks 60 ms apart may be the two sides of a swing
_STANDS = 0.15  # rad/s: 4 mm/s of opening at most


def goal_pwm(effort: float) -> int:
    """Goal_PWM for a fraction of the rated holding force."""
    return max(SMALLEST_PWM, round(RATED_PWM * effort))


class StopDetector:
    """Says when a moving gripper has stopped: travel in 20 ms below 30 % of the fastest 20 ms so far.

    Args:
        at: s, when the goal was sent.
        angle: rad, where the gripper's servo stood.
    """

    def __init__(self, at: float, angle: float) -> None:
        self._samples = deque([(at, angle)])
        self._started = at
        self._fastest = 0.0

    def stopped(self, at: float, angle: float) -> bool:
        """Take one sample (s, rad) in."""
        samples = self._samples
        samples.append((at, angle))
        while len(samples) > 2 and samples[1][0] <= at - _WINDOW + 1e-9:
            samples.popleft()
        then, before = samples[0]
        if at - then < _WINDOW - 1e-9:
            return False
        travel = abs(angle - before) * _WINDOW / (at - then)
        self._fastest = max(self._fastest, travel)
        if self._fastest < _MOVED:
            return at - self._started > _NEVER_MOVED
        return travel < _STOPPED * self._fastest


def send_jaws(body: Body, opening: float, start: float, effort: float = 1.0) -> float:
    """Send the jaws to a clear opening (mm) from where their servo stands (rad); the servo's goal, rad."""
    gripper = body.description.gripper
    goal = angle_from_opening(gripper, opening)
    opens = opening_sign(gripper) * (goal - start) > 0.0
    set_register(body.bus, body.gripper, "Goal_PWM", OPENING_PWM if opens else goal_pwm(effort))
    set_register(body.bus, body.gripper, "Goal_Position", ticks_from_angle(goal))
    return goal


def move_jaws(body: Body, opening: float, effort: float, stop_requested: StopRequested) -> GripReport:
    """Move the jaws until they arrive or stop on something; blocks.

    Args:
        body: The servos, their watchdog armed.
        opening: Clear opening, mm, that the gripper can do.
        effort: Fraction of the rated force, in (0, 1].
        stop_requested: Asked every cycle.

    Raises:
        MotionTimeout: The jaws neither arrive nor stop.
        BusError: A servo does not answer.
        ServoFault: A servo reports a hardware error.
    """
    clock, bus, servo, gripper = body.clock, body.bus, body.gripper, body.description.gripper
    start = angle_from_opening(gripper, body.state("grip").opening)
    goal = send_jaws(body, opening, start, effort)
    opens = opening > opening_from_angle(gripper, start)
    began = tick = heard = clock.now()
    detector = StopDetector(began, start)
    misses = MissCounter(body)
    deadline = began + TIMEOUT + abs(goal - start) / SLOWEST
    stopped_at: float | None = None
    standing = 0
    while True:
        tick = body.next_tick(tick, _PERIOD)
        silence = clock.now() - heard
        if silence > WATCHDOG / 2.0 and body.recheck():
            # The servos' watchdog has stopped the jaws, not a part: they set off again.
            start = angle_from_opening(gripper, body.state("grip").opening)
            detector, stopped_at, standing = StopDetector(clock.now(), start), None, 0
            deadline += silence
        heard = clock.now()
        found = body.read("grip")
        failure = misses.failure(found, "grip")
        if failure is not None:
            raise failure
        jaw = found[servo.servo_id]
        if jaw is None:
            continue
        now = clock.now()
        if stop_requested():
            set_register(bus, servo, "Goal_Position", ticks_from_angle(jaw.position))
            reached = opening_from_angle(gripper, jaw.position)
            return GripReport(False, False, reached, -opening_sign(gripper) * jaw.load)
        if not detector.stopped(now, jaw.position):
            stopped_at, standing = None, 0
        elif stopped_at is None:
            stopped_at = now
        standing += 1
        off = opening_from_angle(gripper, jaw.position) - opening
        arrived = abs(off) <= ARRIVED
        # Beyond their goal jaws only swing back: what stops them stands before it.
        short = (off < 0.0) is opens and not arrived
        blocked = short and stopped_at is not None and now - stopped_at >= GUARD and standing >= _STANDING_LOOKS
        if abs(jaw.velocity) < _STANDS and (arrived or blocked):
            state = body.state("grip")
            return GripReport(True, abs(state.opening - opening) > ARRIVED, state.opening, state.gripper_load)
        if now > deadline:
            remedy = "check the gripper for friction, or grip with more effort"
            raise MotionTimeout(servo.title, "grip", "the jaws neither arrive nor stop", remedy)

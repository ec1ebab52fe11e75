"""The `Arm` port over Dynamixel X servos: bring-up, streamed moves, grips, stops.

One thread moves the arm and owns the bus while it does; `request_stop` may come from anywhere. Moves are
streamed with the servos' own profiles off, so that the path is the planner's and can be slowed at any point.
While anything moves the servos' Bus Watchdog is armed: they stop by themselves when this process dies.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from controller.domain import ArmDescription, ArmState, GripReport, MoveReport, ServoCycle, Trajectory
from controller.errors import ArmError, LimitViolation
from controller.ports import ByteStream, Clock
from drivers.arm import bring_up
from drivers.arm.body import Body
from drivers.arm.bus import Bus
from drivers.arm.conversions import angle_from_opening, angle_from_ticks, ticks_from_angle
from drivers.arm.following import Follower, check_start, check_trajectory
from drivers.arm.gripping import move_jaws, send_jaws
from drivers.arm.replies import Identity
from drivers.arm.servos import TELEMETRY, read_telemetry_surely

_PAUSED_LOOK = 0.02
"""s between looks at whether a grip that waits may begin."""


def _stands() -> bool:
    return True


class DynamixelArm:
    """An arm of Dynamixel X servos.

    Args:
        description: What kind of arm it is.
        stream: The line to its bus.
        clock: Time.

    Attributes:
        bus: The bus, for diagnosis while nothing moves.
        inventory: What every servo said at `open`, by ID.
        changed: EEPROM registers that `open` had to change, for people.
    """

    def __init__(self, description: ArmDescription, stream: ByteStream, clock: Clock) -> None:
        self.bus = Bus(stream, clock, baud=description.baud)
        self.inventory: dict[int, Identity] = {}
        self.changed: tuple[str, ...] = ()
        self._body = Body(description, self.bus, clock)
        self._energised = False
        self._held = False
        self._paused = False
        self._standing: Callable[[], bool] = _stands
        self._stops = 0
        self._mover: int | None = None
        self._moving = threading.Lock()

    @property
    def description(self) -> ArmDescription:
        """What kind of arm this is."""
        return self._body.description

    # --- start and end --------------------------------------------------------------------------------

    def open(self, *, restart: bool = False) -> None:
        """Connect, check every servo and set it up. Moves nothing.

        A servo that holds torque keeps it, so that an arm left standing does not fall, unless its EEPROM has
        to be changed. May be called again after a loss.

        Args:
            restart: Reboot the servos that have shut themselves down, torque off, for a hardware error. One that
                still holds is left alone: it would let go.

        Raises:
            BusError: The port or a servo does not answer, or is another model than described.
            ServoFault: A servo reports a hardware error.
        """
        self.close()
        self.bus.open()
        servos = self._body.servos
        try:
            self.inventory = bring_up.take_inventory(self.bus, servos)
            if restart:
                alerts = {servo_id for servo_id, identity in self.inventory.items() if identity.alert}
                bring_up.restart(self.bus, self._body.clock, servos, alerts)
            self._body.state("open")
            self.changed = bring_up.configure(self.bus, servos)
            self.bus.probe_fast([servo.servo_id for servo in servos], *TELEMETRY)
        except BaseException:
            self.bus.close()
            raise

    def close(self) -> None:
        """Disconnect; harmless when not open. Torque is left as it is."""
        self.bus.close()
        self._energised = False

    def energise(self) -> ArmState:
        """Torque on where the arm stands.

        Raises:
            BusError: A servo does not answer or refuses.
            ServoFault: A servo reports a hardware error.
            ArmError: A joint stands outside its limits.
        """
        body = self._body
        with self._exclusive("energise"):
            found = read_telemetry_surely(self.bus, body.servos, "energise")
            ticks = {servo_id: ticks_from_angle(telemetry.position) for servo_id, telemetry in found.items()}
            bring_up.torque_on(self.bus, body.servos, ticks)
            goals = [self.bus.read_register(joint.servo_id, "Goal_Position") for joint in body.joints]
            body.goals = np.array([angle_from_ticks(goal) for goal in goals])
            self._energised = True
            return body.state()

    def relax(self) -> None:
        """Torque off at every servo, whatever single servos answer. The arm may sink.

        Raises:
            BusError: The port is lost, or (after all have been told) a servo did not confirm.
        """
        with self._exclusive("relax"):
            self._energised = False
            bring_up.torque_off(self.bus, self._body.servos)

    # --- stop -----------------------------------------------------------------------------------------

    def request_stop(self) -> None:
        """End the running move early, slowing along its path; from any thread or signal handler."""
        self._held = True
        self._stops += 1

    def clear_stop(self) -> None:
        """Allow motion again. Moves nothing; a move that was told to stop does not go on."""
        self._held = False

    def pause(self) -> None:
        """Slow the running move down along its path and hold there, torque on; from any thread or signal handler."""
        self._paused = True

    def resume(self) -> None:
        """Go on along the path from where `pause` has held the move; from any thread."""
        self._paused = False

    @property
    def holds(self) -> bool:
        """A pause is in force, and what it had to end has ended; from any thread."""
        return self._paused and self._standing()

    def _stop_watch(self) -> Callable[[], bool]:
        """Says whether a stop was asked for since now, even if it has been cleared again."""
        stops = self._stops
        return lambda: self._held or self._stops != stops

    # --- state and moves ------------------------------------------------------------------------------

    def state(self) -> ArmState:
        """What the servos say now; while another thread moves the arm, what they said last to it.

        Raises:
            BusError: A servo did not answer.
            ServoFault: A servo reports a hardware error.
        """
        latest = self._body.latest
        if self._mover not in {None, threading.get_ident()} and latest is not None:
            return latest
        return self._body.state()

    def listen(self, listener: Callable[[ServoCycle], None] | None) -> None:
        """Have every complete cycle of a streamed move told from now on, inside the motion loop; None: no longer."""
        self._body.listener = listener

    def follow(self, trajectory: Trajectory, opening: float | None = None, after: float = 0.0) -> MoveReport:
        """Stream a trajectory to the servos; blocks until it has ended and the joints are settled.

        Args:
            trajectory: Starts where the arm stands.
            opening: Clear opening (mm) that the empty jaws take on the way; None leaves them alone.
            after: When on the way the jaws begin, s along the trajectory.

        Raises:
            LimitViolation: It does not start where the arm stands, or leaves the joints' limits; nothing moved.
            MotionTimeout: A joint does not follow, or the machine is too slow to stream.
            BusError: The bus failed for longer than a few cycles; the goals are held.
            ServoFault: A servo reports a hardware error or has restarted; the others have slowed down and hold.
        """
        body = self._body
        stop_requested = self._stop_watch()
        with self._exclusive("follow"):
            self._need_torque("follow")
            check_trajectory(body, trajectory)
            state = body.state()
            check_start(body, trajectory, state)
            if stop_requested():
                return MoveReport(False, state)
            with body.watched():
                errands: list[tuple[float, Callable[[], object]]] = []
                if opening is not None:
                    gripper, now = self.description.gripper, state.opening
                    wanted = opening = min(max(opening, gripper.opening[0]), gripper.opening[1])
                    errands = [(after, lambda: send_jaws(body, wanted, angle_from_opening(gripper, now)))]
                move = Follower(body, trajectory, state, stop_requested, lambda: self._paused, errands, opening)
                with self._under_way(move.stands):
                    return move.run()

    def grip(self, opening: float, effort: float = 1.0) -> GripReport:
        """Move the jaws to a clear opening (mm) or until they stop on something; blocks.

        Args:
            opening: Wanted clear opening, mm; clipped to what the gripper can do.
            effort: Fraction of the gripper's rated holding force, in (0, 1].

        Raises:
            LimitViolation: `effort` is out of range.
            MotionTimeout: The jaws neither arrive nor stop.
            BusError: A servo does not answer for several cycles.
            ServoFault: A servo reports a hardware error.
        """
        if not 0.0 < effort <= 1.0:
            raise LimitViolation(f"grip: effort {effort:g} is not in (0, 1]")
        body = self._body
        stop_requested = self._stop_watch()
        with self._exclusive("grip"):
            self._need_torque("grip")
            while self._paused and not stop_requested():
                body.clock.sleep(_PAUSED_LOOK)
            if stop_requested():
                state = body.state()
                return GripReport(False, False, state.opening, state.gripper_load)
            low, high = body.description.gripper.opening
            with self._under_way(lambda: False), body.watched():
                return move_jaws(body, min(max(opening, low), high), effort, stop_requested)

    def _need_torque(self, operation: str) -> None:
        if not self._energised:
            raise ArmError(self.description.name, operation, "torque is off", "energise the arm first")

    @contextmanager
    def _under_way(self, standing: Callable[[], bool]) -> Iterator[None]:
        """Something moves, unless `standing` says that it does not."""
        self._standing = standing
        try:
            yield
        finally:
            self._standing = _stands

    @contextmanager
    def _exclusive(self, operation: str) -> Iterator[None]:
        """One motion at a time."""
        if not self._moving.acquire(blocking=False):
            raise ArmError(self.description.name, operation, "the arm is busy with another move", "wait for its end")
        self._mover = threading.get_ident()
        try:
            yield
        finally:
            self._mover = None
            self._moving.release()

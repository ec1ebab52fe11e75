"""The servos of one arm as a whole: what moves share, whether joints stream or jaws close."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress

import numpy as np
from numpy.typing import NDArray

from controller.domain import ArmDescription, ArmState, ServoCycle
from controller.errors import ArmError, BusError
from controller.ports import Clock
from drivers.arm import bring_up
from drivers.arm.bus import Bus
from drivers.arm.control_table import WATCHDOG_UNIT
from drivers.arm.conversions import opening_from_angle, opening_sign, stall_angle, ticks_from_angles
from drivers.arm.servos import Telemetry, read_telemetry, read_telemetry_surely, servos_of

Array = NDArray[np.float64]

WATCHDOG = 0.200
"""s of silence after which the servos stop by themselves while something moves."""

MISSED_CYCLES = 5
"""Answers in a row that a servo may miss while it moves."""

_WATCHDOG_ATTEMPTS = 3

StopRequested = Callable[[], bool]


class Body:
    """Bus, clock and servos of one arm.

    Args:
        description: What kind of arm it is.
        bus: The bus.
        clock: Time.

    Attributes:
        servos: Joints from base to tool, the gripper, then the shadows.
        joints: From base to tool.
        gripper: The gripper's servo.
        stall: ndarray of shape (J,), rad: how far from a joint its goal has the servo push with its whole torque.
        goals: ndarray of shape (J,), rad: what the joints were told last.
        listener: Is told every complete cycle of a streamed move, or None.
    """

    def __init__(self, description: ArmDescription, bus: Bus, clock: Clock) -> None:
        self.description = description
        self.bus = bus
        self.clock = clock
        self.servos = servos_of(description)
        self.joints = self.servos[: len(description.joints)]
        self.gripper = self.servos[len(description.joints)]
        self.stall: Array = np.array([stall_angle(joint.gains[0]) for joint in self.joints])
        self.goals: Array = np.zeros(len(self.joints))
        self._heard: tuple[float, Mapping[int, Telemetry]] | None = None
        self.listener: Callable[[ServoCycle], None] | None = None

    def read(self, operation: str) -> dict[int, Telemetry | None]:
        """One look at every servo; None where one did not answer. Raises BusError, ServoFault."""
        found = read_telemetry(self.bus, self.servos, operation)
        complete = {servo_id: telemetry for servo_id, telemetry in found.items() if telemetry is not None}
        if len(complete) == len(self.servos):
            self._heard = self.clock.now(), complete
        return found

    @property
    def latest(self) -> ArmState | None:
        """The last complete state, or None; from any thread."""
        heard = self._heard
        return None if heard is None else self._state(*heard)

    def state(self, operation: str = "read state") -> ArmState:
        """The whole arm, asking again where a servo does not answer. Raises BusError, ServoFault."""
        found = read_telemetry_surely(self.bus, self.servos, operation)
        self._heard = self.clock.now(), found
        return self._state(*self._heard)

    def _state(self, at: float, found: Mapping[int, Telemetry]) -> ArmState:
        joints = [found[joint.servo_id] for joint in self.joints]
        jaw = found[self.gripper.servo_id]
        gripper = self.description.gripper
        return ArmState(
            at=at,
            positions=np.array([telemetry.position for telemetry in joints]),
            velocities=np.array([telemetry.velocity for telemetry in joints]),
            opening=opening_from_angle(gripper, jaw.position),
            gripper_load=-opening_sign(gripper) * jaw.load,
            voltage=min(telemetry.voltage for telemetry in found.values()),
            temperature=float(max(telemetry.temperature for telemetry in found.values())),
        )

    def send_goals(self, goals: Array) -> None:
        """Tell the joints (their shadows listen too). Nobody answers. Raises BusError, code `lost`."""
        ticks = ticks_from_angles(goals).tolist()
        self.bus.sync_write("Goal_Position", {j.servo_id: t for j, t in zip(self.joints, ticks, strict=True)})
        self.goals = goals

    def next_tick(self, tick: float, period: float) -> float:
        """Sleep until `period` after `tick` and return that time; a late cycle moves all that follow."""
        tick += period
        wait = tick - self.clock.now()
        if wait <= 0.0:
            return tick - wait
        self.clock.sleep(wait)
        return tick

    # --- watchdog -------------------------------------------------------------------------------------

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Servos checked and their Bus Watchdog armed, for as long as something moves.

        Raises:
            ServoFault: A servo has restarted.
            BusError: A servo does not answer, or does not take the watchdog.
        """
        self.recheck()
        try:
            yield
        finally:
            # A watchdog left armed stops the servos where they hold, and the next move clears it.
            with suppress(ArmError):
                self._write_watchdog(0)

    def recheck(self) -> bool:
        """Arm the watchdog; True when it had tripped: the joints now hold where it stopped them, the jaws go on.

        Raises:
            ServoFault: A servo has restarted.
            BusError: A servo does not answer, or does not take the watchdog.
        """
        ram = bring_up.read_ram(self.bus, self.servos)
        bring_up.check_still_ours(self.servos, ram)
        tripped = any(state.tripped for state in ram.values())
        if tripped:
            # Until it is cleared goals are refused; the joints' from before must not come into force again. The jaws'
            # must: they squeeze what they hold.
            jaws = self.bus.read_register(self.gripper.servo_id, "Goal_Position")
            self._write_watchdog(0)
            self.send_goals(self.state("clear Bus_Watchdog").positions)
            bring_up.set_register(self.bus, self.gripper, "Goal_Position", jaws)
        self._write_watchdog(round(WATCHDOG / WATCHDOG_UNIT))
        return tripped

    def _write_watchdog(self, value: int) -> None:
        ids = [servo.servo_id for servo in self.servos]
        for _ in range(_WATCHDOG_ATTEMPTS):
            self.bus.sync_write("Bus_Watchdog", dict.fromkeys(ids, value))
            if all(found == value for found in self.bus.sync_read_register(ids, "Bus_Watchdog").values()):
                return
        raise BusError(self.bus.name, "write Bus_Watchdog", "refused", "servos keep another value", "restart the arm")


class MissCounter:
    """Counts answers missed in a row, servo by servo."""

    def __init__(self, body: Body) -> None:
        self._servos = body.servos
        self._missed = dict.fromkeys((servo.servo_id for servo in body.servos), 0)

    def failure(self, found: Mapping[int, Telemetry | None], operation: str) -> BusError | None:
        """Take one cycle in; the error once a servo has been silent for too long."""
        for servo in self._servos:
            if found.get(servo.servo_id) is not None:
                self._missed[servo.servo_id] = 0
                continue
            self._missed[servo.servo_id] += 1
            if self._missed[servo.servo_id] >= MISSED_CYCLES:
                cause = f"no answer in {MISSED_CYCLES} cycles"
                return BusError(servo.title, operation, "timeout", cause, "check its cable and the 12 V supply")
        return None

"""The motor side of a servo: where it should be, and what it therefore does to its shaft.

Positions are register ticks as the bus sees them (after Drive_Mode and Homing_Offset); the plant's are rad
of the bare shaft.

Source: ROBOTIS e-Manual, `dxl/x/<model>`, "Operating Mode", "Drive Mode", "Homing Offset", "Bus Watchdog".
"""

from __future__ import annotations

import math
from collections.abc import Callable

from sim_backends.plant import Drive, Plant, Shaft
from sim_backends.virtual_dynamixel.control_loop import ControlLoop
from sim_backends.virtual_dynamixel.control_table import ControlTable
from sim_backends.virtual_dynamixel.health import Health
from sim_backends.virtual_dynamixel.models import (
    CURRENT_MODE,
    CURRENT_POSITION_MODE,
    EXTENDED_MODE,
    POSITION_MODE,
    PWM_MODE,
    TICKS_PER_RAD,
    VELOCITY_MODE,
    ServoModel,
)
from sim_backends.virtual_dynamixel.profile import Profile, plan

CENTER = 2048
"""Ticks in the middle of the encoder."""

_POSITION_MODES = frozenset({POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE})
COMMANDED = {PWM_MODE: "Goal_PWM", CURRENT_MODE: "Goal_Current", VELOCITY_MODE: "Goal_Velocity"}
"""What each mode without a position follows."""


class Motor:
    """Goal, profile and control loop of one servo. Slave mode (Drive_Mode bit 1) has no effect.

    Args:
        model: Which servo.
        table: Its registers.
        health: Its supply, and whether it may be energised.
        plant: The mechanical world.
        shaft_id: Its shaft there.
        keeps_goal: See `ServoSpec`.
        on_change: Called when `busy` may have changed.

    Attributes:
        torque: It is energised.
        tripped: The bus watchdog has stopped it.
        sign: -1 where Drive_Mode reverses the direction.
        wakes_on_goal: Drive_Mode bit 3: a goal energises it.
        profile: The profile that runs, or None.
        goal: Where it is to go, ticks.
        command: Where the position loop wants it now, ticks.
    """

    def __init__(
        self,
        model: ServoModel,
        table: ControlTable,
        health: Health,
        plant: Plant,
        shaft_id: int,
        keeps_goal: bool,
        on_change: Callable[[], None],
    ) -> None:
        self._model = model
        self._table = table
        self._health = health
        self._plant = plant
        self._shaft_id = shaft_id
        self._keeps_goal = keeps_goal
        self._on_change = on_change
        self._loop = ControlLoop(model)
        self._drive: Drive | None = None
        self._mode = POSITION_MODE
        self._homing = 0
        self._offset = float(CENTER)
        self._time_based = False
        self.torque = False
        self.tripped = False
        self.sign = 1.0
        self.wakes_on_goal = False
        self.profile: Profile | None = None
        self.goal = 0.0
        self.command = 0.0

    @property
    def positions(self) -> bool:
        """The operating mode goes to positions."""
        return self._mode in _POSITION_MODES

    @property
    def busy(self) -> bool:
        """Every physics step matters: a profile runs, or a loop needs the shaft's state."""
        return self.torque and (self.profile is not None or self._loop.needs_steps)

    def shaft(self) -> Shaft:
        """Its shaft."""
        return self._plant.shaft(self._shaft_id)

    def position(self, shaft: Shaft) -> float:
        """Ticks."""
        return self.sign * shaft.angle * TICKS_PER_RAD + self._offset

    # --- settings -----------------------------------------------------------------------------------------

    def power_up(self) -> None:
        """Start anew, torque off."""
        self.torque = False
        self.tripped = False
        self.change_mode()

    def change_mode(self) -> None:
        """Operating_Mode has changed: default gains, no profile, Goal_PWM and Goal_Current at their limits.

        Source: e-Manual, "Operating Mode(11)".
        """
        table = self._table
        table.reset(lambda register: register.name.endswith("_Gain") or register.name.startswith("Profile_"))
        table.set("Goal_PWM", table.get("PWM_Limit"))
        if self._model.current_limit:
            table.set("Goal_Current", table.get("Current_Limit"))
        self.load()

    def load(self) -> None:
        """Mode, direction or offset have changed: count the position anew."""
        table = self._table
        self._mode = table.get("Operating_Mode")
        drive_mode = table.get("Drive_Mode")
        self.sign = -1.0 if drive_mode & 1 else 1.0
        self._time_based = bool(drive_mode & 4)
        self.wakes_on_goal = bool(drive_mode & 8)
        homing = table.get("Homing_Offset")
        # Position mode honours one quarter turn of Homing_Offset. Assumption: a larger one counts as none.
        self._homing = homing if self._mode != POSITION_MODE or abs(homing) <= 1024 else 0
        self._loop.tune(table, self._mode, self._health.supply)
        self.settle()

    def tune(self) -> None:
        """Gains, goals other than positions, limits or the supply have changed."""
        self._loop.tune(self._table, self._mode, self._health.supply)
        self._push()
        self._on_change()

    def settle(self) -> None:
        """Count the position from within one turn, as at power-up; the goal follows the shaft."""
        shaft = self.shaft()
        raw = CENTER + self.sign * shaft.angle * TICKS_PER_RAD
        self._offset = CENTER + self._homing - 4096.0 * math.floor(raw / 4096.0)
        self.profile = None
        self._hold(shaft)
        self._table.set("Goal_Position", int(self.goal))
        self._push()

    def _hold(self, shaft: Shaft) -> None:
        """Want to be where the shaft is."""
        self.goal = self.command = float(round(self.position(shaft)))
        self._loop.reset()

    # --- orders -------------------------------------------------------------------------------------------

    def energise(self, asked: int | None = None) -> None:
        """Torque on; the goal becomes `asked` (ticks), else the present position. Refused after a shutdown.

        Assumption: Goal_PWM, Goal_Current and Goal_Velocity start at 0 in the modes they command.
        """
        if self._health.shut_down:
            return
        table = self._table
        if not self.torque:
            self.torque = True
            if asked is None and self._keeps_goal:
                asked = table.get("Goal_Position")
            if self._mode == POSITION_MODE:
                self.settle()
            else:
                self._hold(self.shaft())
                table.set("Goal_Position", int(self.goal))
            if self._mode in COMMANDED:
                table.set(COMMANDED[self._mode], 0)
            if asked is not None:
                table.set("Goal_Position", asked)
                self.aim(asked)
        table.set("Torque_Enable", 1)
        self.tune()

    def relax(self) -> None:
        """Torque off."""
        self.torque = False
        self.profile = None
        self._table.set("Torque_Enable", 0)
        self.tune()

    def aim(self, value: int) -> None:
        """Goal_Position has been written."""
        if not self.torque:
            if self.wakes_on_goal:
                self.energise(value)
            return
        if self._mode not in _POSITION_MODES:
            return
        self.goal = float(value)
        memory = self._table.memory
        if not (memory[112] or memory[113]):  # Profile_Velocity, which fits in its low two bytes
            self.profile = None
            if self.goal != self.command:
                self._loop.jump(self.goal - self.command)
                self.command = self.goal
                self._push()
            return
        now = self._plant.now()
        velocity = self.profile.at(now)[1] if self.profile else 0.0
        speed, ramp = self._table.get("Profile_Velocity"), self._table.get("Profile_Acceleration")
        self.profile = plan(now, self.command, velocity, self.goal, speed, ramp, self._time_based)
        self._on_change()

    def trip(self) -> None:
        """The bus has been silent for too long: stop here.

        Assumption: the torque stays on and holds the position where the watchdog tripped.
        """
        self.tripped = True
        self.profile = None
        self._hold(self.shaft())
        if self._mode in COMMANDED:
            self._table.set(COMMANDED[self._mode], 0)
        self.tune()

    def step(self, dt: float, now: float) -> None:
        """One period of the control loop; called before a physics step of `dt` s while `busy`."""
        velocity = 0.0
        if self.profile is not None:
            self.command, velocity, ended = self.profile.at(now + dt)
            if ended:
                self.profile = None
                self._on_change()
        if self._loop.needs_steps:
            shaft = self.shaft()
            error = self.command - self.position(shaft)
            self._loop.step(error, velocity, self.sign * shaft.velocity, dt)
        self._push()

    def _push(self) -> None:
        """Tell the plant what the motor does, if that has changed."""
        if not self.torque:
            drive = Drive(damping=self._model.back_emf)
        else:
            target = self.sign * (self.command - self._offset) / TICKS_PER_RAD
            drive = self._loop.drive(target, self.sign)
        if drive != self._drive:
            self._drive = drive
            self._plant.drive(self._shaft_id, drive)

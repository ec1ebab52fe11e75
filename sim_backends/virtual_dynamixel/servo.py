"""One simulated servo: its registers, its control loop and its ways to fail.

The servo meets the mechanical world only through a `Plant`: it reads its shaft and says what its motor does.
Positions inside are register ticks as the bus sees them (after Drive_Mode and Homing_Offset); the plant's
are rad of the bare shaft.

Source: ROBOTIS e-Manual, `dxl/x/<model>`, section "Control Table Description". What no manual says is marked
`Assumption:`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from sim_backends.plant import Drive, Plant, Shaft
from sim_backends.virtual_dynamixel.control_loop import ControlLoop
from sim_backends.virtual_dynamixel.control_table import ControlTable
from sim_backends.virtual_dynamixel.models import (
    CURRENT_MODE,
    CURRENT_POSITION_MODE,
    EXTENDED_MODE,
    MODELS,
    POSITION_MODE,
    PWM_FULL,
    PWM_MODE,
    TICKS_PER_RAD,
    VELOCITY_MODE,
    VELOCITY_UNIT,
)
from sim_backends.virtual_dynamixel.profile import Profile, rectangular, timed, trapezoidal
from sim_backends.virtual_dynamixel.protocol import ALERT, Fail
from sim_backends.virtual_dynamixel.registers import EEPROM, POSITION_LIMIT_EXTENDED, Register

CENTER = 2048
SPEED_UNIT = 0.229 / 60 * 4096
"""ticks/s per unit of Profile_Velocity."""
RAMP_UNIT = 214.577 / 3600 * 4096
"""ticks/s^2 per unit of Profile_Acceleration (rev/min^2)."""

ERROR_VOLTAGE, ERROR_OVERHEAT, ERROR_ENCODER, ERROR_SHOCK, ERROR_OVERLOAD = 0x01, 0x04, 0x08, 0x10, 0x20

HOUSEKEEPING = 0.02
"""s between looks at load, temperature and voltage."""
REBOOT_TIME = 0.3
"""s without an answer after a reboot. Assumption."""
OVERLOAD_TIME = 1.5
"""s of sustained load until the overload error. Assumption."""
OVERLOAD_SHARE = 0.8
"""Share of the stall torque from which a load counts as overload. Assumption."""
AMBIENT = 30.0
"""degC at rest. Assumption."""
THERMAL_RESISTANCE = 4.0
"""K per W of winding loss, case to air. Assumption: a servo stalled at full voltage goes to its limit."""
THERMAL_TIME = 300.0
"""s, first-order warming of the case. Assumption."""
IN_POSITION, FOLLOWING_ERROR = 10, 100
"""Ticks that decide bits 0 and 3 of Moving_Status. Assumption."""

_FIRST_LIVE, _LAST_LIVE = 120, 147
_GOALS = frozenset({"Goal_PWM", "Goal_Current", "Goal_Velocity", "Goal_Position"})
_POSITION_MODES = frozenset({POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE})
_COMMANDED = {PWM_MODE: "Goal_PWM", CURRENT_MODE: "Goal_Current", VELOCITY_MODE: "Goal_Velocity"}
_LIMITED = {"Goal_PWM": "PWM_Limit", "Goal_Current": "Current_Limit", "Goal_Velocity": "Velocity_Limit"}
_LIVE = struct.Struct("<HBBhhiiiiHB")


@dataclass(frozen=True, slots=True)
class ServoSpec:
    """A servo as it is mounted on the bus, torque off.

    Attributes:
        servo_id: Address, 0..252.
        model: e.g. `XM430-W350`.
        settings: Registers that differ from the factory's, by name.
        keeps_goal: Torque on leaves Goal_Position alone, so that an old goal makes the servo jump; else it
            becomes the present position. Assumption: no manual says which.
    """

    servo_id: int
    model: str
    settings: tuple[tuple[str, int], ...] = ()
    keeps_goal: bool = False


class VirtualServo:
    """One servo.

    Args:
        spec: What it is.
        plant: The mechanical world.
        baud_code: Initial value of Baud_Rate.
    """

    def __init__(self, spec: ServoSpec, plant: Plant, baud_code: int) -> None:
        self.model = MODELS[spec.model]
        self.shaft_id = spec.servo_id
        self.silent = False
        """Answers nothing and obeys nothing, as with a broken cable behind it."""
        self.supply = self.model.voltage
        """Voltage it is fed with, V."""
        self.temperature = AMBIENT
        self.on_change: Callable[[], None] = lambda: None
        """Called when ID, baud rate or the need for attention has changed."""
        self._plant = plant
        self._keeps_goal = spec.keeps_goal
        self.table = ControlTable(self.model)
        self.table.set("ID", spec.servo_id)
        self.table.set("Baud_Rate", baud_code)
        for name, value in spec.settings:
            self.table.set(name, value)
        self._drive: Drive | None = None
        self._profile: Profile | None = None
        self._overload_since: float | None = None
        self._asleep_until = -math.inf
        self._shut_down = False
        self._loop = ControlLoop(self.model)
        self._goal = 0.0
        self._command = 0.0
        self._offset = float(CENTER)
        self._power_up()

    # --- what the bus needs at every packet ---------------------------------------------------------------

    @property
    def alert(self) -> int:
        """The alert bit of the error byte."""
        return ALERT if self._error_bits else 0

    @property
    def answer_level(self) -> int:
        """Status_Return_Level: 0 ping only, 1 ping and read, 2 everything."""
        return self.table.memory[68]

    def awake(self, now: float) -> bool:
        """It listens to the bus."""
        return not self.silent and now >= self._asleep_until

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """(error byte, data); no data on an error."""
        fail = self.table.check_read(address, length)
        if fail:
            return fail | self.alert, b""
        if self.table.spans(address, length, _FIRST_LIVE, _LAST_LIVE):
            self._refresh()
        return self.alert, self.table.read(address, length)

    def write(self, address: int, data: bytes) -> int:
        """Store and obey; the error byte."""
        if address == 116 and len(data) == 4:
            return self._write_goal_position(int.from_bytes(data, "little", signed=True)) | self.alert
        fail, writes = self.table.parse_write(address, data)
        fail = fail or self._check(writes)
        if not fail:
            self._commit(writes)
        return fail | self.alert

    def register_write(self, address: int, data: bytes) -> int:
        """Keep a write for `action`; the error byte."""
        fail, writes = self.table.parse_write(address, data)
        fail = fail or self._check(writes)
        if not fail:
            self.table.registered = writes
            self.table.set("Registered_Instruction", 1)
        return fail | self.alert

    def action(self) -> None:
        """Carry out the registered write. Assumption: it is checked again and dropped when no longer valid."""
        writes, self.table.registered = self.table.registered, []
        self.table.set("Registered_Instruction", 0)
        if writes and not self._check(writes):
            self._commit(writes)

    # --- life and death -----------------------------------------------------------------------------------

    def _power_up(self) -> None:
        table = self.table
        table.reset(lambda register: register.access != EEPROM and not register.name.startswith("Model_"))
        table.set("Model_Number", self.model.number)
        self._error_bits = 0
        self._shut_down = False
        self._torque = False
        self._tripped = False
        self._overload_since = None
        self._watch = 0.0
        self._load_mode(reset_gains=True)
        self._settle()

    def reboot(self, now: float) -> None:
        """RAM back to its initial values, torque off, errors cleared; silent for REBOOT_TIME."""
        self._power_up()
        self._asleep_until = now + REBOOT_TIME
        self.on_change()

    def factory_reset(self, keep_id: bool, keep_baud: bool, now: float) -> None:
        """EEPROM back to the factory's values, then a reboot."""
        kept = {"ID": keep_id, "Baud_Rate": keep_baud}
        self.table.reset(lambda register: register.access == EEPROM and not kept.get(register.name, False))
        self.reboot(now)

    def clear_turns(self) -> Fail:
        """Bring the present position into one turn. Refused while the shaft is driven."""
        if self._torque:
            return Fail.RESULT
        self._settle()
        return Fail.NONE

    def fail(self, bits: int) -> None:
        """Raise hardware errors; those that Shutdown selects take the torque off until a reboot."""
        if not bits & ~self._error_bits:
            return
        self._error_bits |= bits
        self.table.set("Hardware_Error_Status", self._error_bits)
        if self._error_bits & self.table.get("Shutdown"):
            self._shut_down = True
            self._set_torque(False)

    # --- writes -------------------------------------------------------------------------------------------

    def _check(self, writes: list[tuple[Register, int]]) -> Fail:
        """Rules that depend on other registers and on the state.

        Assumption: values beyond a limit register answer Data Limit (6), values beyond the register's own
        range Data Range (4).
        """
        for register, value in writes:
            name = register.name
            if name in _GOALS and self._tripped:
                return Fail.DATA_RANGE
            if name == "Operating_Mode" and value not in self.model.modes:
                return Fail.DATA_RANGE
            if name == "Torque_Enable" and value and self._shut_down:
                return Fail.ACCESS
            if name in _LIMITED and abs(value) > self.table.get(_LIMITED[name]):
                return Fail.DATA_LIMIT
            if name == "Goal_Position":
                fail = self._check_goal_position(value)
                if fail:
                    return fail
        return Fail.NONE

    def _check_goal_position(self, value: int) -> Fail:
        if self._tripped:
            return Fail.DATA_RANGE
        if self._mode == POSITION_MODE:
            return Fail.NONE if self._lowest <= value <= self._highest else Fail.DATA_LIMIT
        return Fail.NONE if abs(value) <= POSITION_LIMIT_EXTENDED else Fail.DATA_RANGE

    def _commit(self, writes: list[tuple[Register, int]]) -> None:
        for register, value in writes:
            self.table.store(register, value)
            self._obey(register.name, value)

    def _obey(self, name: str, value: int) -> None:
        """What a stored value changes."""
        if name == "Goal_Position":
            self._new_goal(value)
        elif name == "Torque_Enable":
            self._set_torque(bool(value))
        elif name == "Bus_Watchdog":
            self._watch = value * 0.02
            self._tripped = False
            self.on_change()
        elif name == "Operating_Mode":
            self._load_mode(reset_gains=True)
            self._settle()
        elif name in ("ID", "Secondary_ID", "Baud_Rate"):
            self.on_change()
        elif name in ("Drive_Mode", "Homing_Offset"):
            self._load_mode(reset_gains=False)
            self._settle()
        elif name in ("Min_Position_Limit", "Max_Position_Limit", "PWM_Limit", "Moving_Threshold"):
            self._load_mode(reset_gains=False)
        elif name in ("Goal_PWM", "Goal_Current", "Goal_Velocity") or name.endswith("_Gain"):
            if self._wakes_on_goal and name in _GOALS and not self._torque:
                self._set_torque(True)
            self._tune()
            self._push()
            self.on_change()

    def _write_goal_position(self, value: int) -> int:
        fail = self._check_goal_position(value)
        if fail:
            return fail
        self.table.memory[116:120] = value.to_bytes(4, "little", signed=True)
        self._new_goal(value)
        return 0

    def _new_goal(self, value: int) -> None:
        if not self._torque:
            if not self._wakes_on_goal:
                return
            self._set_torque(True, goal=value)
            return
        if self._mode not in _POSITION_MODES:
            return
        self._goal = float(value)
        memory = self.table.memory
        if not (memory[112] or memory[113]):  # Profile_Velocity, which fits in its low two bytes
            self._profile = None
            if self._goal != self._command:
                self._loop.jump(self._goal - self._command)
                self._command = self._goal
                self._push()
            return
        speed, ramp = self.table.get("Profile_Velocity"), self.table.get("Profile_Acceleration")
        now = self._plant.now()
        velocity = self._profile.at(now)[1] if self._profile else 0.0
        if self._time_based:
            self._profile = timed(now, self._command, velocity, self._goal, speed * 1e-3, ramp * 1e-3)
        elif ramp:
            self._profile = trapezoidal(
                now, self._command, velocity, self._goal, speed * SPEED_UNIT, ramp * RAMP_UNIT
            )
        else:
            self._profile = rectangular(now, self._command, self._goal, speed * SPEED_UNIT)
        self.on_change()

    # --- state --------------------------------------------------------------------------------------------

    def _load_mode(self, reset_gains: bool) -> None:
        """Take over the registers that the control loop works with.

        A change of Operating_Mode loads default gains, sets the profile to 0 and Goal_PWM and Goal_Current to
        their limits. Source: e-Manual, "Operating Mode(11)".
        """
        table = self.table
        self._mode = table.get("Operating_Mode")
        drive_mode = table.get("Drive_Mode")
        self._sign = -1.0 if drive_mode & 1 else 1.0
        self._time_based = bool(drive_mode & 4)
        self._wakes_on_goal = bool(drive_mode & 8)
        self._lowest, self._highest = table.get("Min_Position_Limit"), table.get("Max_Position_Limit")
        self._still = table.get("Moving_Threshold")
        homing = table.get("Homing_Offset")
        # Position mode honours one quarter turn of Homing_Offset. Assumption: a larger one counts as none.
        self._homing = homing if self._mode != POSITION_MODE or abs(homing) <= 1024 else 0
        if reset_gains:
            table.reset(lambda register: register.name.endswith("_Gain") or register.name.startswith("Profile_"))
            table.set("Goal_PWM", table.get("PWM_Limit"))
            if self.model.current_limit:
                table.set("Goal_Current", table.get("Current_Limit"))
        self._profile = None
        self._tune()

    def _tune(self) -> None:
        self._loop.tune(self.table, self._mode, self.supply)

    def _settle(self) -> None:
        """Count the position from within one turn, as at power-up; the goal follows the shaft."""
        raw = CENTER + self._sign * self._plant.shaft(self.shaft_id).angle * TICKS_PER_RAD
        self._offset = CENTER + self._homing - 4096.0 * math.floor(raw / 4096.0)
        present = self._position(self._plant.shaft(self.shaft_id))
        self._goal = self._command = float(round(present))
        self.table.set("Goal_Position", round(present))
        self._profile = None
        self._loop.reset()
        self._push()

    def _position(self, shaft: Shaft) -> float:
        return self._sign * shaft.angle * TICKS_PER_RAD + self._offset

    def _set_torque(self, on: bool, goal: int | None = None) -> None:
        """Torque on takes the present position for the goal and stops what other modes would do.

        Assumption: Goal_PWM, Goal_Current and Goal_Velocity start at 0 in the modes they command.
        """
        table = self.table
        if on and not self._torque:
            self._torque = True
            asked = table.get("Goal_Position")
            if self._mode == POSITION_MODE:
                self._settle()
            else:
                self._goal = self._command = float(round(self._position(self._plant.shaft(self.shaft_id))))
                self._loop.reset()
            if self._mode in _COMMANDED:
                table.set(_COMMANDED[self._mode], 0)
            if goal is not None or self._keeps_goal:
                asked = asked if goal is None else goal
                table.set("Goal_Position", asked)
                self._new_goal(asked)
            else:
                table.set("Goal_Position", int(self._goal))
        elif not on:
            self._torque = False
            self._profile = None
        table.set("Torque_Enable", int(self._torque))
        self._tune()
        self._push()
        self.on_change()

    def _push(self) -> None:
        """Tell the plant what the motor does, if that has changed."""
        if not self._torque:
            drive = Drive(damping=self.model.back_emf)
        else:
            target = self._sign * (self._command - self._offset) / TICKS_PER_RAD
            drive = self._loop.drive(target, self._sign)
        if drive != self._drive:
            self._drive = drive
            self._plant.drive(self.shaft_id, drive)

    # --- time ---------------------------------------------------------------------------------------------

    @property
    def busy(self) -> bool:
        """Every physics step matters: a profile runs, or a loop needs the shaft's state."""
        return self._torque and (self._profile is not None or self._loop.needs_steps)

    @property
    def watch(self) -> float:
        """Timeout of the armed bus watchdog, s; 0 when it is not armed."""
        return self._watch if self._torque and not self._tripped else 0.0

    def trip(self) -> None:
        """The bus has been silent for too long: stop here and refuse goals until 0 is written.

        Assumption: the torque stays on and holds the position where the watchdog tripped.
        """
        self._tripped = True
        self.table.set("Bus_Watchdog", -1)
        self._profile = None
        shaft = self._plant.shaft(self.shaft_id)
        self._goal = self._command = self._position(shaft)
        if self._mode in _COMMANDED:
            self.table.set(_COMMANDED[self._mode], 0)
        self._loop.reset()
        self._tune()
        self._push()
        self.on_change()

    def step(self, dt: float, now: float) -> None:
        """One period of the control loop; called before a physics step while `busy`."""
        velocity = 0.0
        if self._profile is not None:
            self._command, velocity, ended = self._profile.at(now + dt)
            if ended:
                self._profile = None
                self.on_change()
        if self._loop.needs_steps:
            shaft = self._plant.shaft(self.shaft_id)
            error = self._command - self._position(shaft)
            self._loop.step(error, velocity, self._sign * shaft.velocity, dt)
        self._push()

    def housekeeping(self, dt: float, now: float) -> None:
        """Load, temperature and voltage, every HOUSEKEEPING s."""
        table, model = self.table, self.model
        torque = abs(self._plant.shaft(self.shaft_id).torque) if self._torque else 0.0
        current = torque / model.torque_constant
        loss = current * current * model.voltage / model.stall_current
        self.temperature += dt / THERMAL_TIME * (AMBIENT + THERMAL_RESISTANCE * loss - self.temperature)
        if torque < OVERLOAD_SHARE * model.stall_torque * self.supply / model.voltage:
            self._overload_since = None
        elif self._overload_since is None:
            self._overload_since = now
        elif now - self._overload_since >= OVERLOAD_TIME:
            self.fail(ERROR_OVERLOAD)
        if self.temperature > table.get("Temperature_Limit"):
            self.fail(ERROR_OVERHEAT)
        volts = round(self.supply * 10)
        if not table.get("Min_Voltage_Limit") <= volts <= table.get("Max_Voltage_Limit"):
            self.fail(ERROR_VOLTAGE)

    def heal(self) -> None:
        """Cable, supply and temperature are as they should be again; latched errors stay."""
        self.silent = False
        self.temperature = AMBIENT
        self.set_supply(self.model.voltage)

    def set_supply(self, volts: float) -> None:
        """Feed the servo with another voltage; torque and speed follow."""
        self.supply = volts
        self._tune()
        self._push()

    # --- live registers -----------------------------------------------------------------------------------

    def _refresh(self) -> None:
        model = self.model
        now = self._plant.now()
        shaft = self._plant.shaft(self.shaft_id)
        sign = self._sign
        position = round(self._position(shaft))
        velocity = round(sign * shaft.velocity / VELOCITY_UNIT)
        pwm = current = 0
        if self._torque:
            duty = (shaft.torque + model.back_emf * shaft.velocity) * model.voltage
            share = sign * duty / (model.stall_torque * self.supply)
            pwm = round(max(-1.0, min(1.0, share)) * PWM_FULL)
            if model.current_unit:
                current = round(sign * shaft.torque / model.torque_constant / model.current_unit)
            else:
                current = round(1000 * pwm / PWM_FULL)
        trajectory_velocity = self._profile.at(now)[1] if self._profile else 0.0
        moving = self._profile is not None or abs(velocity) > self._still
        status = 0
        if self._torque and self._mode in _POSITION_MODES:
            status = int(abs(self._goal - position) <= IN_POSITION)
            if self._profile is not None:
                status |= 0x02 | self._profile.kind << 4
            status |= 0x08 if abs(self._command - position) > FOLLOWING_ERROR else 0
        _LIVE.pack_into(
            self.table.memory,
            _FIRST_LIVE,
            int(now * 1000.0) & 0x7FFF,
            moving,
            status,
            pwm,
            max(-32768, min(32767, current)),
            velocity,
            position,
            round(trajectory_velocity / SPEED_UNIT),
            round(self._command),
            max(0, round(self.supply * 10)),
            max(0, min(255, int(self.temperature))),
        )

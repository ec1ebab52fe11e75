"""One simulated servo as the bus meets it: its registers, what they command, and its ways to fail.

Stored without effect: Startup_Configuration, Protocol_Type, PWM_Slope, LED, the external ports and the
feed-forward gains.

Source: ROBOTIS e-Manual, `dxl/x/<model>`, section "Control Table Description". What no manual says is marked
`Assumption:`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from sim_backends.plant import Plant
from sim_backends.virtual_dynamixel.control_table import ControlTable, Writes
from sim_backends.virtual_dynamixel.health import AMBIENT, Health
from sim_backends.virtual_dynamixel.models import MODELS, PWM_FULL, VELOCITY_UNIT
from sim_backends.virtual_dynamixel.motor import COMMANDED, Motor
from sim_backends.virtual_dynamixel.profile import SPEED_UNIT
from sim_backends.virtual_dynamixel.protocol import ALERT, Fail
from sim_backends.virtual_dynamixel.registers import EEPROM

HOUSEKEEPING = 0.02
"""s between looks at load, temperature and voltage."""
REBOOT_TIME = 0.3
"""s without an answer after a reboot. Assumption."""
WATCHDOG_UNIT = 0.02
"""s per unit of Bus_Watchdog."""
IN_POSITION, FOLLOWING_ERROR = 10, 100
"""Ticks that decide bits 0 and 3 of Moving_Status. Assumption."""

_FIRST_LIVE, _LAST_LIVE = 120, 147
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

    Attributes:
        model: What distinguishes it from other models.
        shaft_id: Its shaft in the world.
        table: Its registers.
        health: Its supply, temperature and errors.
        silent: It answers nothing and obeys nothing, as with a broken cable before it.
        on_change: Called when `busy` or `watch` may have changed.
        on_address: Called when the ID or the secondary ID may have changed.
    """

    def __init__(self, spec: ServoSpec, plant: Plant, baud_code: int) -> None:
        self.model = MODELS[spec.model]
        self.shaft_id = spec.servo_id
        self.silent = False
        self.on_change: Callable[[], None] = lambda: None
        self.on_address: Callable[[], None] = lambda: None
        self.table = ControlTable(self.model)
        self.table.set("ID", spec.servo_id)
        self.table.set("Baud_Rate", baud_code)
        for name, value in spec.settings:
            self.table.set(name, value)
        self.health = Health(self.model, self.table)
        self._plant = plant
        self._motor = Motor(
            self.model, self.table, self.health, plant, spec.servo_id, spec.keeps_goal, self._pass_on
        )
        self._watch = 0.0
        self._asleep_until = -math.inf
        self._power_up()

    def _pass_on(self) -> None:
        self.on_change()

    # --- what the bus needs at every packet ---------------------------------------------------------------

    @property
    def alert(self) -> int:
        """The alert bit of the error byte."""
        return ALERT if self.health.bits else 0

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
            return self._write_goal_position(data) | self.alert
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
        table.reset(lambda register: register.access != EEPROM)
        self.health.reboot()
        self._watch = 0.0
        self._motor.power_up()

    def reboot(self, now: float) -> None:
        """RAM back to its initial values, torque off, errors cleared; silent for REBOOT_TIME."""
        self._power_up()
        self._asleep_until = now + REBOOT_TIME
        self.on_change()

    def factory_reset(self, keep_id: bool, keep_baud: bool, now: float) -> None:
        """EEPROM back to the factory's values, then a reboot."""
        kept = {"ID": keep_id, "Baud_Rate": keep_baud}
        self.table.reset(lambda register: register.access == EEPROM and not kept.get(register.name, False))
        self.on_address()
        self.reboot(now)

    def clear_turns(self) -> Fail:
        """Bring the present position into one turn. Refused while the shaft is driven."""
        if self._motor.torque:
            return Fail.RESULT
        self._motor.settle()
        return Fail.NONE

    def fail(self, bits: int) -> None:
        """Raise hardware errors; those that Shutdown selects take the torque off until a reboot."""
        self.health.fail(bits)
        if self.health.shut_down:
            self._motor.relax()

    def heal(self) -> None:
        """Cable, supply and temperature are as they should be again; latched errors stay."""
        self.silent = False
        self.health.temperature = AMBIENT
        self.set_supply(self.model.voltage)

    def set_supply(self, volts: float) -> None:
        """Feed the servo with another voltage; torque and speed follow."""
        self.health.supply = volts
        self._motor.tune()

    # --- writes -------------------------------------------------------------------------------------------

    def _check(self, writes: Writes) -> Fail:
        return self.table.check_values(writes, self._motor.tripped, self.health.shut_down)

    def _commit(self, writes: Writes) -> None:
        for register, value in writes:
            self.table.store(register, value)
            self._obey(register.name, value)

    def _write_goal_position(self, data: bytes) -> int:
        value = int.from_bytes(data, "little", signed=True)
        fail = Fail.DATA_RANGE if self._motor.tripped else self.table.check_goal_position(value)
        if not fail:
            self.table.memory[116:120] = data
            self._motor.aim(value)
        return fail

    def _obey(self, name: str, value: int) -> None:
        """What a stored value changes."""
        motor = self._motor
        if name == "Goal_Position":
            motor.aim(value)
        elif name == "Torque_Enable":
            if value:
                motor.energise()
            else:
                motor.relax()
        elif name == "Bus_Watchdog":
            self._watch = value * WATCHDOG_UNIT
            motor.tripped = False
            self.on_change()
        elif name == "Operating_Mode":
            motor.change_mode()
        elif name in ("Drive_Mode", "Homing_Offset"):
            motor.load()
        elif name in ("ID", "Secondary_ID"):
            self.on_address()
        elif name in COMMANDED.values() or name.endswith("_Gain") or name == "PWM_Limit":
            if motor.wakes_on_goal and not motor.torque and name == COMMANDED.get(self.table.get("Operating_Mode")):
                motor.energise()
                self.table.set(name, value if motor.torque else 0)
            motor.tune()

    # --- time ---------------------------------------------------------------------------------------------

    @property
    def busy(self) -> bool:
        """`step` must be called before every physics step."""
        return self._motor.busy

    @property
    def watch(self) -> float:
        """Timeout of the armed bus watchdog, s; 0 when it is not armed."""
        return self._watch if self._motor.torque and not self._motor.tripped else 0.0

    def trip(self) -> None:
        """The bus has been silent for too long: stop here and refuse goals until 0 is written."""
        self.table.set("Bus_Watchdog", -1)
        self._motor.trip()

    def step(self, dt: float, now: float) -> None:
        """One period of the control loop; called before a physics step of `dt` s while `busy`."""
        self._motor.step(dt, now)

    def housekeeping(self, dt: float, now: float) -> None:
        """Load, temperature and voltage, every HOUSEKEEPING s."""
        torque = abs(self._motor.shaft().torque) if self._motor.torque else 0.0
        bits = self.health.look(dt, now, torque)
        if bits:
            self.fail(bits)

    # --- live registers -----------------------------------------------------------------------------------

    def _refresh(self) -> None:
        """Bring the Present_ registers up to date."""
        model, health, motor = self.model, self.health, self._motor
        now = self._plant.now()
        shaft = motor.shaft()
        sign = motor.sign
        position = round(motor.position(shaft))
        velocity = round(sign * shaft.velocity / VELOCITY_UNIT)
        running = motor.profile
        pwm = current = status = 0
        if motor.torque:
            # The voltage on the motor: what makes its torque, and what its speed has used up.
            duty = (shaft.torque + model.back_emf * shaft.velocity) * model.voltage
            share = sign * duty / (model.stall_torque * health.supply)
            pwm = round(max(-1.0, min(1.0, share)) * PWM_FULL)
            if model.current_unit:
                current = round(sign * shaft.torque / model.torque_constant / model.current_unit)
            else:
                current = round(1000 * pwm / PWM_FULL)
            if motor.positions:
                status = int(abs(motor.goal - position) <= IN_POSITION)
                status |= 0x02 | running.kind << 4 if running else 0
                status |= 0x08 if abs(motor.command - position) > FOLLOWING_ERROR else 0
        memory = self.table.memory
        threshold = memory[24] | memory[25] << 8  # Moving_Threshold, 0..1023
        _LIVE.pack_into(
            memory,
            _FIRST_LIVE,
            int(now * 1000.0) & 0x7FFF,
            running is not None or abs(velocity) > threshold,
            status,
            pwm,
            max(-32768, min(32767, current)),
            velocity,
            position,
            round(running.at(now)[1] / SPEED_UNIT) if running else 0,
            round(motor.command),
            max(0, round(health.supply * 10)),
            max(0, min(255, int(health.temperature))),
        )

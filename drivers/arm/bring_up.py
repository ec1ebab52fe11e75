"""Bringing the servos up: who is there, what is stored in them, what they run with, torque on and off.

EEPROM is written only where it differs, with that servo's torque off, and read back. RAM is lost whenever a
servo restarts, so it is written at every start and checked before every move.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from controller.errors import ArmError, BusError, ServoFault
from controller.ports import Clock
from drivers.arm.bus import Bus
from drivers.arm.control_table import (
    HOMING_LIMIT,
    NO_SECONDARY_ID,
    POSITION_MODE,
    PWM_FULL,
    REGISTERS,
    REVERSE,
    WATCHDOG_TRIPPED,
    hardware_error_text,
    model_name,
)
from drivers.arm.replies import Identity
from drivers.arm.servos import GRIPPER, Servo, check_hardware

_WRITE_ATTEMPTS = 3
_ALIGNED_TICKS = 8  # a shadow nearer than this to its partner is left as it is: 0.7 degrees, backlash included
_REBOOT_TIME = 0.5  # s after which a restarted servo is asked again
_REBOOT_PINGS = 10

_RAM_BLOCK = (REGISTERS["Torque_Enable"].address, REGISTERS["Bus_Watchdog"].address + 1 - 64)


def take_inventory(bus: Bus, servos: Sequence[Servo]) -> dict[int, Identity]:
    """Ping every servo, compare its model, and have it answer whatever it is asked; an alert is no absence.

    Raises:
        BusError: code `timeout` (servos missing, all of them named), `corrupt` (perhaps two servos share an ID)
            or `refused` (wrong models, or firmware without a Bus Watchdog).
    """
    found: dict[int, Identity] = {}
    missing, wrong, old = [], [], []
    code, remedy = "timeout", "check the 12 V supply, the cables from servo to servo, IDs and baud rate"
    for servo in servos:
        try:
            identity = bus.ping(servo.servo_id)
        except BusError as error:
            if error.code == "lost":
                raise
            missing.append(servo.title)
            if error.code == "corrupt":
                code, remedy = error.code, error.remedy
            continue
        found[servo.servo_id] = identity
        if identity.model_number != servo.model.number:
            wrong.append(f"{servo.title} is {model_name(identity.model_number)}, not {servo.model.name}")
        elif identity.firmware < servo.model.firmware:
            old.append(f"{servo.title} has firmware {identity.firmware}, older than {servo.model.firmware}")
    if missing:
        raise BusError(bus.name, "inventory", code, "no good answer from " + ", ".join(missing), remedy)
    if wrong:
        raise BusError(bus.name, "inventory", "refused", "; ".join(wrong), "choose the right --arm, or correct the IDs")
    if old:
        remedy = "renew it with the DYNAMIXEL Wizard: the Bus Watchdog stops an arm whose computer has failed"
        raise BusError(bus.name, "inventory", "refused", "; ".join(old), remedy)
    # Pings are always answered, reads and writes only at this level. Nobody answers a broadcast, so it needs none.
    bus.sync_write("Status_Return_Level", {servo.servo_id: 2 for servo in servos})
    return found


def configure(bus: Bus, servos: Sequence[Servo]) -> tuple[str, ...]:
    """Set every servo up; returns the EEPROM registers that were changed, for the log.

    Moves nothing. Torque stays as it is, except that a servo whose EEPROM differs loses it.

    Raises:
        BusError: A servo does not answer or does not take a value.
    """
    changed: list[str] = []
    # Shadows come last: what is written to their partner reaches them too.
    for servo in servos:
        changed += _write_eeprom(bus, servo, _eeprom(servo))
    for servo in servos:
        if servo.shadow_of is not None:
            changed += _align_shadow(bus, servo)
    for servo in servos:
        write_ram(bus, servo)
    return tuple(changed)


def _eeprom(servo: Servo) -> dict[str, int]:
    low, high = servo.limits
    wanted = {
        "Return_Delay_Time": 0,
        "Drive_Mode": REVERSE if servo.reverse else 0,
        "Operating_Mode": POSITION_MODE,
        "Secondary_ID": NO_SECONDARY_ID if servo.shadow_of is None else servo.shadow_of,
        "PWM_Limit": PWM_FULL,
        "Min_Position_Limit": low,
        "Max_Position_Limit": high,
        "Shutdown": servo.model.shutdown,
    }
    if servo.shadow_of is None:
        wanted["Homing_Offset"] = 0
    return wanted


def _write_eeprom(bus: Bus, servo: Servo, wanted: Mapping[str, int]) -> list[str]:
    changed = []
    for name, value in wanted.items():
        present = bus.read_register(servo.servo_id, name)
        if present == value or (name == "Secondary_ID" and min(present, value) >= NO_SECONDARY_ID - 2):
            continue
        set_register(bus, servo, "Torque_Enable", 0)
        set_register(bus, servo, name, value)
        changed.append(f"{servo.title}: {name} {present} -> {value}")
    return changed


def _align_shadow(bus: Bus, servo: Servo) -> list[str]:
    """Make a shadow read the same angle as its partner, so that the two do not fight over one joint.

    A pair that holds torque is left alone: it would have to let go.

    Raises:
        BusError: They are further apart than Homing_Offset can make good.
    """
    assert servo.shadow_of is not None
    if bus.read_register(servo.servo_id, "Torque_Enable"):
        return []
    apart = bus.read_register(servo.shadow_of, "Present_Position") - bus.read_register(
        servo.servo_id, "Present_Position"
    )
    if abs(apart) <= _ALIGNED_TICKS:
        return []
    offset = bus.read_register(servo.servo_id, "Homing_Offset") + apart
    if abs(offset) > HOMING_LIMIT:
        cause = f"stands {apart} ticks from its partner, servo {servo.shadow_of}"
        raise BusError(servo.title, "align", "refused", cause, "mount both horns in the same position")
    return _write_eeprom(bus, servo, {"Homing_Offset": offset})


def ram(servo: Servo) -> dict[str, int]:
    """What a servo runs with: goals taken at once, the model's gains, no watchdog until it moves.

    The jaws' Goal_PWM is missing: every grip sets it, and until then it limits the force on what they hold.
    """
    p, i, d = servo.gains
    power = {} if servo.name == GRIPPER else {"Goal_PWM": PWM_FULL}
    return {
        "Bus_Watchdog": 0,
        "Position_P_Gain": p,
        "Position_I_Gain": i,
        "Position_D_Gain": d,
        "Feedforward_1st_Gain": 0,
        "Feedforward_2nd_Gain": 0,
        "Profile_Acceleration": 0,
        "Profile_Velocity": 0,
        **power,
    }


def write_ram(bus: Bus, servo: Servo) -> None:
    """Write what a restart loses; a watchdog that has tripped stays so until the next move. Raises BusError."""
    for name, value in ram(servo).items():
        present = bus.read_register(servo.servo_id, name)
        # Until it is cleared, a goal from before cannot come into force again.
        if present != value and not (name == "Bus_Watchdog" and present == WATCHDOG_TRIPPED):
            set_register(bus, servo, name, value)


def set_register(bus: Bus, servo: Servo, name: str, value: int) -> None:
    """Write a value and read it back; a setting, unlike a move, may be written again.

    Raises:
        BusError: The servo refuses it, does not answer, or keeps another value.
    """
    present = None
    for _ in range(_WRITE_ATTEMPTS):
        try:
            bus.write_register(servo.servo_id, name, value)
        except BusError as error:
            if error.code in {"lost", "refused"}:
                raise
        present = bus.read_register(servo.servo_id, name)
        if present == value:
            return
    cause = f"keeps {present} instead of {value}"
    raise BusError(servo.title, f"write {name}", "refused", cause, "switch the servos' supply off and on")


@dataclass(frozen=True, slots=True)
class RamState:
    """The part of a servo's RAM that shows whether it is still ours."""

    torque: bool
    position_gains: tuple[int, int, int]
    watchdog: int

    @property
    def tripped(self) -> bool:
        """The Bus Watchdog has stopped the servo."""
        return self.watchdog == WATCHDOG_TRIPPED


def read_ram(bus: Bus, servos: Sequence[Servo]) -> dict[int, RamState]:
    """Torque, gains and watchdog of every servo.

    Raises:
        BusError: A servo does not answer.
    """
    replies = bus.sync_read([servo.servo_id for servo in servos], *_RAM_BLOCK)
    found = {}
    for servo in servos:
        reply = replies[servo.servo_id]
        data = reply.data if reply is not None and reply.data else bus.read(servo.servo_id, *_RAM_BLOCK).data
        found[servo.servo_id] = RamState(
            torque=bool(_field(data, "Torque_Enable")),
            position_gains=(
                _field(data, "Position_P_Gain"), _field(data, "Position_I_Gain"), _field(data, "Position_D_Gain"),
            ),
            watchdog=_field(data, "Bus_Watchdog"),
        )  # fmt: skip
    return found


def _field(data: bytes, name: str) -> int:
    register = REGISTERS[name]
    start = register.address - _RAM_BLOCK[0]
    return register.decode(data[start : start + register.size])


def torque_on(bus: Bus, servos: Sequence[Servo], positions: Mapping[int, int]) -> None:
    """Torque on where the servos stand; those that hold already are left alone.

    Args:
        bus: The bus.
        servos: All of them, shadows after their partners.
        positions: Present_Position by ID, ticks.

    Raises:
        ArmError: A joint stands outside its limits, so that its goal cannot be where it is.
        BusError: A servo refuses.
    """
    off = [servo for servo in servos if not bus.read_register(servo.servo_id, "Torque_Enable")]
    for servo in off:
        low, high = servo.limits
        if not low <= positions[servo.servo_id] <= high:
            cause = f"stands at tick {positions[servo.servo_id]}, outside {low}..{high}"
            raise ArmError(servo.title, "energise", cause, "move it inside its limits by hand")
    for servo in off:
        set_register(bus, servo, "Bus_Watchdog", 0)  # one that has tripped refuses goals
        set_register(bus, servo, "Goal_Position", positions[servo.servo_id])
    for servo in off:
        try:
            set_register(bus, servo, "Torque_Enable", 1)
        except BusError:
            check_hardware(bus, servo, "energise")
            raise


def torque_off(bus: Bus, servos: Sequence[Servo]) -> None:
    """Torque off at every servo, whatever single ones answer.

    Raises:
        BusError: code `lost` at once; otherwise at the end, naming the servos that did not confirm it.
    """
    bus.sync_write("Torque_Enable", {servo.servo_id: 0 for servo in servos})
    doubtful = []
    for servo in servos:
        try:
            set_register(bus, servo, "Torque_Enable", 0)
        except BusError as error:
            if error.code == "lost":
                raise
            doubtful.append(servo.title)
    if doubtful:
        cause = "not confirmed by " + ", ".join(doubtful)
        raise BusError(bus.name, "torque off", "timeout", cause, "switch the 12 V supply off before touching the arm")


def restart(bus: Bus, clock: Clock, servos: Sequence[Servo], alerts: Collection[int]) -> None:
    """Reboot those servos that report an alert and hold no torque; whatever is in their RAM is lost.

    Args:
        bus: The bus.
        clock: Time.
        servos: All of them.
        alerts: IDs of those that report one.

    Raises:
        BusError: One does not come back.
        ServoFault: One comes back with a hardware error, or its shadow, which obeys a reboot too, still holds.
    """
    holding = {servo.servo_id for servo in servos if bus.read_register(servo.servo_id, "Torque_Enable")}
    limp = [servo for servo in servos if servo.servo_id in alerts and servo.servo_id not in holding]
    if not limp:
        return
    held_up = {servo.shadow_of for servo in servos if servo.servo_id in holding}
    for servo in limp:
        if servo.servo_id in held_up:
            bits = bus.read_register(servo.servo_id, "Hardware_Error_Status")
            cause = f"{hardware_error_text(bits)[0]}, while its joint's second servo holds"
            remedy = "support the arm, then switch the servos' supply off and on"
            raise ServoFault(servo.title, "restart", servo.name, bits, cause, remedy)
    for servo in limp:
        try:
            bus.reboot(servo.servo_id)
        except BusError as error:
            if error.code == "lost":
                raise
            # The answer may be lost; whether it came back is what counts.
    clock.sleep(_REBOOT_TIME)
    for servo in limp:
        if bus.ping(servo.servo_id, retries=_REBOOT_PINGS).alert:
            check_hardware(bus, servo, "restart")


def check_still_ours(servos: Sequence[Servo], states: Mapping[int, RamState]) -> None:
    """Find a servo that has lost torque or settings since it was set up: it has restarted.

    Raises:
        ServoFault: bits 0.
    """
    for servo in servos:
        state = states[servo.servo_id]
        if not state.torque or state.position_gains != servo.gains:
            what = "torque" if not state.torque else "settings"
            cause = f"has lost its {what}: it has restarted or was changed by another program"
            remedy = "check its plugs and the supply, then reset"
            raise ServoFault(servo.title, "check", servo.name, 0, cause, remedy)

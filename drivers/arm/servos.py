"""Which servos an arm has, and what they say: the step from a description to IDs, ticks and registers."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from controller.domain import ArmDescription
from controller.errors import BusError, ConfigError, ServoFault
from drivers.arm.bus import Bus
from drivers.arm.control_table import MODELS, REGISTERS, Model, hardware_error_text
from drivers.arm.conversions import (
    TICKS_MAX,
    VELOCITY_UNIT,
    VOLTAGE_UNIT,
    angle_from_opening,
    angle_from_ticks,
    ticks_from_angle,
)
from drivers.arm.replies import Reply

GRIPPER = "gripper"
"""Name of the gripper's servo."""

LIMIT_MARGIN = math.radians(5.0)
"""How far goals may lie beyond a joint's limits, rad: the offsets against sag and lag reach 5 degrees."""

JAW_MARGIN = 10.0
"""How far beyond its working range the gripper may stand when it is switched on, mm: pushed there by hand."""

TELEMETRY = (REGISTERS["Moving"].address, 25)
"""(address, size) of Moving .. Present_Temperature, contiguous on every X servo."""

_LAYOUT = struct.Struct("<BBhhiiiiHB")


@dataclass(frozen=True, slots=True)
class Servo:
    """One servo as the description wants it.

    Attributes:
        name: Joint's name, `gripper`, or the joint's name and `shadow`.
        servo_id: Its own address.
        model: What it must be.
        reverse: Drive_Mode bit 0.
        limits: (lowest, highest) Goal_Position, ticks.
        gains: (P, I, D) of the position loop to run with.
        shadow_of: Servo whose instructions it obeys too, or None.
    """

    name: str
    servo_id: int
    model: Model
    reverse: bool
    limits: tuple[int, int]
    gains: tuple[int, int, int]
    shadow_of: int | None = None

    @property
    def title(self) -> str:
        """For messages."""
        return f"servo {self.servo_id} ({self.name})"


def servos_of(description: ArmDescription) -> tuple[Servo, ...]:
    """Joints from base to tool, the gripper, then the shadows.

    Raises:
        ConfigError: A model nobody knows.
    """
    joints = []
    shadows = []
    for joint in description.joints:
        limits = _limits(*joint.limits)
        model = _model(description, joint.model)
        # I would cancel the model's offset in the goals. XL430's factory D saturates it when goals are streamed.
        gains = (model.position_gains[0], 0, 0)
        joints.append(Servo(joint.name, joint.servo_id, model, joint.reverse, limits, gains))
        if joint.shadow_id is not None:
            # Mounted face to face with its partner, so it counts the other way.
            shadows.append(
                Servo(f"{joint.name} shadow", joint.shadow_id, model, not joint.reverse, limits, gains, joint.servo_id)
            )
    gripper = description.gripper
    narrow, wide = gripper.opening
    ends = sorted(angle_from_opening(gripper, end) for end in (narrow - JAW_MARGIN, wide + JAW_MARGIN))
    model = _model(description, gripper.model)
    # The jaws make steps: half of the factory's D brings them to rest soonest. I would wind up on a part.
    p, _, d = model.position_gains
    jaw = Servo(GRIPPER, gripper.servo_id, model, gripper.reverse, _limits(*ends), (p, 0, d // 2))
    return (*joints, jaw, *shadows)


def _model(description: ArmDescription, name: str) -> Model:
    if name not in MODELS:
        raise ConfigError(f"arm {description.name}: unknown servo model {name!r}", f"one of {', '.join(MODELS)}")
    return MODELS[name]


def _limits(low: float, high: float) -> tuple[int, int]:
    return max(0, ticks_from_angle(low - LIMIT_MARGIN)), min(TICKS_MAX, ticks_from_angle(high + LIMIT_MARGIN))


class Telemetry(NamedTuple):
    """One servo's feedback.

    Attributes:
        position: rad.
        velocity: rad/s.
        load: Present_Load or Present_Current over its full range, positive with growing angle.
        voltage: V.
        temperature: degC.
    """

    position: float
    velocity: float
    load: float
    voltage: float
    temperature: int

    @classmethod
    def parse(cls, data: bytes, model: Model) -> Telemetry:
        """From the bytes of `TELEMETRY`."""
        _, _, _, load, velocity, position, _, _, voltage, temperature = _LAYOUT.unpack(data)
        return cls(
            angle_from_ticks(position),
            velocity * VELOCITY_UNIT,
            load / model.load_full,
            voltage * VOLTAGE_UNIT,
            temperature,
        )


def read_telemetry(bus: Bus, servos: Sequence[Servo], operation: str) -> dict[int, Telemetry | None]:
    """Feedback of every servo by ID; None where one did not answer.

    Raises:
        ServoFault: A servo reports a hardware error.
        BusError: code `lost`, or `refused` where a servo answers with an error instead of data.
    """
    replies = bus.sync_read([servo.servo_id for servo in servos], *TELEMETRY)
    found: dict[int, Telemetry | None] = {}
    for servo in servos:
        reply = replies[servo.servo_id]
        found[servo.servo_id] = None if reply is None else _telemetry(bus, servo, reply, operation)
    return found


def read_telemetry_surely(bus: Bus, servos: Sequence[Servo], operation: str) -> dict[int, Telemetry]:
    """As `read_telemetry`, but servos that did not answer are asked again, one by one.

    Raises:
        BusError: One still does not answer.
        ServoFault: A servo reports a hardware error.
    """
    found = read_telemetry(bus, servos, operation)
    for servo in servos:
        if found[servo.servo_id] is None:
            found[servo.servo_id] = _telemetry(bus, servo, bus.read(servo.servo_id, *TELEMETRY), operation)
    return {servo_id: telemetry for servo_id, telemetry in found.items() if telemetry is not None}


def _telemetry(bus: Bus, servo: Servo, reply: Reply, operation: str) -> Telemetry:
    if reply.alert:
        check_hardware(bus, servo, operation)
    if len(reply.data) != TELEMETRY[1]:
        raise BusError(servo.title, operation, "refused", "answers with an error instead of data", "restart it")
    return Telemetry.parse(reply.data, servo.model)


def check_hardware(bus: Bus, servo: Servo, operation: str) -> None:
    """Raise what Hardware_Error_Status says; the alert has brought us here.

    Raises:
        ServoFault: It names the joint, the bits and the remedy.
    """
    try:
        bits = bus.read_register(servo.servo_id, "Hardware_Error_Status")
    except BusError as error:
        if error.code == "lost":
            raise
        raise ServoFault(
            servo.title, operation, servo.name, 0, "reports an alert and does not say why",
            "switch the servos' supply off and on"
        ) from error
    if bits:
        cause, remedy = hardware_error_text(bits)
        raise ServoFault(servo.title, operation, servo.name, bits, cause, remedy)

"""The arm: what it is made of, what it says, and what it is told."""

from __future__ import annotations

from dataclasses import dataclass

from controller.domain.types import Array


@dataclass(frozen=True, slots=True)
class ServoDynamics:
    """How the position loop of one joint answers a load; the defaults are an XM430-W350 at its factory P gain.

    Attributes:
        stiffness: Torque per angle between goal and position, Nm/rad, all servos of the joint together.
        damping: Back-EMF, Nm s/rad.
        friction: Coulomb friction, Nm.
        inertia: Rotor inertia at the output, kg m^2.
        friction_share: How much of the friction is made up for; less while it is only assumed.
    """

    stiffness: float = 18.9
    damping: float = 0.85
    friction: float = 0.08
    inertia: float = 0.028
    friction_share: float = 0.6


@dataclass(frozen=True, slots=True)
class Joint:
    """One revolute joint and the servo that turns it.

    Attributes:
        name: e.g. `shoulder`.
        servo_id: Address on the bus.
        model: e.g. `XM430-W350`.
        axis: `z`, `y` or `x`: axis of rotation in the parent's coordinates.
        offset: Origin in the parent joint's coordinates at angle zero, mm.
        limits: (lowest, highest) angle, rad.
        reverse: Drive_Mode bit 0: the servo counts against the joint unless it is set.
        speed_limit: rad/s, for planning.
        acceleration_limit: rad/s^2, for planning.
        shadow_id: Servo that mirrors this one, or None.
        dynamics: Parameters of the offset that makes up for sag and lag.
    """

    name: str
    servo_id: int
    model: str
    axis: str
    offset: tuple[float, float, float]
    limits: tuple[float, float]
    reverse: bool
    speed_limit: float
    acceleration_limit: float
    shadow_id: int | None = None
    dynamics: ServoDynamics = ServoDynamics()


@dataclass(frozen=True, slots=True)
class Link:
    """Rigid body carried by a joint, for gravity and inertia.

    Attributes:
        mass: kg.
        center: Centre of mass in the joint's own coordinates, mm.
    """

    mass: float
    center: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Gripper:
    """A parallel gripper turned by one servo.

    Attributes:
        servo_id: Address on the bus.
        model: e.g. `XL430-W250`.
        mechanism: `crank` (horn and link) or `rack` (opening proportional to the angle).
        parameters: For `crank`: (horn radius, link length, jaw inset), mm: opening =
            2 (r sin a + sqrt(l^2 - r^2 cos^2 a)) - 2 inset. For `rack`: (mm per rad, opening at zero).
        opening: (narrowest, widest) clear opening between the pads, mm.
        reverse: Drive_Mode bit 0.
        jaw_size: (thickness along the closing direction, width across it) of one jaw, mm.
        jaw_depth: How far the pads reach below the grasp point, mm.
    """

    servo_id: int
    model: str
    mechanism: str
    parameters: tuple[float, ...]
    opening: tuple[float, float]
    reverse: bool
    jaw_size: tuple[float, float]
    jaw_depth: float


@dataclass(frozen=True, slots=True)
class ArmDescription:
    """A serial arm: yaw, a planar chain, and optionally a roll at the wrist.

    Attributes:
        name: File name of its description, e.g. `reactorx_150`.
        title: For people.
        baud: Bus speed, bit/s.
        joints: From base to tool.
        links: The body each joint carries, in the same order; the last includes the gripper.
        tool: Offset of the grasp point in the last joint's coordinates, mm.
        gripper: The gripper.
        rest: Joint angles where the arm may lose torque without falling, rad.
        ready: Joint angles out of the camera's view of the work area, rad.
        payload: kg.
    """

    name: str
    title: str
    baud: int
    joints: tuple[Joint, ...]
    links: tuple[Link, ...]
    tool: tuple[float, float, float]
    gripper: Gripper
    rest: tuple[float, ...]
    ready: tuple[float, ...]
    payload: float

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names from base to tool."""
        return tuple(joint.name for joint in self.joints)


@dataclass(frozen=True, slots=True, eq=False)
class ArmState:
    """What the servos said at one moment.

    Attributes:
        at: s of the cell's clock.
        positions: ndarray of shape (J,), rad, base to tool.
        velocities: ndarray of shape (J,), rad/s.
        opening: Clear opening of the gripper, mm.
        gripper_load: Present_Load or Present_Current of the gripper, fraction of its range, closing positive.
        voltage: Lowest supply voltage any servo sees, V; None until sampled.
        temperature: Highest temperature of any servo, degC; None until sampled.
    """

    at: float
    positions: Array
    velocities: Array
    opening: float
    gripper_load: float
    voltage: float | None = None
    temperature: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Joint angles over time, sampled evenly, ready to be streamed.

    Attributes:
        name: What it is for, e.g. `approach`.
        period: s between samples.
        positions: ndarray of shape (N, J), rad: where the joints shall be.
        goals: ndarray of shape (N, J), rad: what the servos are told, the model's offset against sag and
            lag (and the joint offsets) included.
        resting: ndarray of shape (N, J), rad: what they are told to stand still there: sag only; None: `goals`.
        braking: ndarray of shape (N, J), rad s: what a goal changes by when the progress along the move changes,
            for each 1/s of it: the inertia's share; None: nothing.
        narrow: s along the move, where it gets among other things: jaws that are to take an opening on the way must
            have it by then, and the move waits for them; None: nowhere.
    """

    name: str
    period: float
    positions: Array
    goals: Array
    resting: Array | None = None
    braking: Array | None = None
    narrow: float | None = None

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return (len(self.positions) - 1) * self.period


@dataclass(frozen=True, slots=True, eq=False)
class ServoCycle:
    """What the joints were told and where they were, once in a cycle of a streamed move.

    Attributes:
        sent_at: When the goals went out, s of the cell's clock.
        read_at: When the positions had come in.
        goals: ndarray of shape (J,), rad: what the servos were told.
        positions: ndarray of shape (J,), rad: where they said they were.
    """

    sent_at: float
    read_at: float
    goals: Array
    positions: Array


@dataclass(frozen=True, slots=True, eq=False)
class MoveReport:
    """How a move ended.

    Attributes:
        finished: False when it was stopped on request before its end.
        state: The arm after it.
    """

    finished: bool
    state: ArmState


@dataclass(frozen=True, slots=True, eq=False)
class GripReport:
    """How a movement of the gripper ended.

    Attributes:
        finished: False when it was stopped on request.
        contact: The jaws stopped on something before the wanted opening.
        opening: Settled clear opening, mm.
        load: Fraction of the range, closing positive.
    """

    finished: bool
    contact: bool
    opening: float
    load: float

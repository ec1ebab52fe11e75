"""The nouns: what travels through the cell from a frame to an outcome, and what is known about the cell.

    Frame -> Detection -> LocatedObject -> PickPlan -> Outcome

Every value is frozen and keeps its parent, so that a line of the ledger leads back to the frame and the
calibration that caused it. Lengths are mm, angles rad, times s of the cell's clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from controller.geometry import CameraModel, PlaneMap

Array = NDArray[np.float64]
Point = tuple[float, float]


class Shape(StrEnum):
    """What vision can tell from an outline alone; `OTHER` is a verdict, not a failure."""

    SQUARE = "square"
    RECTANGLE = "rectangle"
    CIRCLE = "circle"
    HEXAGON = "hexagon"
    TRIANGLE = "triangle"
    OTHER = "other"

    @property
    def period(self) -> float | None:
        """Smallest turn (rad) that maps the shape onto itself; None for a circle, which has no direction."""
        return _PERIOD[self]


_PERIOD: Mapping[Shape, float | None] = {
    Shape.SQUARE: math.pi / 2,
    Shape.RECTANGLE: math.pi,
    Shape.CIRCLE: None,
    Shape.HEXAGON: math.pi / 3,
    Shape.TRIANGLE: 2 * math.pi / 3,
    Shape.OTHER: math.pi,
}


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image.

    Attributes:
        frame_id: Counts up from 1 within a run.
        captured_at: When the exposure ended, s of the cell's clock.
        image: ndarray of shape (H, W, 3), dtype uint8, BGR, read-only.
        source: File or device it came from.
    """

    frame_id: int
    captured_at: float
    image: NDArray[np.uint8]
    source: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return self.image.shape[1], self.image.shape[0]


@dataclass(frozen=True, slots=True)
class Descriptors:
    """The paper's three variables of one outline (its section III).

    Attributes:
        extent: Area of the axis-aligned bounding box over the object's area (the inverse of the toolbox's).
        compactness: perimeter^2 / (4 pi area), the paper's equation (1).
        side_difference: Absolute difference of two adjacent sides, px.
    """

    extent: float
    compactness: float
    side_difference: float


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """One object as seen in one frame, in pixels.

    Attributes:
        frame: The frame it was seen in.
        shape: Verdict of the outline.
        score: Confidence in [0, 1].
        outline_px: ndarray of shape (N, 2), the outer outline, sub-pixel, not closed,
            counter-clockwise as displayed.
        center_px: Centroid of the outer outline, holes filled.
        size_px: (long, short) side of the minimum-area rectangle; a circle has its diameter twice.
        angle: rad, counter-clockwise as displayed, in [0, period) of the shape: a rectangle's long side, a
            side of a square or hexagon, the direction of a triangle's side walked counter-clockwise, the
            long axis of anything else; None for a circle.
        area_px: Area of the outer outline, holes filled, px^2.
        bbox_px: (x, y, width, height) of the axis-aligned bounding box.
        descriptors: The paper's variables.
        label: What the sorting rules or a taught class call it; the shape's name until they do.
        flags: Any of `cut_by_border`, `touching`, `hole`, ...
        colour: Name of its colour, or None when it was not measured.
        texture: Name of its texture, or None when it was not measured.
    """

    frame: Frame
    shape: Shape
    score: float
    outline_px: Array
    center_px: Point
    size_px: tuple[float, float]
    angle: float | None
    area_px: float
    bbox_px: tuple[float, float, float, float]
    descriptors: Descriptors
    label: str = ""
    flags: frozenset[str] = frozenset()
    colour: str | None = None
    texture: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LocatedObject:
    """One object on the table, in `table` coordinates (mm, rad, z up from the table's surface).

    Attributes:
        detection: What was seen.
        target_id: Follows one physical object over its retries; "" until the cycle gives it one.
        center: (x, y) of the footprint's centroid, mm.
        yaw: Direction as for `Detection.angle`, but counter-clockwise about z of `table` seen from above.
        size: (long, short) side of the footprint's minimum-area rectangle, mm.
        height: Height of the part above the table, mm.
        footprint: ndarray of shape (N, 2), the outline on the table, mm, counter-clockwise, not closed.
        sigma: Standard deviation of the centre, mm, the larger axis.
        calibration_id: The calibration the millimetres rest on.
    """

    detection: Detection
    center: Point
    yaw: float | None
    size: tuple[float, float]
    height: float
    footprint: Array
    sigma: float
    calibration_id: str
    target_id: str = ""

    @property
    def shape(self) -> Shape:
        """Verdict of the outline."""
        return self.detection.shape


# --- what is known about the cell ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class CellCalibration:
    """Everything that turns pixels into millimetres, and millimetres into the arm's own.

    Attributes:
        calibration_id: Hash of the contents.
        camera: The lens.
        T_table_camera: ndarray of shape (4, 4), maps `camera` into `table`.
        T_base_table: ndarray of shape (4, 4), maps `table` into the arm's `base`.
        joint_offsets: rad by joint name: added to a wanted joint angle before it is commanded.
        sigma: Standard deviation of a point on the table, mm.
    """

    calibration_id: str
    camera: CameraModel
    T_table_camera: Array
    T_base_table: Array
    joint_offsets: Mapping[str, float] = field(default_factory=dict)
    sigma: float = 0.0

    def plane(self, height: float = 0.0) -> PlaneMap:
        """The map between pixels and the plane z = `height` (mm) of `table`."""
        return PlaneMap(self.camera, self.T_table_camera, height)


@dataclass(frozen=True, slots=True)
class Bin:
    """A place to put parts down.

    Attributes:
        name: As the sorting rules call it.
        center: (x, y) in `table`, mm.
        size: (x, y) inner size, mm.
        height: Height of its walls above the table, mm.
        capacity: Number of parts it takes.
    """

    name: str
    center: Point
    size: tuple[float, float]
    height: float
    capacity: int


# --- the arm ------------------------------------------------------------------------------------------


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
    """

    name: str
    period: float
    positions: Array
    goals: Array
    resting: Array | None = None
    braking: Array | None = None

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
        worst_following_error: Largest distance of a joint from where it should have been, rad.
    """

    finished: bool
    state: ArmState
    worst_following_error: float


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


# --- the plan and its outcome -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Grasp:
    """How the jaws take a part.

    Attributes:
        center: (x, y) of the grasp point in `table`, mm.
        height: z of the grasp point in `table`, mm.
        direction: Closing direction, rad about z of `table`, in [0, pi).
        width: Extent of the part along the closing direction, mm: the opening at contact.
        opening: Clear opening before closing, mm.
        clearance: Smallest distance of a jaw's swept area from anything else, mm.
        flush: Extent once the closing jaws have turned the part flush, mm: `width` or less, and where they settle.
    """

    center: Point
    height: float
    direction: float
    width: float
    opening: float
    clearance: float
    flush: float


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A named pose the tool passes: (x, y, z) in `table`, mm."""

    name: str
    position: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class PickPlan:
    """Everything that will move for one target, approved as a whole before anything does.

    The gripper opens to `grasp.opening` before `approach` descends, closes at its end, and opens at the
    end of `carry`.
    """

    target: LocatedObject
    bin: Bin
    grasp: Grasp
    waypoints: tuple[Waypoint, ...]
    approach: Trajectory
    carry: Trajectory
    retreat: Trajectory

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """All moves in order."""
        return self.approach, self.carry, self.retreat


@dataclass(frozen=True, slots=True, eq=False)
class NudgePlan:
    """A push that makes room for the jaws, approved as a whole before anything moves.

    The jaws close to `opening` on the way and stay so.

    Attributes:
        target: The part that is to be freed.
        moved: What is pushed: the target, or a neighbour.
        by: (dx, dy) that it is expected to go, mm in `table`.
        opening: Clear opening of the jaws during all of it, mm.
        approach: Down to the table beside it.
        push: Straight along the table.
        retreat: Up, and to the ready pose.
    """

    target: LocatedObject
    moved: LocatedObject
    by: Point
    opening: float
    approach: Trajectory
    push: Trajectory
    retreat: Trajectory

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """All moves in order."""
        return self.approach, self.push, self.retreat


class Result(StrEnum):
    """What became of a target; every target gets exactly one."""

    PLACED = "placed"
    GRASP_MISSED = "grasp_missed"
    DROPPED = "dropped"
    REJECTED = "rejected"
    SKIPPED = "skipped"
    ABORTED = "aborted"
    INDETERMINATE = "indeterminate"


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """The one final word about a target.

    Attributes:
        target: The object as it was last located before the last attempt.
        plan: The last plan, or None when none was found.
        result: What became of it.
        reason: One line for people.
        attempts: How often it was tried.
        started_at, finished_at: s of the cell's clock.
    """

    target: LocatedObject
    plan: PickPlan | None
    result: Result
    reason: str
    attempts: int
    started_at: float
    finished_at: float


# --- truth, which only a simulated world can tell ---------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TruePart:
    """What a simulated world knows about one part; never an input of the controller.

    Attributes:
        part_id: Index within the world.
        shape: What it is.
        colour: Name of its colour.
        center: (x, y) of its footprint's centroid in `table` (the frame of the sheet as it was laid), mm.
        yaw: As for `LocatedObject.yaw`; None for a circle.
        size: (long, short) side of the footprint's minimum-area rectangle, mm.
        height: mm.
        upright: It stands on the face it was laid on.
        place: `table`, `gripper`, `floor`, `away` (a person has it), or the name of the bin it lies in.
        reachable: It lay within the arm's reach at the start.
        kind: Name of its kind, where the table was laid with chosen kinds; else "".
    """

    part_id: int
    shape: Shape
    colour: str
    center: Point
    yaw: float | None
    size: tuple[float, float]
    height: float
    upright: bool
    place: str
    reachable: bool
    kind: str = ""

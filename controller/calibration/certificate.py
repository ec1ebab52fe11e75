"""The certificate: where the arm really goes when it is sent somewhere, at places no fit has seen.

The arm is sent to fresh places over the work area, tool down and jaws a few mm over the table, by the calibrated
model. The camera sees the marker, and what it lies beside its expected place is what a touch there misses by.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.calibration import files
from controller.calibration.arm import ArmCalibration, Residual
from controller.calibration.arm_model import PRIOR_OFFSET, MarkerView, Unknowns, has_roll
from controller.calibration.arm_poses import lowest, visible
from controller.calibration.camera import CameraCalibration
from controller.calibration.marker import ArmMarker
from controller.calibration.table import TableCalibration
from controller.domain import Array
from controller.errors import CalibrationPoorFit, CalibrationStale, PlanError, Unreachable
from controller.geometry import invert
from controller.motion import kinematics
from controller.ports import Arm, Camera, Clock

#: Places of a routine check.
POINTS = 30
#: The jaw tips stand this far over the table at a touch, mm: more than a calibrated arm misses by in height.
TOUCH_HEIGHT = 5.0
#: Held-out places keep this distance from every fitted one, mm: nearer ones would repeat its errors.
APART = 15.0
#: A touch misses by at most this in the mean, mm, ...
MEAN_LIMIT = 0.8
#: ... and at the 95th percentile.
P95_LIMIT = 1.5
PASSED, FAILED = "passed", "failed"
#: A marker seen this far from its place, mm, in the median of a few looks: camera, base or marker was moved, or
#: the calibration is another cell's. A calibrated arm comes within 1.5 mm without a correction.
MOVED_LIMIT = 3.0
#: Looks before anything comes near the table, and the height of the jaw tips at them, mm.
FIRST_LOOKS, LOOK_HEIGHT = 3, 60.0
SETTLE = 0.4
_DRAWN = 400


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """What a check found.

    Attributes:
        touch_mm: Where the camera saw the arm against where it was sent, after a last correction by its own
            encoders.
        moved_mm: The same before that correction: where a move alone ends.
        before_mm: What a touch would miss by, had the arm been placed by ruler and its joints been taken as
            mounted: where the calibrated model says it would have ended.
        places: ndarray of shape (N, 2), in `table`, mm.
        errors: ndarray of shape (N, 2), seen minus sent, mm.
        unseen_mm: What the grasp point may lie beside what the marker tells, in the mean, mm: an arm without a
            wrist roll cannot tell the offset of its last joint from the mount of the marker.
        verdict: `passed` or `failed`.
        calibration_id: Of the arm's calibration, which names lens and table.
    """

    touch_mm: Residual
    moved_mm: Residual
    before_mm: Residual
    places: Array
    errors: Array
    unseen_mm: float
    verdict: str
    calibration_id: str

    def to_json(self) -> dict[str, Any]:
        """The JSON object of `calibrate check`, apart from what only a simulation and a clock know."""
        plain = files.plain(
            {
                "touch_mm": self.touch_mm.to_json(),
                "moved_mm": self.moved_mm.to_json(),
                "before_mm": self.before_mm.to_json(),
                "unseen_mm": self.unseen_mm,
                "points": len(self.places),
                "verdict": self.verdict,
                "calibration_id": self.calibration_id,
                "places_mm": self.places,
                "errors_mm": self.errors,
            },
            6,
        )
        assert isinstance(plain, dict)
        return plain


def check_arm(
    arm: Arm,
    camera: Camera,
    clock: Clock,
    move_to: Callable[[Array], None],
    settle: Callable[[], None],
    *,
    lens: CameraCalibration,
    table: TableCalibration,
    calibration: ArmCalibration,
    T_base_table: Array,
    seed: int,
    marker: ArmMarker | None = None,
    points: int = POINTS,
    height: float = TOUCH_HEIGHT,
    radius: tuple[float, float] = (150.0, 260.0),
    azimuth: tuple[float, float] = (math.radians(-50.0), math.radians(50.0)),
    arrived: Callable[[Array], None] = lambda place: None,
    progress: Callable[[str], None] = lambda text: None,
) -> Certificate:
    """Send the arm to held-out places and let the camera say where it went.

    Moves metal; blocks. The table must be empty.

    Args:
        arm: Energised.
        camera: Open.
        clock: The cell's.
        move_to: Brings the joints to wanted angles (J,), the calibrated joint offsets added by the mover; a
            PlanError leaves the place out.
        settle: Corrects what the encoders still miss of the angles moved to last.
        lens: Of the camera.
        table: Of the camera.
        calibration: What is checked.
        T_base_table: Where the table lies by ruler: for the figures before calibration.
        seed: Of the places; drawn after the fit.
        marker: What is on the gripper.
        points: Number of places.
        height: Lowest point of jaws and plate above the table, mm.
        radius: Nearest and farthest distance of a place from the base's z axis, mm.
        azimuth: From, to, about it, rad.
        arrived: Called with the place (3,) in `table` the grasp point was sent to, while the arm stands there.
        progress: Called with one line before each place.

    Raises:
        Unreachable: Too few places can be reached and seen.
        CalibrationStale: The marker is not where this calibration has it: see `MOVED_LIMIT`.
        CalibrationPoorFit: The marker was seen at fewer than two thirds of them.
    """
    description = arm.description
    view = MarkerView(description, marker or ArmMarker(), lens.camera, table.T_table_camera, calibration.T_base_table)
    straight = Unknowns(invert(calibration.T_base_table), calibration.T_tool_marker, np.zeros(len(description.joints)))
    if calibration.points:
        above = _places(view, straight, calibration, FIRST_LOOKS, LOOK_HEIGHT, radius, azimuth, seed)
        _unmoved(camera, clock, move_to, view, straight, above)
    wanted = _places(view, straight, calibration, points, height, radius, azimuth, seed)
    ruler = Unknowns(invert(T_base_table), calibration.T_tool_marker, np.zeros(len(description.joints)))
    offsets = np.array([calibration.joint_offsets.get(name, 0.0) for name in description.joint_names])
    places, errors, moved, before = [], [], [], []
    for index, q in enumerate(wanted, 1):
        progress(f"place {index} of {len(wanted)}")
        try:
            move_to(q)
        except PlanError as error:
            progress(f"place {index} left out: {error.cause}")
            continue
        first = _look(camera, clock, view, straight, q)
        settle()
        beside = _look(camera, clock, view, straight, q)
        target = view.tools(straight, q[None])[0]
        arrived(target)
        if first is None or beside is None:
            continue
        places.append(target[:2])
        moved.append(first)
        errors.append(beside)
        # Sent to the same place by ruler, the encoders read as joints: the calibrated model says where it ends.
        blind = view.tools(Unknowns(straight.T_table_base, straight.T_tool_marker, offsets), q[None])[0]
        before.append(blind[:2] - view.tools(ruler, q[None])[0][:2] + beside)
    if 3 * len(places) < 2 * len(wanted):
        raise CalibrationPoorFit(
            f"the marker was seen at only {len(places)} of {len(wanted)} places", "check light and marker; repeat"
        )
    touch = Residual.of(np.linalg.norm(errors, axis=1))
    unseen = _unseen(view, calibration)
    good = touch.mean + unseen <= MEAN_LIMIT and touch.p95 + unseen <= P95_LIMIT
    return Certificate(
        touch,
        Residual.of(np.linalg.norm(moved, axis=1)),
        Residual.of(np.linalg.norm(before, axis=1)),
        np.array(places),
        np.array(errors),
        unseen,
        PASSED if good else FAILED,
        calibration.calibration_id,
    )


def _unseen(view: MarkerView, calibration: ArmCalibration) -> float:
    """Mean distance (mm) of the true grasp point from the one the marker tells.

    Turning the last joint turns the marker about the tool's axis, which shows where that axis is. Where the last
    joint is the wrist's pitch, its offset is part of the marker's mount: only a tip that touches things shows it.
    """
    if has_roll(view.arm):
        return 0.0
    hand = float(np.linalg.norm(view.arm.tool))
    deviation = calibration.sigma.get(view.arm.joint_names[-1], PRIOR_OFFSET)
    return hand * deviation * math.sqrt(2.0 / math.pi)  # mean of the size of a normal deviate


def _unmoved(
    camera: Camera,
    clock: Clock,
    move_to: Callable[[Array], None],
    view: MarkerView,
    unknowns: Unknowns,
    poses: list[Array],
) -> None:
    """Look at the marker well above the table before anything goes down to it.

    Raises:
        CalibrationStale: It is not seen, or not where it should be.
    """
    looks = []
    for q in poses:
        move_to(q)
        looks.append(_look(camera, clock, view, unknowns, q))
    seen = [float(np.linalg.norm(look)) for look in looks if look is not None]
    found = f"is seen {np.median(seen):.1f} mm from its place" if seen else "is not seen"
    if not seen or np.median(seen) > MOVED_LIMIT:
        raise CalibrationStale(
            f"the arm's marker {found} (limit {MOVED_LIMIT:g} mm): camera, arm or marker was moved since the "
            "calibration, or it is another cell's",
            "calibrate again: controller calibrate table, then controller calibrate arm",
        )


def _look(camera: Camera, clock: Clock, view: MarkerView, unknowns: Unknowns, q: Array) -> Array | None:
    """How far (2,) beside its place the marker is seen once the arm is still, mm; None when it is not seen."""
    clock.sleep(SETTLE)
    corners = view.marker.find(camera.capture(clock.now()).image, view.camera)
    return None if corners is None else _seen_beside(view, unknowns, q, corners)


def _places(
    view: MarkerView,
    unknowns: Unknowns,
    calibration: ArmCalibration,
    count: int,
    height: float,
    radius: tuple[float, float],
    azimuth: tuple[float, float],
    seed: int,
) -> list[Array]:
    """Joint angles of places drawn evenly over ring and sector, each in a stratum of its own, far from the fit."""
    random = np.random.default_rng(seed)
    fitted = np.array(calibration.places).reshape(-1, 3)
    rings = max(1, round(math.sqrt(count / 3)))
    out: list[Array] = []
    for attempt in range(_DRAWN):
        if len(out) == count:
            break
        # Strata go round by round, so that a place that falls out is drawn again in the next stratum.
        ring, sector = attempt % rings, (attempt // rings) % max(1, count // rings)
        share = (ring + random.uniform()) / rings
        far = math.sqrt(radius[0] ** 2 + share * (radius[1] ** 2 - radius[0] ** 2))
        turn = azimuth[0] + (sector + random.uniform()) / max(1, count // rings) * (azimuth[1] - azimuth[0])
        roll = random.uniform(-math.pi / 2, math.pi / 2) if len(view.arm.joints) > 4 else 0.0
        place = np.array([far * math.cos(turn), far * math.sin(turn), height + view.arm.gripper.jaw_depth])
        try:
            q = kinematics.inverse(view.arm, place, math.pi / 2, roll)[0]
        except Unreachable:
            continue
        tool = view.tools(unknowns, q[None])[0]
        near = len(fitted) > 0 and float(np.linalg.norm(fitted - tool, axis=1).min()) < APART
        if not near and lowest(view, q[None])[0] >= height - 1e-6 and visible(view, q[None], unknowns)[0]:
            out.append(q)
    if 2 * len(out) < count:
        raise Unreachable(
            f"only {len(out)} of {count} places can be reached and seen", "check the work area and the camera's view"
        )
    return out


def _seen_beside(view: MarkerView, unknowns: Unknowns, q: Array, corners: Array) -> Array:
    """How far (2,) the marker's middle is seen from where it was sent, along x and y of `table`, mm."""
    points = view.in_camera(unknowns, q[None])[0]
    expected = view.camera.project(points)
    depth = float(points[:, 2].mean())
    # The difference of two rays at the marker's depth, turned into the table's directions.
    apart = (view.camera.rays(corners) - view.camera.rays(expected)).mean(axis=0) * depth
    return np.asarray((view.T_table_camera[:3, :3] @ apart)[:2])

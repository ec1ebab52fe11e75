"""The certificate: where the arm really goes when it is sent somewhere, at places no fit has seen.

The arm is sent to fresh places over the work area, tool down and jaws a few mm over the table, by the calibrated
model. The camera sees the marker, and what it lies beside its expected place is what a touch there misses by.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from controller.calibration import files
from controller.calibration.arm import ArmCalibration, Residual
from controller.calibration.arm_model import PRIOR_JAWS, PRIOR_OFFSET, MarkerView, Unknowns, has_roll
from controller.calibration.camera import CameraCalibration
from controller.calibration.looks import seen_beside, spread_places, visit
from controller.calibration.marker import ArmMarker
from controller.calibration.table import TableCalibration
from controller.domain import Array
from controller.errors import CalibrationPoorFit, CalibrationStale
from controller.geometry import invert
from controller.ports import Arm, Camera, Clock

#: Places of a routine check.
POINTS = 30
#: The jaw tips stand this far over the table at a touch, mm: more than a calibrated arm misses by in height.
TOUCH_HEIGHT = 5.0
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
        unseen_mm: What the grasp point may lie beside what the marker tells, mm: how well touches showed the jaws.
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
    aligned = np.zeros(len(description.joints))
    straight = Unknowns(invert(calibration.T_base_table), calibration.T_tool_marker, aligned, calibration.jaws)
    fitted = np.array(calibration.places).reshape(-1, 3)
    record = calibration.error_map
    known = None if record is None else record.map
    mapped = () if record is None else record.places
    if calibration.points:
        above = spread_places(view, straight, fitted, FIRST_LOOKS, LOOK_HEIGHT, radius, azimuth, seed)
        _unmoved(camera, clock, move_to, view, straight, above)
    wanted = spread_places(view, straight, fitted, points, height, radius, azimuth, seed, mapped)
    ruler = Unknowns(invert(T_base_table), calibration.T_tool_marker, aligned)
    offsets = np.array([calibration.joint_offsets.get(name, 0.0) for name in description.joint_names])
    places, errors, moved, before = [], [], [], []
    for q in visit(wanted, "place", move_to, progress):
        first = seen_beside(camera, clock, view, straight, q)
        settle()
        beside = seen_beside(camera, clock, view, straight, q)
        target = view.tools(straight, q[None])[0]
        # Sent there by a planner that knows the map, the arm was sent to where the map says that it comes down.
        shift = np.zeros(2) if known is None else np.array(known.at((float(target[0]), float(target[1]))))
        target[:2] += shift
        arrived(target)
        if first is None or beside is None:
            continue
        places.append(target[:2])
        moved.append(first - shift)
        errors.append(beside - shift)
        # Sent to the same place by ruler, the encoders read as joints: the calibrated model says where it ends.
        blind = view.tools(replace(straight, offsets=offsets), q[None])[0]
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
    """Mean distance (mm) of the true grasp point from the one the calibration has.

    The marker shows where the hand is, never where its jaws are, nor, where the last joint is the wrist's pitch, how
    far that is off its mark: its offset is part of the marker's mount. Only jaws that touch things show it.
    """
    y = calibration.sigma.get("jaws_y", PRIOR_JAWS)
    if has_roll(view.arm):
        z = calibration.sigma.get("jaws_z", PRIOR_JAWS)
    else:
        z = float(np.linalg.norm(view.arm.tool)) * calibration.sigma.get(view.arm.joint_names[-1], PRIOR_OFFSET)
    return math.sqrt(math.pi / 4.0) * math.hypot(y, z)  # mean size of a normal deviate in two directions


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
        looks.append(seen_beside(camera, clock, view, unknowns, q))
    seen = [float(np.linalg.norm(look)) for look in looks if look is not None]
    found = f"is seen {np.median(seen):.1f} mm from its place" if seen else "is not seen"
    if not seen or np.median(seen) > MOVED_LIMIT:
        raise CalibrationStale(
            f"the arm's marker {found} (limit {MOVED_LIMIT:g} mm): camera, arm or marker was moved since the "
            "calibration, or it is another cell's",
            "calibrate again: controller calibrate table, then controller calibrate arm",
        )

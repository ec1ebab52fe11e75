"""What is left of the arm's errors after its parameters were found, as a smooth map over the work area.

Links that are not as long as drawn, axes that are askew and play that always lies on the same flank move the tool
by a few tenths of a millimetre, differently from place to place. A map is the last step, never the first, and it
is kept only where places it was not fitted to are met better with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from controller.calibration.arm import ArmCalibration, named
from controller.calibration.arm_model import MarkerView, Unknowns
from controller.calibration.arm_poses import order
from controller.calibration.looks import seen_beside, spread_places, visit
from controller.calibration.map_record import MapRecord
from controller.domain import ErrorMap
from controller.errors import Unreachable
from controller.geometry import invert
from controller.ports import Arm, Camera, Clock

Array = NDArray[np.float64]

#: Places of a map: three for each coefficient of a coordinate.
LOOKS = 18
#: Fewer leave too little to judge a map by.
MIN_LOOKS = 10
#: What a coefficient is expected to be, and what one look is off by chance (play, pixels), mm.
_PRIOR, _NOISE = 0.5, 0.2
#: Left-out places must be met better by this share: choosing the best of three degrees gains some by chance.
_WORTH = 0.1
_TERMS = (1, 3, 6)


def fit_map(places: Array, errors: Array) -> MapRecord:
    """A polynomial in x and y of degree 0, 1 or 2, whichever meets left-out places best, or none.

    Each coefficient is drawn towards zero (ridge), so that few looks make a flat map.

    Args:
        places: ndarray of shape (N, 2): where the arm was sent, `table`, mm.
        errors: ndarray of shape (N, 2): seen minus sent, mm.
    """
    middle = places.mean(axis=0)
    scale = float(np.abs(places - middle).max())
    plain = float(np.linalg.norm(errors, axis=1).mean())
    at = tuple((float(x), float(y)) for x, y in places)
    if len(places) < MIN_LOOKS or scale <= 0.0:
        return MapRecord(None, at, plain, plain)
    found: tuple[float, Array] = (math.inf, np.empty(0))
    for terms in _TERMS:
        basis = ErrorMap.basis((places - middle) / scale)[:, :terms]
        solve = np.linalg.solve(basis.T @ basis + (_NOISE / _PRIOR) ** 2 * np.eye(terms), basis.T)
        # Leave-one-out of a linear smoother needs no refit. Source: Hastie et al., Elements of Statistical
        # Learning, 7.10, equation 7.64.
        left_out = (errors - basis @ solve @ errors) / (1.0 - np.einsum("nt,tn->n", basis, solve))[:, None]
        miss = float(np.linalg.norm(left_out, axis=1).mean())
        if miss < found[0]:
            found = miss, np.vstack([solve @ errors, np.zeros((6 - terms, 2))])
    if found[0] > (1.0 - _WORTH) * plain:
        return MapRecord(None, at, plain, found[0])
    x, y = found[1].T
    fitted = ErrorMap((float(middle[0]), float(middle[1])), scale, tuple(map(float, x)), tuple(map(float, y)))
    return MapRecord(fitted, at, plain, found[0])


@dataclass(frozen=True, slots=True)
class Area:
    """The work area: distances from the base's z axis, mm, and angles about it, rad."""

    radius: tuple[float, float]
    azimuth: tuple[float, float]


def look_around(
    arm: Arm,
    camera: Camera,
    clock: Clock,
    move_to: Callable[[Array], None],
    settle: Callable[[], None],
    view: MarkerView,
    made: ArmCalibration,
    area: Area,
    *,
    clearance: float = 45.0,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
) -> ArmCalibration:
    """The calibration with a map of what it still misses by, where that helps.

    Moves metal above whatever lies on the table; blocks for about three seconds a look.

    Args:
        arm: Energised.
        camera: Open.
        clock: The cell's.
        move_to: Brings the joints to wanted angles (J,), the calibrated joint offsets added by the mover; a
            PlanError leaves the place out.
        settle: Corrects what the encoders still miss of the angles moved to last.
        view: The cell before the fit.
        made: The fit.
        area: Where parts lie.
        clearance: Least height of jaws and plate above the table, mm.
        seed: Of the places.
        progress: Called with one line before each look.

    Raises:
        ArmError, CameraError: A device failed.
    """
    view = replace(view, T_base_table=made.T_base_table)
    straight = Unknowns(invert(made.T_base_table), made.T_tool_marker, np.zeros(len(arm.description.joints)), made.jaws)
    try:
        wanted = spread_places(
            view, straight, np.array(made.places), LOOKS, clearance, area.radius, area.azimuth, seed
        )
    except Unreachable as error:
        progress(f"no map of what is left: {error.cause}")
        return made
    offsets = np.array([made.joint_offsets.get(name, 0.0) for name in arm.description.joint_names])
    begin = np.asarray(arm.state().positions) - offsets
    places, errors = [], []
    for q in visit(order(view, np.array(wanted), begin, clearance), "look", move_to, progress):
        settle()
        beside = seen_beside(camera, clock, view, straight, q)
        if beside is not None:
            places.append(view.tools(straight, q[None])[0, :2])
            errors.append(beside)
    if not places:
        return made
    record = fit_map(np.array(places), np.array(errors))
    progress(
        f"map: {'kept' if record.map else 'of no use'}; places left out of it are missed by {record.with_mm:.2f} mm, "
        f"without it by {record.without_mm:.2f} mm"
    )
    return named(replace(made, calibration_id="", error_map=record))

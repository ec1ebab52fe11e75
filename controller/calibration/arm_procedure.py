"""The procedure of `calibrate arm`: the arm shows its marker at chosen poses and the camera looks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from controller.calibration.arm import ArmCalibration
from controller.calibration.arm_fit import Observation, fit_arm
from controller.calibration.arm_model import MarkerView
from controller.calibration.arm_poses import choose
from controller.calibration.arm_touch import Touch
from controller.calibration.camera import CameraCalibration
from controller.calibration.looks import visit
from controller.calibration.marker import ArmMarker
from controller.calibration.table import TableCalibration
from controller.domain import Array
from controller.errors import CalibrationPoorFit
from controller.ports import Arm, Camera, Clock

#: Time a pose is given to come to rest, s.
SETTLE = 0.3
#: Poses of a calibration: 20 leave 0.7 mm of touch error where 40 leave 0.6 (backlash is the rest).
POSES = 20


def calibrate_arm(
    arm: Arm,
    camera: Camera,
    clock: Clock,
    move_to: Callable[[Array], None],
    *,
    lens: CameraCalibration,
    table: TableCalibration,
    T_base_table: Array,
    marker: ArmMarker | None = None,
    touch: Callable[[ArmCalibration], Sequence[Touch]] | None = None,
    poses: int = POSES,
    clearance: float = 45.0,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
) -> ArmCalibration:
    """Find the arm's base on the table and its joint offsets by looking at the marker on its gripper.

    Moves metal; blocks for about a minute.

    Args:
        arm: Energised, free to move above the work area.
        camera: Open.
        clock: The cell's.
        move_to: Brings the joints to angles (J,), without any joint offsets, about along the straight joint
            line, and returns when they are there; a PlanError leaves the pose out.
        lens: Of the camera.
        table: Of the camera.
        T_base_table: ndarray of shape (4, 4), where the table lies by ruler.
        marker: What is on the gripper.
        touch: Pushes a part with the arm as the marker has shown it, once more where that does not fit; None: the
            marker alone counts.
        poses: How many poses to show.
        clearance: Least height of jaws and plate above the table, mm.
        seed: Of the choice of poses.
        progress: Called with one line before each pose.

    Raises:
        Unreachable: Hardly any pose shows the marker.
        CalibrationPoorFit: The marker was not seen often enough, or the fit is bad, of the touches twice.
        ArmError, CameraError: A device failed.
    """
    view = MarkerView(arm.description, marker or ArmMarker(), lens.camera, table.T_table_camera, T_base_table)
    start = np.asarray(arm.state().positions)
    wanted = choose(view, poses, clearance=clearance, seed=seed, start=start)
    seen: list[Observation] = []
    for _ in visit(wanted, "pose", move_to, progress):
        clock.sleep(SETTLE)
        found = view.marker.find(camera.capture(clock.now()).image, lens.camera)
        if found is not None:
            seen.append(Observation(np.asarray(arm.state().positions), found))
    made = fit_arm(view, seen, lens.calibration_id, table.calibration_id)
    if touch is None or not (touches := touch(made)):
        return made
    try:
        return fit_arm(view, seen, lens.calibration_id, table.calibration_id, touches)
    except CalibrationPoorFit as error:
        # The marker alone has passed. A part that slipped once off the jaws lies elsewhere and comes to rest anew.
        progress(f"{error.cause}: once more")
        return fit_arm(view, seen, lens.calibration_id, table.calibration_id, touch(made) or touches)

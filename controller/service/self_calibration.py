"""The calibration a cell makes of itself when somebody can show it boards: the simulated world's hands.

It is the procedure and the code of `controller calibrate`; only the pair of hands differs. First lens and table
from boards, then the arm's base and joint offsets from the marker on its gripper.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from controller.backends import Devices
from controller.calibration.arm_procedure import calibrate_arm
from controller.calibration.boards import parse_board
from controller.calibration.camera import CameraCalibration
from controller.calibration.guided import calibrate_by_showing
from controller.calibration.store import load_calibration, save, save_calibration
from controller.calibration.table import TableCalibration
from controller.config.cell import CellConfig
from controller.domain import Array, CellCalibration
from controller.errors import SafetyStop
from controller.motion.planner import Planner


def calibrate_camera_and_table(
    devices: Devices, config: CellConfig, folder: Path, progress: Callable[[str], None]
) -> tuple[CameraCalibration, TableCalibration]:
    """Measure lens and table from boards shown to the camera, and keep them in `folder`; the arm by ruler.

    Blocks; the arm does not move.

    Raises:
        CalibrationPoorFit: The views do not determine the lens or the table.
        CameraError: No frame came.
    """
    assert devices.presenter is not None
    board = parse_board(config.table.board)
    lens, table = calibrate_by_showing(devices.camera, devices.presenter, board, devices.clock, progress=progress)
    save_calibration(folder, lens, table, config.table.T_base_table(), arm=devices.arm.description.name)
    return lens, table


def calibrate_cell(
    devices: Devices, config: CellConfig, folder: Path, progress: Callable[[str], None]
) -> CellCalibration:
    """Measure lens, table and arm, and keep the calibration in `folder`.

    Blocks; moves metal: the arm shows its marker to the camera, parks and is relaxed. The table must be empty.

    Raises:
        CalibrationPoorFit: The views do not determine the lens, the table or the arm.
        SafetyStop: A stop was requested in a move; the arm holds still.
        CameraError, ArmError: A device failed.
    """
    lens, table = calibrate_camera_and_table(devices, config, folder, progress)
    arm, bins = devices.arm, config.bin_values()
    planner = Planner(arm.description, load_calibration(folder), bins, speed=config.arm.speed_percent / 100.0)

    def move_to(pose: Array) -> None:
        if not arm.follow(planner.plan_move("calibrate", arm.state().positions, pose)).finished:
            raise SafetyStop("stopped while calibrating", "start again")

    arm.energise()
    made = calibrate_arm(
        arm,
        devices.camera,
        devices.clock,
        move_to,
        lens=lens,
        table=table,
        T_base_table=config.table.T_base_table(),
        progress=progress,
    )
    save(folder, arm=made)
    calibrated = load_calibration(folder)
    home = Planner(arm.description, calibrated, bins, speed=config.arm.speed_percent / 100.0)
    arm.follow(home.park(arm.state().positions))
    arm.relax()
    progress(f"arm: {made.residual_mm.mean:.2f} mm, worst {made.residual_mm.max:.2f} mm at {made.points} poses")
    return calibrated

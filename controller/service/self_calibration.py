"""The calibration a cell makes of itself when somebody can show it boards: the simulated world's hands.

It is the procedure and the code of `controller calibrate`; only the pair of hands differs.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from controller.backends import Devices
from controller.calibration.boards import parse_board
from controller.calibration.guided import calibrate_by_showing
from controller.calibration.store import load_calibration, save_calibration
from controller.config.cell import CellConfig
from controller.domain import CellCalibration


def calibrate_cell(
    devices: Devices, config: CellConfig, folder: Path, progress: Callable[[str], None]
) -> CellCalibration:
    """Measure lens and table from boards shown to the camera, and keep the calibration in `folder`.

    Blocks; the arm does not move.

    Raises:
        CalibrationPoorFit: The views do not determine the lens or the table.
        CameraError: No frame came.
    """
    assert devices.presenter is not None
    board = parse_board(config.table.board)
    lens, table = calibrate_by_showing(devices.camera, devices.presenter, board, devices.clock, progress=progress)
    save_calibration(folder, lens, table, config.table.T_base_table())
    return load_calibration(folder)

"""The arm under a person's hand: opened alone, without camera or cycle, moved by explicit command only."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from controller.backends import DEVICES, BackendOptions, Level, Mode, nominal_camera
from controller.calibration.identified import load_identified
from controller.calibration.store import ARM, load_calibration
from controller.config.arm import load_arm
from controller.config.cell import CellConfig
from controller.domain import ArmState, Array, CellCalibration, Trajectory
from controller.motion.manual import ManualPlanner
from controller.ports import Arm, Clock
from controller.service.folders import state_folder
from controller.service.lock import InstanceLock


@dataclass(frozen=True, slots=True)
class ManualOptions:
    """What the command line asks of manual motion.

    Attributes:
        config: The cell.
        sim: The simulated cell instead of the real one; it starts afresh, its table empty.
        seed, level: Of the simulated cell.
        calibration: Folder of the calibration; None: the stored one of a real cell, else by ruler.
        say: Takes lines for people.
    """

    config: CellConfig
    sim: bool = False
    seed: int = 0
    level: Level = Level.DYNAMIC
    calibration: Path | None = None
    say: Callable[[str], None] = lambda line: None


@dataclass(frozen=True, slots=True)
class ManualCell:
    """An arm that is open, and what is known about where it stands.

    Attributes:
        config: The cell.
        arm: Open; torque as it was found.
        clock: Its time.
        calibration: The best there is.
        planner: Plans at reduced speed.
    """

    config: CellConfig
    arm: Arm
    clock: Clock
    calibration: CellCalibration
    planner: ManualPlanner

    def follow(self, plan: Callable[[Array], Trajectory]) -> bool:
        """Plan from where the arm stands and go; False when it was stopped on its way. Blocks, moves metal."""
        return self.arm.follow(plan(self.arm.state().positions)).finished

    def describe(self, state: ArmState) -> dict[str, Any]:
        """Joints (deg), tool (mm in `table`) and jaws (mm) for people and machines."""
        posture = self.planner.posture(state.positions)
        degrees = dict(zip(self.arm.description.joint_names, posture, strict=True))
        return {
            "joints_deg": {name: round(math.degrees(value), 2) + 0.0 for name, value in degrees.items()},
            "tool_mm": [round(float(value), 1) + 0.0 for value in self.planner.tool(posture)],
            "opening_mm": round(state.opening, 1),
        }


@contextlib.contextmanager
def manual_cell(options: ManualOptions) -> Iterator[ManualCell]:
    """Take the cell's lock and open its arm; both are released at the end, torque left as it is.

    Raises:
        InstanceBusy: The service or another command has the cell.
        DeviceError: The arm is not there or not in order.
    """
    config = options.config
    description = load_arm(config.arm.description)
    with contextlib.ExitStack() as stack:
        if not options.sim:
            stack.enter_context(InstanceLock(state_folder()))
        calibration = calibration_of(options)
        backend = BackendOptions(out=Path(), parts=1, seed=options.seed, level=options.level)
        devices = DEVICES[Mode.SIM if options.sim else Mode.REAL](config, description, backend)
        stack.callback(devices.close)
        devices.clear_table()
        devices.arm.open()
        stack.callback(devices.arm.close)
        folder = calibration_folder(options)
        model = load_identified(folder, description) if folder is not None else description
        planner = ManualPlanner(model, calibration, config.bin_values())
        yield ManualCell(config, devices.arm, devices.clock, calibration, planner)


def by_ruler(config: CellConfig) -> CellCalibration:
    """Camera and arm by data sheet and ruler: good to centimetres."""
    camera, T_table_camera = nominal_camera(config)
    return CellCalibration("by ruler", camera, T_table_camera, config.table.T_base_table())


def calibration_folder(options: ManualOptions) -> Path | None:
    """The folder of the calibration asked for, else of a real cell's stored one, if there is one."""
    if options.calibration is not None or options.sim:
        return options.calibration
    stored = state_folder() / "calibration"
    return stored if (stored / ARM).is_file() else None


def calibration_of(options: ManualOptions) -> CellCalibration:
    """The calibration asked for, else a real cell's stored one, else what ruler and data sheet say.

    Raises:
        CalibrationMissing, CalibrationStale, InputError: The calibration cannot be used.
    """
    folder = calibration_folder(options)
    if folder is not None:
        return load_calibration(folder)
    if not options.sim:
        options.say("warning: the cell is not calibrated: positions are by ruler, good to centimetres")
    return by_ruler(options.config)

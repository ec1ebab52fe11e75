"""Calibrating a cell and certifying it: the procedures, put to work with a set of devices and a folder.

Lens and table come from boards that somebody shows to the camera: here the simulated world's hands, on a real
cell a person with `controller calibrate camera` and `table`. The arm's base and joint offsets come from the marker
on its gripper, and so does the certificate that says what a touch misses by.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from controller import __version__
from controller.backends import DEVICES, BackendOptions, Devices, Level, Mode
from controller.calibration import certificate, files
from controller.calibration.arm import ArmCalibration, Residual
from controller.calibration.arm_model import MarkerView
from controller.calibration.arm_procedure import calibrate_arm
from controller.calibration.arm_touch import PUSHES, Touch, push_part
from controller.calibration.board_spec import parse_board
from controller.calibration.camera import CameraCalibration
from controller.calibration.error_map import Area, look_around
from controller.calibration.guided import calibrate_by_showing
from controller.calibration.marker import ArmMarker
from controller.calibration.store import (
    CAMERA,
    CERTIFICATE,
    TABLE,
    cell_calibration,
    load,
    load_calibration,
    save,
    save_calibration,
)
from controller.calibration.table import TableCalibration
from controller.calibration.touch_map import touch_map
from controller.config.arm import load_arm
from controller.config.cell import CellConfig
from controller.cycle.view import Backdrop, region_mask
from controller.domain import Array, CellCalibration, LocatedObject, Shape
from controller.errors import CalibrationMissing, SafetyStop
from controller.localization.locate import locate
from controller.motion.planner import Planner
from controller.service.at_work import at_work, planner_in
from controller.service.folders import new_run_folder, state_folder
from controller.service.lock import InstanceLock
from controller.vision.detect import detect
from controller.vision.recipe import Recipe, load_recipe

Say = Callable[[str], None]

MAP = "certificate.png"


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """What the command line asks of a calibration.

    Attributes:
        config: The cell.
        sim: The simulated cell instead of the real one.
        seed, level: Of the simulated cell.
        folder: Where the calibration is kept; None: a real cell's own place, or a new folder for a simulated one.
        say: Takes lines for people.
    """

    config: CellConfig
    sim: bool = False
    seed: int = 0
    level: Level = Level.DYNAMIC
    folder: Path | None = None
    say: Say = lambda line: None


def own_folder(options: CalibrationOptions) -> Path | None:
    """Where the calibration is kept; None: a simulated cell that was given none makes its own."""
    if options.folder is not None or options.sim:
        return options.folder
    return state_folder() / "calibration"


@contextmanager
def open_cell(options: CalibrationOptions) -> Iterator[tuple[Devices, Path]]:
    """Take the cell's lock and open its devices, the simulated table empty; yields them and the calibration's folder.

    Raises:
        InstanceBusy: The service or another command has the cell.
        DeviceError: A device is not there or not in order.
    """
    description = load_arm(options.config.arm.description)
    with ExitStack() as stack:
        if not options.sim:
            stack.enter_context(InstanceLock(state_folder()))
        backend = BackendOptions(out=Path(), parts=1, seed=options.seed, level=options.level)
        devices = DEVICES[Mode.SIM if options.sim else Mode.REAL](options.config, description, backend)
        stack.callback(devices.close)
        devices.clear_table()
        devices.open()
        yield devices, own_folder(options) or new_run_folder(None, datetime.now()) / "calibration"


def calibrate_camera_and_table(
    devices: Devices, config: CellConfig, folder: Path, progress: Say
) -> tuple[CameraCalibration, TableCalibration]:
    """Measure lens and table from boards shown to the camera, and keep them in `folder`; the arm by ruler.

    Blocks; the arm does not move.

    Raises:
        CalibrationPoorFit: The views do not determine the lens or the table.
        CameraError: No frame came.
    """
    assert devices.presenter is not None
    board = parse_board(config.table.board)
    field = math.radians(config.camera.field_of_view_deg)
    lens, table = calibrate_by_showing(
        devices.camera, devices.presenter, board, devices.clock, field=field, progress=progress
    )
    noted = _provenance(devices, config)
    save_calibration(
        folder, lens, table, config.table.T_base_table(), arm=devices.arm.description.name, provenance=noted
    )
    return lens, table


def calibrate_arm_in(
    devices: Devices, config: CellConfig, folder: Path, progress: Say, *, thorough: bool = True
) -> ArmCalibration:
    """Measure where the arm stands and how its joints are mounted, with the lens and table of `folder`; keep it there.

    Blocks; moves metal: the arm shows its marker to the camera, touches a round part where one lies there, parks and is
    relaxed. Nothing else may lie on the table.

    Args:
        devices: Open.
        config: The cell.
        folder: Of the calibration.
        progress: Takes lines for people.
        thorough: Push the part twice as often, and map what is left of the errors over the work area: a minute more.

    Raises:
        CalibrationMissing: There is no lens or table in the folder.
        CalibrationStale: The table was measured with another lens.
        CalibrationPoorFit: The looks do not determine the arm.
        SafetyStop: A stop was requested in a move; the arm was parked.
        CameraError, ArmError: A device failed; the arm holds still.
    """
    # The arm's own file is not asked: it may belong to the table that was just measured anew.
    lens = CameraCalibration.load(folder / CAMERA)
    table = TableCalibration.load(folder / TABLE, lens)
    by_ruler = CellCalibration("by ruler", lens.camera, table.T_table_camera, config.table.T_base_table())
    with at_work(devices.arm, config, by_ruler, folder) as mover:

        def touch(known: ArmCalibration) -> list[Touch]:
            devices.lay_round_part()
            calibration = cell_calibration(lens, table, known)
            planner = planner_in(devices.arm, config, calibration, folder)
            look = partial(_round_part, devices, config, planner, load_recipe(config.vision.recipe))
            pushes = PUSHES if thorough else PUSHES // 2
            touches = push_part(devices.arm, devices.clock, planner, look, pushes, progress)
            devices.clear_table()
            return touches

        made = calibrate_arm(
            devices.arm,
            devices.camera,
            devices.clock,
            mover.to,
            lens=lens,
            table=table,
            T_base_table=config.table.T_base_table(),
            touch=touch,
            progress=progress,
        )
        if thorough:
            mover.planner = planner_in(devices.arm, config, cell_calibration(lens, table, made), folder)
            made = look_around(
                devices.arm,
                devices.camera,
                devices.clock,
                mover.to,
                mover.settle,
                MarkerView(devices.arm.description, ArmMarker(), lens.camera, table.T_table_camera, made.T_base_table),
                made,
                _area(config),
                progress=progress,
            )
        save(folder, arm=made, provenance=_provenance(devices, config))
        mover.planner = planner_in(devices.arm, config, load_calibration(folder), folder)
    progress(f"arm: {made.residual_mm.mean:.2f} mm, worst {made.residual_mm.max:.2f} mm at {made.points} poses")
    return made


def _lying(devices: Devices, config: CellConfig, planner: Planner, recipe: Recipe) -> list[LocatedObject]:
    """What lies in the work area, but for what runs into the bins or the arm: shadows of theirs."""
    calibration = planner.calibration
    frame = devices.camera.capture(devices.clock.now(), config.camera.frame_timeout_s)
    devices.clock.charge(config.cycle.vision_budget_s)
    region = region_mask(config, calibration, frame.size)
    hidden = Backdrop(config, calibration, frame.size).mask(planner.hidden(devices.arm.state().positions))
    plane = calibration.plane(config.shape_plane_mm)
    found = detect(frame, recipe, plane=plane, region=region, hidden=hidden).detections
    located = locate(found, calibration, config.part_height)
    return [
        thing
        for thing in (*located.objects, *located.in_the_way)
        if config.in_work_area(thing.center, calibration.T_base_table) and thing.size[0] >= config.vision.smallest_mm
    ]


def _round_part(devices: Devices, config: CellConfig, planner: Planner, recipe: Recipe) -> LocatedObject | None:
    """The only round part in the work area, if one and nothing else lies there."""
    things = _lying(devices, config, planner, recipe)
    return things[0] if len(things) == 1 and things[0].shape is Shape.CIRCLE else None


def _area(config: CellConfig) -> Area:
    area = config.table.work_area
    low, high = np.radians(area.azimuth_deg)
    return Area((area.inner_radius_mm, area.outer_radius_mm), (float(low), float(high)))


def calibrate_cell(
    devices: Devices, config: CellConfig, folder: Path, progress: Say, *, thorough: bool = True
) -> CellCalibration:
    """Measure lens, table and arm, and keep the calibration in `folder`; see the two steps."""
    calibrate_camera_and_table(devices, config, folder, progress)
    calibrate_arm_in(devices, config, folder, progress, thorough=thorough)
    return load_calibration(folder)


def check_cell(
    devices: Devices, config: CellConfig, folder: Path, seed: int, progress: Say, points: int = certificate.POINTS
) -> dict[str, Any]:
    """Send the arm to places no fit has seen, write down what it misses by, and return the certificate.

    Blocks; moves metal: the jaws come near the table, which must be empty; then the arm parks and is relaxed.

    Args:
        devices: Open.
        config: The cell.
        folder: Of the calibration; `certificate.json` and its picture are written beside it.
        seed: Of the places.
        progress: Takes lines for people.
        points: Number of places.

    Raises:
        CalibrationMissing: The arm was not calibrated.
        CalibrationStale: The files belong to other devices or not together, or something was moved since.
        CalibrationPoorFit: The camera saw the marker too seldom.
        SafetyStop: Something lies in the work area, and nothing moved; or a stop was requested, and the arm was parked.
        CameraError, ArmError: A device failed; the arm holds still.
    """
    stored = load(folder)
    stored.check(arm=devices.arm.description.name, devices=device_names(devices, config))
    if stored.arm is None or not stored.arm.points:
        raise CalibrationMissing("the arm was placed by ruler only", "run `controller calibrate arm` first")
    planner = planner_in(devices.arm, config, stored.cell(), folder)
    left = _lying(devices, config, planner, load_recipe(config.vision.recipe))
    if left:
        x, y = left[0].center
        raise SafetyStop(
            f"the table is not empty: a {left[0].shape} lies at ({x:.0f}, {y:.0f}) mm, and the jaws will come down to "
            f"{certificate.TOUCH_HEIGHT:g} mm over it",
            "clear the work area, then check again",
        )
    missed: list[Array] = []

    def compare(place: Array) -> None:
        if devices.truth is not None:
            missed.append(np.array(devices.truth.tool()) - place)

    area = _area(config)
    with at_work(devices.arm, config, stored.cell(), folder) as mover:
        found = certificate.check_arm(
            devices.arm,
            devices.camera,
            devices.clock,
            mover.to,
            mover.settle,
            lens=stored.camera,
            table=stored.table,
            calibration=stored.arm,
            T_base_table=config.table.T_base_table(),
            seed=seed,
            points=points,
            radius=area.radius,
            azimuth=area.azimuth,
            arrived=compare,
            progress=progress,
        )
    content = found.to_json()
    if missed:
        beside = np.array(missed)
        content["truth_mm"] = _rounded(Residual.of(np.linalg.norm(beside[:, :2], axis=1)))
        content["truth_height_mm"] = _rounded(Residual.of(np.abs(beside[:, 2])))
    content |= {
        "limits_mm": {"mean": certificate.MEAN_LIMIT, "p95": certificate.P95_LIMIT},
        "places_seed": seed,
        "camera_id": stored.camera.calibration_id,
        "table_id": stored.table.calibration_id,
        "arm": devices.arm.description.name,
        **_provenance(devices, config),
    }
    content["certificate_id"] = files.identity("certificate", content)
    files.write(folder / CERTIFICATE, content)
    picture = touch_map(found, config.work_area_outline(stored.arm.T_base_table), content["made_at"])
    cv2.imwrite(str(folder / MAP), picture)
    return content


# --- notes ----------------------------------------------------------------------------------------------


def device_names(devices: Devices, config: CellConfig) -> Mapping[str, str]:
    """What must be the same at work as at the calibration: the devices by their serial numbers, where they have any."""
    return devices.names or {"camera": _by_serial(config.camera.device), "port": _by_serial(config.arm.port)}


def _by_serial(device: str) -> str:
    """The link that the system names after a device's maker and serial number; the device itself without one."""
    target = Path(device).resolve()
    links = sorted((*Path("/dev/v4l/by-id").glob("*"), *Path("/dev/serial/by-id").glob("*")))
    return next((link.name for link in links if link.resolve() == target), device)


def _provenance(devices: Devices, config: CellConfig) -> dict[str, str]:
    return {**provenance_now(), **device_names(devices, config)}


def provenance_now() -> dict[str, str]:
    """When and by what a calibration is made."""
    made_at = datetime.now().astimezone().isoformat(timespec="seconds")
    return {"made_at": made_at, "software": f"controller {__version__}"}


def _rounded(figures: Residual) -> dict[str, float]:
    return {name: round(value, 4) for name, value in figures.to_json().items()}

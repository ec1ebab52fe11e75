"""One run from the lock to the report: devices, calibration, cycle, figures, pictures.

The order is fixed: nothing is opened before the configuration is known to be sound, nothing moves before
devices and calibration are, and whatever happens the devices are released and the record is closed.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from time import monotonic
from typing import Any

import cv2

from controller import __version__
from controller.backends import DEVICES, BackendOptions, Devices, Level, Mode, nominal_camera, rehearsed
from controller.calibration.approval import approve
from controller.calibration.identified import load_identified
from controller.calibration.store import load, load_calibration
from controller.config.arm import load_arm
from controller.config.cell import CellConfig
from controller.cycle.preflight import check
from controller.cycle.rehearsal import AIR_SPEED, AirPlanner, Rehearsal
from controller.cycle.rig import Observer, Rig
from controller.cycle.sorter import Sorter
from controller.domain import ArmDescription, CellCalibration, PickPlan
from controller.errors import CalibrationMissing, CalibrationStale, DeviceError, SorterError
from controller.insight.report import annotated, page, side_by_side
from controller.insight.statistics import Album, Statistics
from controller.ledger.sqlite import SqliteLedger
from controller.motion.planner import Planner
from controller.service.chronicle import Chronicle
from controller.service.controls import Refused
from controller.service.failpoints import LedgerWithFailpoints
from controller.service.faults import FaultRecord
from controller.service.folders import new_run_folder, state_folder
from controller.service.lock import InstanceLock
from controller.service.scenery import clear_view, look_before_work, watch_landmarks, watch_scenery
from controller.service.self_calibration import calibrate_cell, device_names
from controller.service.standing_cell import Standing, StandingCell
from controller.service.standing_service import Service
from controller.service.taught_classes import taught_classes
from controller.vision.recipe import load_recipe


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What the command line asks of a run; see `controller run --help`.

    Attributes:
        reread: Reads the configuration again, when a standing cell is told to.
        watch: Called when the devices are open and calibrated, before the work begins: the observers it returns
            are told of the run, and it may put its own watchers before the devices.
    """

    mode: Mode
    config: CellConfig
    reread: Callable[[], CellConfig] | None = None
    out: Path | None = None
    replay: Path | None = None
    calibration: Path | None = None
    parts: int | None = None
    seed: int = 0
    level: Level = Level.DYNAMIC
    real_time: bool = False
    start: bool = False
    rehearsal: Rehearsal = Rehearsal.NONE
    faults: Path | None = None
    disturb: str = ""
    pick_proof: bool = True
    observers: tuple[Observer, ...] = ()
    watch: Callable[[Devices], Sequence[Observer]] = lambda devices: ()
    confirm: Callable[[PickPlan], bool] = lambda plan: True
    say: Callable[[str], None] = lambda line: None


class Session:
    """One run; `stop` may be called from another thread or a signal handler.

    Attributes:
        figures: Those of the run, as soon as it has ended, in FAULT as well; empty before.
    """

    def __init__(self, options: RunOptions) -> None:
        self.options = options
        self.figures: dict[str, Any] = {}
        self._config = options.config
        if options.mode is Mode.REPLAY or options.rehearsal is not Rehearsal.NONE:
            # The next picture shows the next table, or there is none: everything in this one is worked off first.
            cycle = options.config.cycle.model_copy(update={"picks_per_look": 100})
            self._config = options.config.model_copy(update={"cycle": cycle})
        self._stop = threading.Event()
        self._end: Callable[[], None] = lambda: None
        self._reload: Callable[[], None] = lambda: None

    def reload(self) -> None:
        """Read the configuration of a standing cell again, soon; from any thread or a signal's handler."""
        self._reload()

    def stop(self) -> None:
        """End the run soon: the arm slows down along its path, parks, and lets go of the torque."""
        self._stop.set()
        self._end()

    def run(self) -> dict[str, Any]:
        """Sort, and say how it went; on a real cell, sort whenever an operator starts it, until it is to end.

        Returns:
            The figures of the contract of `controller run --json`.

        Raises:
            SorterError: The run could not begin, or the cell ended in FAULT (after the arm was made safe and
                the report written).
        """
        arm = load_arm(self._config.arm.description)
        recipe = load_recipe(self._config.vision.recipe)
        taught = taught_classes(self._config, recipe)
        for warning in check(self._config, arm, self._planner(arm, self._by_ruler(), self._config)):
            self.options.say(f"warning: {warning}")
        folder = state_folder()
        real, rehearsal = self.options.mode is Mode.REAL, self.options.rehearsal
        sorting = rehearsal is Rehearsal.NONE
        if not real or not sorting or self.options.out is not None:
            folder = new_run_folder(self.options.out, datetime.now())
        with InstanceLock(folder), contextlib.ExitStack() as stack:
            if real and not sorting:
                stack.enter_context(InstanceLock(state_folder()))
            service = Service.standing_by(self._config, stack) if real and sorting else None
            devices = DEVICES[self.options.mode](self._config, arm, self._backend_options(folder, service))
            stack.callback(devices.close)
            missing = self._open(devices, service) if not real or sorting else None
            calibration, calibration_s = self._calibrated(devices, folder)
            if not sorting:
                devices = rehearsed(devices, arm, self._backend_options(folder, service), rehearsal)
                stack.callback(devices.close)
                devices.open()
            if rehearsal is Rehearsal.DRY:
                # The arm that records is as it is described: none of its joints is mounted askew.
                calibration = replace(calibration, joint_offsets={})
            watch_scenery(devices.camera, self._config, calibration, folder if real else None)
            ledger = stack.enter_context(SqliteLedger(folder / "ledger.db", clock=devices.clock))
            statistics = Statistics(self._config, devices.truth)
            faults = FaultRecord()
            watchers = self.options.watch(devices)
            album = Album(devices.portrait)
            record = ledger if devices.script is None else LedgerWithFailpoints(ledger, devices.script)
            chronicle = Chronicle(record, devices.clock)
            own = (statistics, faults, chronicle, album)
            rig = Rig(
                self._config,
                devices.camera,
                devices.arm,
                devices.clock,
                record,
                calibration,
                recipe,
                self._planner_for(self._config, calibration),
                observers=(*devices.observers, *own, *self.options.observers, *watchers),
                confirm=self.options.confirm if service is None else service.while_idle(self.options.confirm),
                classes=taught,
                concerns=devices.concerns,
                clear_view=clear_view(calibration, folder if real else None),
                pick_proof=self.options.pick_proof,
            )
            ledger.begin_run(
                software_version=__version__,
                config_hash=self._config.digest,
                calibration_id=calibration.calibration_id,
                mode=str(self.options.mode),
                arm=arm.name,
                seed=self.options.seed if self.options.mode is Mode.SIM else None,
            )
            if taught is not None:
                ledger.note("classes", devices.clock.now(), digest=taught.digest, names=list(taught.classifier.names))
            if recipe.model is not None:
                ledger.note("model", devices.clock.now(), file=recipe.model.file, sha256=recipe.model.sha256)
            if self.options.mode is not Mode.REPLAY and sorting:
                look_before_work(rig.clear_view, rig.camera, rig.clock, self._config.camera.frame_timeout_s)
            began, began_wall = devices.clock.now(), monotonic()
            if service is None:
                sorter: Sorter | None = self._sort(rig)
            else:
                standing = Standing(
                    service, devices, ledger, chronicle, self._reread, self._planner_for, self._by_ruler,
                    self.options.say,
                )  # fmt: skip
                sorter = self._operate(rig, standing, missing)
            ledger.end_run(f"fault: {sorter.fault}" if sorter and sorter.fault else "stopped")
            report = self._head(arm)
            report |= statistics.summary(sorter.left if sorter else 0, sorter.cycle_times if sorter else [])
            report |= {
                "faults": faults.faults,
                "calibration_s": round(calibration_s, 3),
                "sim_s": round(devices.clock.now() - began, 3),
                "wall_s": round(monotonic() - began_wall, 3),
                "out": str(folder),
            }
            self.figures = report
            try:
                self._write(folder, report, album)
            finally:
                if sorter is not None and sorter.fault is not None:
                    raise sorter.fault
            return report

    # --- at work --------------------------------------------------------------------------------------

    def _sort(self, rig: Rig) -> Sorter:
        """Sort once, until nothing is left to pick."""
        sorter = Sorter(rig, until_empty=True)
        self._end = sorter.request_stop
        if self._stop.is_set():
            sorter.request_stop()
        sorter.run()
        return sorter

    def _operate(self, rig: Rig, standing: Standing, missing: SorterError | None) -> Sorter | None:
        """Sort whenever an operator starts the cell, until it is to end; the last sorter, if there was one."""
        cell = StandingCell(rig, standing, missing)
        self._end, self._reload = cell.operation.end, cell.reload_soon
        if self._stop.is_set():
            cell.operation.end()
        return cell.run(start=self.options.start, most_parts=self.options.parts)

    # --- parts of a run -------------------------------------------------------------------------------

    def _head(self, arm: ArmDescription) -> dict[str, Any]:
        head: dict[str, Any] = {"mode": str(self.options.mode), "arm": arm.name}
        if self.options.mode is Mode.SIM:
            head |= {"level": str(self.options.level), "seed": self.options.seed}
        if self.options.rehearsal is not Rehearsal.NONE:
            head |= {"rehearsal": str(self.options.rehearsal)}
        return head

    def _backend_options(self, folder: Path, service: Service | None) -> BackendOptions:
        return BackendOptions(
            out=folder,
            watch_clock=service.watch if service is not None else lambda clock: clock,
            replay=self.options.replay,
            parts=8 if self.options.parts is None else self.options.parts,
            seed=self.options.seed,
            level=self.options.level,
            faults=self.options.faults,
            disturb=self.options.disturb,
            real_time=self.options.real_time,
        )

    def _open(self, devices: Devices, service: Service | None) -> SorterError | None:
        """Open the devices; under a service manager a missing one is an alarm of a service that is there."""
        try:
            devices.open()
        except DeviceError as error:
            if service is None or not service.notifier.listening:
                raise
            return error
        return None

    def _reread(self) -> CellConfig:
        if self.options.reread is None:
            raise Refused("nobody knows where the configuration came from", "start the program again")
        return self.options.reread()

    def _planner_for(self, config: CellConfig, calibration: CellCalibration) -> Planner:
        """A planner for the arm as identified."""
        return self._planner(self._as_identified(load_arm(config.arm.description)), calibration, config)

    def _planner(self, arm: ArmDescription, calibration: CellCalibration, config: CellConfig) -> Planner:
        speed = config.arm.speed_percent / 100.0
        if self.options.rehearsal is Rehearsal.AIR:
            return AirPlanner(arm, calibration, config.bin_values(), speed=min(speed, AIR_SPEED))
        return Planner(arm, calibration, config.bin_values(), speed=speed)

    def _as_identified(self, arm: ArmDescription) -> ArmDescription:
        """The arm with the figures that belong to the calibration, where it was identified."""
        folder = self.options.calibration
        if folder is None and self.options.mode is Mode.REAL:
            folder = state_folder() / "calibration"
        return load_identified(folder, arm) if folder is not None else arm

    def _by_ruler(self) -> CellCalibration:
        camera, T_table_camera = nominal_camera(self._config)
        return CellCalibration("by ruler", camera, T_table_camera, self._config.table.T_base_table())

    def _calibrated(self, devices: Devices, folder: Path) -> tuple[CellCalibration, float]:
        """The calibration to work with, and how long its making took (s of the cell's clock)."""
        given = self.options.calibration
        if given is not None and self.options.mode is Mode.REPLAY:
            # The arm that records is as it is described: none of its joints is mounted askew.
            return replace(load_calibration(given), joint_offsets={}), 0.0
        if given is not None:
            return self._approved(devices, given), 0.0
        if devices.presenter is not None:
            self.options.say("calibrating the cell by showing it boards")
            began = devices.clock.now()
            devices.clear_table()
            made = calibrate_cell(
                devices, self._config, folder / "calibration", self.options.say, thorough=False
            )
            devices.lay_parts()
            watch_landmarks(devices.camera, folder / "calibration")
            return made, devices.clock.now() - began
        if self.options.mode is Mode.REPLAY:
            self.options.say("warning: no --calibration: positions are by ruler and data sheet, good to centimetres")
            return self._by_ruler(), 0.0
        stored = state_folder() / "calibration"
        if stored.is_dir():
            return self._approved(devices, stored), 0.0
        raise CalibrationMissing(
            f"no calibration in {stored}", "make one with controller calibrate, or name one with --calibration"
        )

    def _approved(self, devices: Devices, folder: Path) -> CellCalibration:
        """A stored calibration, when it may move this cell's arm.

        Raises:
            CalibrationError: It may not; the cause says why.
        """
        stored = load(folder)
        watch_landmarks(devices.camera, folder)
        if self._config.table.corner_markers and not stored.table.landmarks:
            raise CalibrationStale(
                "the table was measured without its corner markers", "lay them in view, then controller calibrate table"
            )
        arm, names = devices.arm.description.name, device_names(devices, self._config)
        if self.options.rehearsal is not Rehearsal.NONE:
            stored.check(arm=arm, devices=names)
            return stored.cell()
        try:
            approve(folder, stored, arm=arm, devices=names, now=datetime.now().astimezone())
        except CalibrationMissing as error:
            if self.options.mode is Mode.REAL:
                raise
            self.options.say(f"warning: {error.cause}; a real cell would not move ({error.remedy})")
        return stored.cell()

    def _write(self, folder: Path, report: dict[str, Any], album: Album) -> None:
        """The report and its pictures; SorterError when they cannot be written."""
        pictures = {}
        for name, look in (("before", album.first), ("after", album.last)):
            if look is not None:
                pictures[name] = annotated(look)
        if album.at_work is not None and "before" in pictures:
            pictures["cell"] = side_by_side(album.at_work, pictures["before"])
        for name, picture in pictures.items():
            cv2.imwrite(str(folder / f"{name}.png"), picture)
        try:
            (folder / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
            (folder / "report.html").write_text(page(report, pictures), encoding="utf-8")
        except OSError as error:
            raise SorterError(f"{folder}: no report: {error.strerror or error}", "free some space there") from error

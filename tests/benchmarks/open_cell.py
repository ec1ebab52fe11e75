"""A simulated cell that is calibrated and open: processes that sort are forked from it, a second each.

What is made once (boards, painters, the physics' model) is made here, not in every process.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, TypeVar, cast

from controller.backends import DEVICES, BackendOptions, Devices, Level, Mode
from controller.config.arm import load_arm
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.domain import ArmDescription
from tests.benchmarks.cell_vision import look_at_cell
from tests.unit.calibration.certified import certify

SEED, PARTS = 7, 2
FORK = multiprocessing.get_context("fork")
T = TypeVar("T")
_NEVER = '[[fault]]\nfault = "camera_stalled"\nat_s = 86400\n'


@dataclass(frozen=True, slots=True)
class OpenCell:
    """A simulated cell, level dynamic, with devices that are open and take faults by script.

    Attributes:
        config: The shipped one.
        calibration: Folder; certified.
        devices: To be used once, in a process of their own.
    """

    config: CellConfig
    calibration: Path
    devices: Devices

    @classmethod
    def make(cls, folder: Path, calibration: Path | None = None) -> OpenCell:
        """Open a cell's devices; calibrate it into the folder, unless its calibration is given."""
        if calibration is None:
            look_at_cell(SEED, PARTS, "dynamic", folder)
            calibration = folder / "calibration"
            certify(calibration)
        faults = folder / "none.toml"
        faults.write_text(_NEVER, encoding="utf-8")
        config = load_cell(shipped("sim.toml"))
        options = BackendOptions(folder, parts=PARTS, seed=SEED, level=Level.DYNAMIC, faults=faults)
        devices = DEVICES[Mode.SIM](config, load_arm(config.arm.description), options)
        devices.presenter = devices.portrait = None
        devices.open()
        devices.camera.capture(devices.clock.now())
        return cls(config, calibration, devices)

    def factory(self, config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
        """Stands in for whatever makes devices; see `controller.backends.DEVICES`."""
        return self.devices

    @property
    def world(self) -> Any:
        """The physics."""
        return cast(Any, self.devices.truth).cell.world


def _send(work: Callable[[], object], line: Connection) -> None:
    line.send(work())


def apart(jobs: Iterable[Callable[[], T]], at_once: int = 1) -> Iterator[tuple[int, T | None]]:
    """Do jobs in forked processes of their own; yields number and result as they end, None where the process died."""
    waiting, running = list(enumerate(jobs)), dict[Any, tuple[int, Any]]()
    waiting.reverse()
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                number, job = waiting.pop()
                ours, theirs = FORK.Pipe(duplex=False)
                process = FORK.Process(target=_send, args=(job, theirs))
                process.start()
                theirs.close()
                running[ours] = number, process
            for line in cast("list[Connection]", wait(list(running))):
                number, process = running.pop(line)
                try:
                    result: T | None = line.recv()
                except EOFError:
                    result = None
                line.close()
                process.join()
                yield number, result
    finally:
        for _, process in running.values():
            process.kill()
            process.join()

"""A set of devices behind the ports, and what a set is asked for with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from controller.config.cell import CellConfig
from controller.cycle.rig import Observer
from controller.domain import ArmDescription
from controller.errors import DeviceError
from controller.ports import Arm, Camera, Clock, Presenter, Truth

if TYPE_CHECKING:
    from sim_backends.fault_script import FaultDirector


class Mode(StrEnum):
    """Which set of devices a run works with."""

    REAL = "real"
    SIM = "sim"
    REPLAY = "replay"


class Level(StrEnum):
    """How imperfect the simulated world is."""

    IDEAL = "ideal"
    STATIC = "static"
    DYNAMIC = "dynamic"


@dataclass(frozen=True, slots=True)
class BackendOptions:
    """What only some sets need.

    Attributes:
        out: Folder of the run.
        replay: Folder of pictures to replay.
        parts: Parts on the simulated table.
        seed: Seed of the simulated world.
        level: Imperfections of the simulated world.
        real_time: Simulated world in a process of its own, paced by the wall clock, bus on a pseudo-terminal.
        faults: Script of what goes wrong in the simulated cell.
        disturb: What disturbs the simulated cell, as a wish of `sim_backends.disturbances`.
        watch_clock: Wraps the devices' clock, for whoever watches that the cell makes progress.
    """

    out: Path
    replay: Path | None = None
    parts: int = 8
    seed: int = 0
    level: Level = Level.DYNAMIC
    real_time: bool = False
    faults: Path | None = None
    disturb: str = ""
    watch_clock: Callable[[Clock], Clock] = lambda clock: clock


@dataclass(frozen=True, slots=True)
class Touch:
    """The arm touched what it should not touch.

    Attributes:
        at: When it began, s.
        what: What touched what.
        disturbed: When a disturbance last moved what was touched, s; None: never.
    """

    at: float
    what: str
    disturbed: float | None = None


@dataclass(slots=True)
class Devices:
    """A set of devices behind the ports.

    Attributes:
        presenter: Hands that show calibration boards, where somebody has them.
        truth: The simulated world's truth, where there is one.
        clear_table, lay_parts: Take all parts off the table and put them back, where the table is simulated.
        portrait: A picture of the whole cell for people, where there is one.
        miniature: The same, small and quick to make, for films.
        on_step: Has something called before every step of simulated time, with the step's length (s); None where
            the clock is not simulated here.
        touches: When the arm touched what it should not touch, where that can be known.
        concerns: What is not in order and no reason to stop yet: causes in words by code of the fault catalogue.
        observers: Watchers a set needs for itself.
        script: Lets a script's faults happen, where one was given.
        disturbed: What has disturbed the cell so far: kind and s after the work began.
        names: What stands for the serial numbers of simulated devices, by what they are.
        lay_round_part: Puts a round part into the middle of the work area, where the table is simulated; a person does
            so on a real cell.
        closers: Called in reverse order by `close`.
    """

    camera: Camera
    arm: Arm
    clock: Clock
    presenter: Presenter | None = None
    truth: Truth | None = None
    clear_table: Callable[[], None] = lambda: None
    lay_parts: Callable[[], None] = lambda: None
    portrait: Callable[[], NDArray[np.uint8]] | None = None
    miniature: Callable[[], NDArray[np.uint8]] | None = None
    on_step: Callable[[Callable[[float], None]], None] | None = None
    touches: Callable[[], Sequence[Touch]] = lambda: ()
    concerns: Callable[[], Mapping[str, str]] = dict
    observers: tuple[Observer, ...] = ()
    script: FaultDirector | None = None
    disturbed: Callable[[], Sequence[tuple[float, str]]] = lambda: ()
    names: Mapping[str, str] = field(default_factory=dict)
    lay_round_part: Callable[[], None] = lambda: None
    closers: list[Callable[[], None]] = field(default_factory=list)

    def open(self, *, restart: bool = False) -> None:
        """Open camera and arm; when both fail, the error names both.

        Args:
            restart: Restart the servos that have shut themselves down.

        Raises:
            DeviceError: One of them is not there or not in order.
        """
        failures: list[DeviceError] = []
        for device, opened in ((self.camera, self.camera.open), (self.arm, partial(self.arm.open, restart=restart))):
            try:
                opened()
                self.closers.append(device.close)
            except DeviceError as error:
                failures.append(error)
        if failures:
            first = failures[0]
            first.cause = "; and ".join(failure.cause for failure in failures)
            first.remedy = "; ".join(dict.fromkeys(failure.remedy for failure in failures if failure.remedy))
            raise first

    def reopen(self) -> None:
        """Open camera and arm again after an operator's reset, whatever has become of them. Moves nothing.

        Servos that have shut themselves down are restarted; they have no torque until the arm is energised.

        Raises:
            DeviceError: One of them is not there or not in order; the other is open.
        """
        for device in (self.camera, self.arm):
            device.close()
            if device.close in self.closers:
                self.closers.remove(device.close)
        self.open(restart=True)

    def close(self) -> None:
        """Release everything, last opened first."""
        while self.closers:
            self.closers.pop()()


Factory = Callable[[CellConfig, ArmDescription, BackendOptions], Devices]

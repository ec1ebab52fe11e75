"""Machines made up for the doctor: what is plugged in, and what answers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from datetime import UTC, datetime

import numpy as np

from controller.backends import BackendOptions, Devices
from controller.config.cell import CellConfig
from controller.domain import ArmDescription, ArmState, Frame
from controller.errors import SorterError
from controller.service.doctor import devices
from controller.service.doctor.case import Case
from controller.service.doctor.finding import Finding, Level
from sim_backends.virtual_clock import VirtualClock

NOW = datetime(2026, 11, 22, tzinfo=UTC)


def no_command(command: Sequence[str]) -> str:
    raise SorterError(f"{command[0]}: no such command")


def never_opened(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
    raise AssertionError("devices must not be opened here")


def plug_in(case: Case, latency: str | None = "1") -> Case:
    """Camera and servo adapter, by the names that the shipped rules give them."""
    dev = case.root / "dev"
    for name, link in (("video0", "sorter-cam"), ("ttyUSB0", "sorter-arm")):
        (dev / name).touch()
        (dev / link).symlink_to(name)
    if latency is not None:
        timer = case.root / "sys/bus/usb-serial/devices/ttyUSB0/latency_timer"
        timer.parent.mkdir(parents=True)
        timer.write_text(latency + "\n")
    return case


def level_of(finding: Finding | None) -> Level:
    assert finding is not None
    # Whoever is told of trouble is told what to do about it, and nobody else.
    assert bool(finding.remedy) == (finding.level is not Level.OK)
    return finding.level


class GreyCamera:
    """A camera that shows one grey picture."""

    def __init__(self, grey: int, refused: tuple[str, ...]) -> None:
        self.settings_in_force = {"exposure": 156.0, "focus": 20.0}
        self.refused_settings = refused
        self.open_count = 0
        self._image = np.full((48, 64, 3), grey, np.uint8)

    def open(self) -> None:
        self.open_count += 1

    def close(self) -> None:
        self.open_count -= 1

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        return Frame(1, after, self._image)


class SilentArm:
    """An arm that answers, and that fails the test when it is asked to do anything."""

    def __init__(self, volts: float, fault: SorterError | None) -> None:
        self.inventory = {number: object() for number in range(1, 8)}
        self.changed = ("servo 3: Return_Delay_Time 250 -> 0",)
        self._volts, self._fault = volts, fault
        self.open_count = 0

    def open(self) -> None:
        self.open_count += 1
        if self._fault is not None:
            raise self._fault

    def close(self) -> None:
        self.open_count -= 1

    def state(self) -> ArmState:
        return ArmState(0.0, np.zeros(5), np.zeros(5), 40.0, 0.0, voltage=self._volts, temperature=34.0)


def fake_devices(
    volts: float = 12.1, fault: SorterError | None = None, grey: int = 120, refused: tuple[str, ...] = ()
) -> Callable[[CellConfig, ArmDescription, BackendOptions], Devices]:
    def make(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> Devices:
        return Devices(GreyCamera(grey, refused), SilentArm(volts, fault), VirtualClock())  # type: ignore[arg-type]  # no motion

    return make


def opened(case: Case, **given: object) -> dict[str, Finding]:
    made = fake_devices(**given)  # type: ignore[arg-type]  # the parameters of _fake
    return {found.name: found for found in devices.opened(dataclasses.replace(plug_in(case), devices=made))}

"""Camera and servos: there, reachable, and, when nobody else has them, as the configuration wants them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from controller.backends import BackendOptions, Devices
from controller.config.cell import CellConfig
from controller.domain import ArmDescription
from controller.errors import SorterError
from controller.ports import Arm, Camera, Clock
from controller.service.doctor.case import Case
from controller.service.doctor.finding import Finding, failed, ok, warning

MAX_LATENCY_MS = 2
"""Largest latency timer of a serial adapter: at FTDI's factory 16 ms the arm's cycle of 10 ms is impossible."""
SUPPLY_V = (10.8, 13.2)
"""12 V within a tenth. Source: ROBOTIS e-manual, recommended voltage of the X series (XM430: 12.0, XL430: 11.1)."""
HOT_C = 65.0
"""Servos shut down at 72 or 80 degrees C (Temperature_Limit of XL430 and XM430)."""
_DARK, _BRIGHT = 12.0, 243.0
"""Mean grey level of a picture that shows nothing: a cap on the lens, no light, or far too much of it."""


@runtime_checkable
class _TellsSettings(Protocol):
    """A camera that knows what it really does."""

    settings_in_force: Mapping[str, float]
    refused_settings: Sequence[object]


@runtime_checkable
class _TellsServos(Protocol):
    """An arm that knows its servos."""

    inventory: Mapping[int, object]
    changed: Sequence[str]


def nodes(case: Case) -> list[Finding]:
    """The device files are there and may be used by whoever runs this."""
    assert case.cell is not None
    return [
        _node(case, "camera file", case.cell.camera.device, "plug the camera in: controller camera list"),
        _node(case, "servo port", case.cell.arm.port, "plug the servo adapter in: ls /dev/serial/by-id"),
    ]


def _node(case: Case, name: str, device: str, remedy: str) -> Finding:
    path = case.path(device)
    try:
        found = path.stat()
    except OSError:
        if device.startswith("/dev/sorter-"):
            remedy += "; its name is given by the rules of: sudo controller service install"
        return failed(name, f"{device} is not there", remedy)
    if not os.access(path, os.R_OK | os.W_OK):
        group = _group(found.st_gid)
        remedy = f"sudo usermod -aG {group} {_user()}, then log in again"
        return failed(name, f"{device} may not be used: it belongs to the group {group}", remedy)
    target = path.resolve().name
    return ok(name, device if target == path.name else f"{device} is {target}")


def latency(case: Case) -> Finding | None:
    """The adapter's latency timer is short; None when the port is not there."""
    assert case.cell is not None
    port = case.path(case.cell.arm.port)
    if not port.exists():
        return None
    name = port.resolve().name
    text = case.text(f"/sys/bus/usb-serial/devices/{name}/latency_timer")
    if text is None or not text.isdecimal():
        return ok("latency timer", f"{name} has none")
    if int(text) > MAX_LATENCY_MS:
        return warning(
            "latency timer",
            f"{name} waits {text} ms; the program asks for 1 ms, which not every system lets it",
            "a rule sets it for good: sudo controller service install, then plug the adapter in again",
        )
    return ok("latency timer", f"{name} waits {text} ms")


def opened(case: Case) -> list[Finding]:
    """Camera and servos themselves, when nobody is at work with them. No torque, no motion."""
    assert case.cell is not None
    assert case.arm is not None
    with case.hold() as holder:
        if holder is not None:
            return []
        made = case.devices(case.cell, case.arm, BackendOptions(out=case.state))
        found = []
        for name, device, look in (
            ("camera", case.cell.camera.device, _camera),
            ("servos", case.cell.arm.port, _servos),
        ):
            path = case.path(device)
            if case.simulated or (path.exists() and os.access(path, os.R_OK | os.W_OK)):
                try:
                    found += look(made, case.cell, case.arm)
                except SorterError as error:
                    found.append(failed(name, error.cause, error.remedy))
        return found


def _camera(devices: Devices, cell: CellConfig, arm: ArmDescription) -> list[Finding]:
    camera: Camera = devices.camera
    clock: Clock = devices.clock
    with contextlib.closing(camera):
        camera.open()
        frame = camera.capture(clock.now(), cell.camera.frame_timeout_s)
        findings = [_picture(frame.size, float(frame.image.mean()))]
        if isinstance(camera, _TellsSettings):
            findings.append(_settings(camera))
        return findings


def _picture(size: tuple[int, int], mean: float) -> Finding:
    text = f"{size[0]}x{size[1]} px, mean grey {mean:.0f}"
    if not _DARK <= mean <= _BRIGHT:
        what = "almost black" if mean < _DARK else "almost white"
        return warning("camera", f"{text}: {what}", "check the light, the lens cap and camera.settings.exposure")
    return ok("camera", text)


def _settings(camera: _TellsSettings) -> Finding:
    if camera.refused_settings:
        refused = "; ".join(str(setting) for setting in camera.refused_settings)
        return warning("camera settings", f"not in force: {refused}", "correct [camera.settings] of the configuration")
    shown = ", ".join(f"{name} {value:g}" for name, value in camera.settings_in_force.items())
    return ok("camera settings", shown or "the camera has none")


def _servos(devices: Devices, cell: CellConfig, description: ArmDescription) -> list[Finding]:
    arm: Arm = devices.arm
    with contextlib.closing(arm):
        arm.open()
        state = arm.state()
        text = f"{description.title}: all answer"
        if isinstance(arm, _TellsServos):
            text = f"{description.title}: {len(arm.inventory)} servos answer"
            if arm.changed:
                were = "setting was" if len(arm.changed) == 1 else "settings were"
                text += f", {len(arm.changed)} {were} corrected: {'; '.join(arm.changed)}"
        return [ok("servos", text), *_health(state.voltage, state.temperature)]


def _health(voltage: float | None, temperature: float | None) -> list[Finding]:
    found = []
    if voltage is not None:
        text = f"{voltage:.1f} V at the servo that sees least"
        low, high = SUPPLY_V
        if low <= voltage <= high:
            found.append(ok("servo supply", text))
        else:
            remedy = f"use a supply of 12 V ({low:g} to {high:g}) that does not give way under load"
            found.append(warning("servo supply", text, remedy))
    if temperature is not None:
        text = f"{temperature:.0f} degrees C at the warmest servo"
        if temperature < HOT_C:
            found.append(ok("servo temperature", text))
        else:
            found.append(warning("servo temperature", text, "let the arm rest for 20 minutes"))
    return found


def _group(gid: int) -> str:
    try:
        import grp

        return grp.getgrgid(gid).gr_name
    except (ImportError, KeyError):
        return str(gid)


def _user() -> str:
    try:
        import pwd

        return pwd.getpwuid(os.geteuid()).pw_name
    except (ImportError, KeyError):
        return "$USER"


"""The identified dynamics of an arm as a calibration file of its own, beside lens, table and arm."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from controller.calibration import files
from controller.domain import ArmDescription, ServoDynamics
from controller.errors import CalibrationStale, InputError
from controller.motion.identification import Identification, identified

IDENTIFICATION = "identification.json"


def to_json(arm: ArmDescription, found: Identification) -> dict[str, Any]:
    """What is written down: Nm/rad, Nm s/rad, Nm, kg m^2, rad."""
    content: dict[str, Any] = {
        "arm": found.arm,
        "joints": {name: asdict(joint) for name, joint in zip(arm.joint_names, found.joints, strict=True)},
        "link_scale": list(found.link_scale),
        "rms_before_rad": dict(zip(arm.joint_names, map(float, found.before), strict=True)),
        "rms_after_rad": dict(zip(arm.joint_names, map(float, found.after), strict=True)),
        "samples": found.samples,
    }
    return content | {"calibration_id": files.identity("identification", content)}


def save_identified(folder: Path, arm: ArmDescription, found: Identification) -> None:
    """Write `identification.json`; what it replaces is kept as `.previous`.

    Raises:
        InputError: The folder cannot be written.
    """
    files.write(folder / IDENTIFICATION, to_json(arm, found))


def load_identified(folder: Path, arm: ArmDescription) -> ArmDescription:
    """The arm with the figures a calibration folder holds for it; unchanged when it holds none.

    Raises:
        CalibrationStale: They belong to another arm, or were edited.
        InputError: The file makes no sense.
    """
    path = folder / IDENTIFICATION
    if not path.exists():
        return arm
    content = files.read(path, "identification")
    if content.get("arm") != arm.name:
        raise CalibrationStale(f"{path}: of the arm {content.get('arm')}, this is {arm.name}", "identify this arm")
    try:
        joints = tuple(
            ServoDynamics(**{key: _positive(value) for key, value in content["joints"][name].items()})
            for name in arm.joint_names
        )
        scale = tuple(_positive(value) for value in content["link_scale"])
        if len(scale) != len(arm.links):
            raise ValueError("link_scale")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: not an identification ({error})", "run controller identify again") from error
    return identified(arm, joints, scale)


def _positive(value: object) -> float:
    if not isinstance(value, (int, float)) or not 0.0 < value < 1e4:
        raise ValueError(f"{value!r} is out of range")
    return float(value)

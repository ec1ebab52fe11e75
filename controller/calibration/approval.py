"""Whether a stored calibration may move an arm by itself: certified, for these devices, not too long ago.

A touch test is the only figure that vouches for lens, table and arm together. Without one that passed, that speaks
of exactly these files and of these devices, automatic operation is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from controller.calibration import files
from controller.calibration.certificate import PASSED
from controller.calibration.store import CERTIFICATE, StoredCalibration
from controller.errors import CalibrationMissing, CalibrationPoorFit, CalibrationStale, InputError

#: Days after which a touch test is due: mounts settle, screws work loose.
DUE = 90.0
#: Days after which the cell is not trusted without one.
STALE = 180.0
#: The lens alone may add this much, mm at the 95th percentile over the picture: a touch test, seen through the same
#: lens, would not notice. Source: the limit of the simulated study that 20 good views keep ten times over.
LENS_LIMIT = 0.5
_PROVE = "prove it: controller calibrate check"


@dataclass(frozen=True, slots=True)
class Approval:
    """A certificate that speaks of a calibration.

    Attributes:
        verdict: `passed` or `failed`.
        made_at: When; None when the file does not say.
        mean, p95: What a touch missed by, mm.
        devices: Serial numbers of the devices it was made with.
    """

    verdict: str
    made_at: datetime | None
    mean: float
    p95: float
    devices: Mapping[str, str]

    def age(self, now: datetime) -> float | None:
        """Days since; None when it is not known."""
        return None if self.made_at is None else (now - self.made_at).total_seconds() / 86400.0


def certificate_of(folder: Path, stored: StoredCalibration) -> Approval:
    """The certificate in a calibration's folder.

    Raises:
        CalibrationMissing: There is none, or the arm was never calibrated.
        CalibrationStale: It speaks of other files than those beside it, or was edited.
        InputError: It makes no sense.
    """
    if stored.arm is None or not stored.arm.points:
        raise CalibrationMissing("the arm was placed by ruler only", "run controller calibrate arm")
    path = folder / CERTIFICATE
    try:
        content = files.read(path, "check", named=False)
    except CalibrationMissing as error:
        raise CalibrationMissing("the calibration was never proved: it has no certificate", _PROVE) from error
    body = {key: value for key, value in content.items() if key != "certificate_id"}
    if content.get("certificate_id") != files.identity("certificate", body):
        raise CalibrationStale(f"{path}: its content does not belong to its id: it was edited", _PROVE)
    held = {
        "calibration_id": stored.arm.calibration_id,
        "camera_id": stored.camera.calibration_id,
        "table_id": stored.table.calibration_id,
    }
    for key, name in held.items():
        if content.get(key) != name:
            raise CalibrationStale(f"{path}: it certifies {content.get(key)}, the folder holds {name}", _PROVE)
    touch = content.get("touch_mm")
    if not isinstance(touch, dict):
        raise InputError(f"{path}: touch_mm is not an object", _PROVE)
    mean, p95 = (files.number(touch, key, where=f"{path}: touch_mm") for key in ("mean", "p95"))
    noted = {key: str(value) for key, value in content.items() if key in ("camera", "port")}
    return Approval(str(content.get("verdict")), _date(content), mean, p95, noted)


def approve(folder: Path, stored: StoredCalibration, *, arm: str, devices: Mapping[str, str], now: datetime) -> None:
    """Refuse a calibration that may not move an arm by itself.

    Args:
        folder: Of the calibration.
        stored: What it holds.
        arm: Name of the arm in use.
        devices: Serial numbers of the devices in use.
        now: Of the wall clock, with its zone.

    Raises:
        CalibrationMissing: Nothing certifies it.
        CalibrationStale: Calibration or certificate belong to other devices, to other files or to another time.
        CalibrationPoorFit: The touch test failed, or the lens is too poorly known for it to mean anything.
    """
    stored.check(arm=arm, devices=devices)
    found = certificate_of(folder, stored)
    if found.verdict != PASSED:
        raise CalibrationPoorFit(
            f"the calibration failed its touch test: {found.mean:.2f} mm in the mean, {found.p95:.2f} mm at the 95th "
            "percentile",
            "calibrate again: controller calibrate arm, then controller calibrate check",
        )
    for key, value in devices.items():
        if found.devices.get(key, value) != value:
            raise CalibrationStale(
                f"the certificate was made with {key} {found.devices[key]}, this cell has {value}", _PROVE
            )
    age = found.age(now)
    if age is None or age > STALE:
        when = "at an unknown time" if age is None else f"{age:.0f} days ago"
        raise CalibrationStale(f"the calibration was last proved {when} (limit {STALE:.0f} days)", _PROVE)
    lens = stored.camera
    if lens.distance_mm > 0.0:
        at_table = lens.uncertainty_mm * float(stored.table.T_table_camera[2, 3]) / lens.distance_mm
        if at_table > LENS_LIMIT:
            raise CalibrationPoorFit(
                f"the lens is known to {at_table:.2f} mm over the table only (limit {LENS_LIMIT:g} mm)",
                "calibrate the camera with more views, tilted and into every corner of the picture",
            )


def _date(content: Mapping[str, Any]) -> datetime | None:
    try:
        made = datetime.fromisoformat(str(content.get("made_at")))
    except ValueError:
        return None
    return made if made.tzinfo is not None else made.replace(tzinfo=UTC)

"""A folder that holds one cell's calibration: the lens, the table, the arm, each in a file of its own.

The files name each other by id, so that a lens calibrated again, or a file copied from another cell, is
noticed before anything moves. Each write keeps the file it replaces as `.previous`.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from controller.calibration import files
from controller.calibration.arm import ArmCalibration, arm_from_json, by_ruler
from controller.calibration.camera import CameraCalibration, camera_from_json
from controller.calibration.table import TableCalibration, table_from_json
from controller.domain import Array, CellCalibration
from controller.errors import CalibrationMissing, CalibrationStale, InputError

CAMERA, TABLE, ARM = "camera.json", "table.json", "arm.json"
#: Of the touch test, beside them.
CERTIFICATE = "certificate.json"
NAMES = (CAMERA, TABLE, ARM)


@dataclass(frozen=True, slots=True, eq=False)
class StoredCalibration:
    """What a calibration folder holds.

    Attributes:
        camera: The lens.
        table: The camera's pose over the table.
        arm: The arm's pose and joint offsets, or None when it was not calibrated.
        provenance: Per file what was noted when it was written (date, device, serial numbers, software).
    """

    camera: CameraCalibration
    table: TableCalibration
    arm: ArmCalibration | None
    provenance: Mapping[str, Mapping[str, str]]

    def cell(self) -> CellCalibration:
        """Everything as the cell uses it; the id covers all three.

        Raises:
            CalibrationMissing: The arm was not calibrated.
        """
        if self.arm is None:
            raise CalibrationMissing("the arm was not calibrated", "run `controller calibrate arm`")
        return cell_calibration(self.camera, self.table, self.arm)

    def check(self, *, arm: str | None = None, devices: Mapping[str, str] | None = None) -> None:
        """Refuse a calibration that belongs to other devices.

        Args:
            arm: Name of the arm in use.
            devices: Provenance entries that must agree with every file that states them.

        Raises:
            CalibrationStale: One disagrees; the cause says which.
        """
        if arm is not None and self.arm is not None and self.arm.arm not in ("", arm):
            raise CalibrationStale(f"calibrated with the arm {self.arm.arm}, this is {arm}", "calibrate the arm again")
        for name, noted in self.provenance.items():
            for key, value in (devices or {}).items():
                if key in noted and noted[key] != value:
                    raise CalibrationStale(
                        f"{name}: made with {key} {noted[key]}, this cell has {value}",
                        "name this cell's own folder, or calibrate again",
                    )


def cell_calibration(camera: CameraCalibration, table: TableCalibration, arm: ArmCalibration) -> CellCalibration:
    """The cell's calibration from its three parts."""
    name = files.identity("cell", {"parts": [camera.calibration_id, table.calibration_id, arm.calibration_id]})
    return CellCalibration(
        calibration_id=name,
        camera=camera.camera,
        T_table_camera=table.T_table_camera,
        T_base_table=arm.T_base_table,
        joint_offsets=dict(arm.joint_offsets),
        # The stated figure is a 95th percentile of a distance in two dimensions: 2.45 standard deviations.
        sigma=camera.uncertainty_mm / 2.45,
        error_map=arm.error_map.map if arm.error_map is not None else None,
        jaws=arm.jaws,
    )


def save(
    folder: Path,
    *,
    camera: CameraCalibration | None = None,
    table: TableCalibration | None = None,
    arm: ArmCalibration | None = None,
    provenance: Mapping[str, str] | None = None,
) -> None:
    """Write the given parts, each whole or not at all; what they replace is kept as `.previous`.

    Args:
        folder: Made when it is not there.
        camera: The lens, when it is to be written.
        table: The table, when it is to be written.
        arm: The arm, when it is to be written.
        provenance: Noted in each file written, e.g. `made_at`, `camera`, `arm`, `software`.

    Raises:
        InputError: The folder cannot be written.
    """
    extra = {"provenance": dict(provenance)} if provenance else {}
    if camera is not None:
        files.write(folder / CAMERA, camera.to_json() | extra)
    if table is not None:
        files.write(folder / TABLE, table.own_json() | extra)
    if arm is not None:
        files.write(folder / ARM, arm.to_json() | extra)


def save_calibration(
    folder: Path,
    camera: CameraCalibration,
    table: TableCalibration,
    T_base_table: Array,
    *,
    arm: str = "",
    provenance: Mapping[str, str] | None = None,
) -> None:
    """Write a calibration whose arm was only placed by ruler: no joint offsets, and no points to vouch for it.

    Args:
        folder: Made when it is not there.
        camera: The lens.
        table: The table.
        T_base_table: ndarray of shape (4, 4), maps `table` into `base`, as measured by ruler.
        arm: Name of the arm's description.
        provenance: See `save`.
    """
    placed = by_ruler(T_base_table, camera.calibration_id, table.calibration_id, arm)
    save(folder, camera=camera, table=table, arm=placed, provenance=provenance)


def load(folder: Path) -> StoredCalibration:
    """Everything a calibration folder holds, checked for belonging together.

    Raises:
        CalibrationMissing: No folder, no lens or no table in it.
        CalibrationStale: A part was made with another lens or table, or was edited.
        InputError: A file makes no sense.
    """
    if not folder.is_dir():
        raise CalibrationMissing(f"{folder}: no such calibration folder", "make one with `controller calibrate`")
    contents = {
        name: files.read(folder / name, name.removesuffix(".json"))
        for name in NAMES
        if name != ARM or (folder / name).exists()
    }
    camera = camera_from_json(contents[CAMERA], str(folder / CAMERA))
    table = table_from_json(contents[TABLE], str(folder / TABLE))
    arm = arm_from_json(contents[ARM], str(folder / ARM)) if ARM in contents else None
    _belongs(folder / TABLE, "camera", table.camera_id, camera.calibration_id)
    if arm is not None:
        _belongs(folder / ARM, "camera", arm.camera_id, camera.calibration_id)
        _belongs(folder / ARM, "table", arm.table_id, table.calibration_id)
    noted = {name: _provenance(content, folder / name) for name, content in contents.items()}
    return StoredCalibration(camera, table, arm, noted)


def load_calibration(folder: Path) -> CellCalibration:
    """The cell's calibration in a folder.

    Raises:
        CalibrationMissing, CalibrationStale, InputError: See `load`.
    """
    return load(folder).cell()


def restore_previous(folder: Path) -> tuple[str, ...]:
    """Swap the files that were replaced last with what they replaced; names of those swapped.

    As few files are swapped as make a whole that belongs together: the arm's, the table's as well, all three. The
    certificate goes with the arm it speaks of. Doing it twice changes nothing.

    Raises:
        CalibrationMissing: There is nothing to go back to.
        CalibrationStale: What is kept does not belong together.
        InputError: The folder cannot be written.
    """
    kept = {name for name in NAMES if (folder / _previous(name)).exists()}
    for names in ((ARM,), (TABLE, ARM), NAMES, (TABLE,), (CAMERA, TABLE), (CAMERA,)):
        if kept.issuperset(names) and _whole(folder, names):
            break
    else:
        if kept:
            raise CalibrationStale(f"{folder}: the earlier files kept there do not belong together", "calibrate again")
        raise CalibrationMissing(f"{folder}: no earlier calibration is kept there", "calibrate again")
    swapped = list(names)
    if ARM in names and (folder / _previous(CERTIFICATE)).exists():
        speaks_of = files.read(folder / _previous(CERTIFICATE), "check", named=False).get("calibration_id")
        if speaks_of == files.read(folder / _previous(ARM), "arm").get("calibration_id"):
            swapped.append(CERTIFICATE)
    for name in swapped:
        _swap(folder, name)
    return tuple(swapped)


def _previous(name: str) -> str:
    return f"{name}.previous"


def _whole(folder: Path, swapped: Collection[str]) -> bool:
    """Whether the folder would hold one calibration after these files were swapped."""
    found: dict[str, Mapping[str, object]] = {}
    for name in NAMES:
        path = folder / (_previous(name) if name in swapped else name)
        if path.exists():
            found[name] = files.read(path, name.removesuffix(".json"))
    if CAMERA not in found or TABLE not in found:
        return False
    camera, table = (found[name].get("calibration_id") for name in (CAMERA, TABLE))
    arm = found.get(ARM, {"camera_id": camera, "table_id": table})
    return found[TABLE].get("camera_id") == camera and arm.get("camera_id") == camera and arm.get("table_id") == table


def _swap(folder: Path, name: str) -> None:
    path, previous, aside = folder / name, folder / _previous(name), folder / f".{name}.swap"
    try:
        aside.unlink(missing_ok=True)
        if path.exists():
            os.link(path, aside)
        previous.replace(path)
        if aside.exists():
            aside.replace(previous)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})", "check the folder's rights") from error


def _belongs(path: Path, what: str, stated: str, present: str) -> None:
    if stated and stated != present:
        raise CalibrationStale(
            f"{path}: made with the {what} calibration {stated}, the folder holds {present}",
            f"put back the {what}.json it was made with, or run `controller calibrate {path.stem}` again",
        )


def _provenance(content: Mapping[str, object], path: Path) -> Mapping[str, str]:
    noted = content.get("provenance", {})
    if not isinstance(noted, dict) or not all(isinstance(value, str) for value in noted.values()):
        raise InputError(f"{path}: provenance is not an object of texts", "make the file again")
    return {str(key): str(value) for key, value in noted.items()}

"""JSON files that hold a calibration: read with suspicion, written whole or not at all."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.errors import CalibrationMissing, CalibrationStale, InputError
from controller.geometry import rigidity_error

Array = NDArray[np.float64]

_LARGEST = 4_000_000


def identity(kind: str, content: Mapping[str, Any]) -> str:
    """Name of a calibration: its kind and the first 12 hexadecimal digits of the SHA-256 of what was measured.

    Notes on its making (`provenance`) are left out: the same measurement keeps its name wherever it is kept.
    """
    body = {key: value for key, value in content.items() if key not in ("calibration_id", "provenance")}
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def write(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON beside `path` and move it there; what stood there is kept as `<path>.previous`.

    Raises:
        InputError: The folder cannot be written.
    """
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    fresh = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with fresh.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            keep = path.with_name(f"{path.name}.previous")
            keep.unlink(missing_ok=True)
            os.link(path, keep)
        fresh.replace(path)
    except OSError as error:
        fresh.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written ({error.strerror})", "choose a folder you may write to") from error


def read(path: Path, kind: str, *, named: bool = True) -> dict[str, Any]:
    """The JSON object in a calibration file; its `calibration_id`, when present, must match its content.

    Where not `named`, the id is another file's, and is left to the caller.

    Raises:
        CalibrationMissing: There is no such file.
        InputError: It cannot be read or is no JSON object.
        CalibrationStale: Its content was changed after it was written.
    """
    remedy = f"make a new one with `controller calibrate {kind}`"
    try:
        if path.stat().st_size > _LARGEST:
            raise InputError(f"{path}: too large for a calibration", remedy)
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except FileNotFoundError:
        raise CalibrationMissing(f"{path}: no such file", remedy) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})", remedy) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error})", remedy) from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: not a JSON object", remedy)
    stated = content.get("calibration_id")
    if named and stated is not None and stated != identity(kind, content):
        raise CalibrationStale(f"{path}: its content does not belong to its id {stated!r}: it was edited", remedy)
    return content


def numbers(content: Mapping[str, Any], key: str, *shapes: tuple[int, ...], where: str) -> Array:
    """The finite numbers under `key` as an array of one of the allowed shapes.

    Raises:
        InputError: They are missing, not numbers, or of another shape.
    """
    value = content.get(key)
    try:
        array = np.array(value, dtype=np.float64)
        fits = (not shapes or array.shape in shapes) and bool(np.isfinite(array).all())
    except (TypeError, ValueError):
        fits = False
    if not fits or _holds_text(value):
        allowed = " or ".join(str(list(shape)) for shape in shapes)
        raise InputError(f"{where}: {key} is not finite numbers of shape {allowed}", "make the file again")
    return array


def number(content: Mapping[str, Any], key: str, *, where: str, default: float | None = None) -> float:
    """One finite number; `default` when the key is absent and a default is given."""
    if default is not None and key not in content:
        return default
    return float(numbers(content, key, (), where=where))


def rigid(content: Mapping[str, Any], key: str, *, where: str) -> Array:
    """A rigid pose of shape (4, 4)."""
    value = numbers(content, key, (4, 4), where=where)
    if rigidity_error(value) > 1e-6 or not np.array_equal(value[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{where}: {key} is not a rigid pose", "make the file again")
    return value


def plain(value: Any, digits: int = 10) -> Any:
    """Arrays and numpy numbers as JSON values, numbers rounded to `digits` significant digits."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist(), digits)
    if isinstance(value, Mapping):
        return {str(key): plain(item, digits) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, digits) for item in value]
    if isinstance(value, (float, np.floating)):
        number_ = float(value)
        if not math.isfinite(number_) or number_ == 0.0:
            return number_
        return float(f"{number_:.{digits}g}")
    if isinstance(value, np.integer):
        return int(value)
    return value


def _holds_text(value: Any) -> bool:
    if isinstance(value, list):
        return any(_holds_text(item) for item in value)
    return isinstance(value, (str, bool)) or value is None


def _refuse(name: str) -> None:
    raise ValueError(f"{name} is not a number")

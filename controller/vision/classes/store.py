"""Taught classes on disk: JSON for what people read, NPZ for the figures, tied together by a hash; no pickle.

A class is replaced in one step: the figures go into a file named by their own hash, then the JSON that names it is
put in place. Whatever fails before leaves the class as it was.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from controller.config.loader import StrictModel
from controller.errors import InputError
from controller.vision.classes.features import LENGTH, OPEN_BLOCKS, VERSION, block
from controller.vision.classes.markings import SIDE

Floats32 = NDArray[np.float32]

MOST_VIEWS = 300
_MOST_BYTES = 4_000_000
_NAME = re.compile(r"[^\W_][\w .+-]{0,39}")


class _Record(StrictModel):
    """The JSON beside a class's figures."""

    schema_version: int = 1
    name: str
    features: int
    units: str = Field(pattern="^(px|mm)$")
    height_mm: float | None = Field(None, gt=0.0, le=500.0)
    views: int = Field(ge=1, le=MOST_VIEWS)
    pictures: tuple[str, ...]
    data: str
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


@dataclass(frozen=True, slots=True, eq=False)
class TaughtClass:
    """One class as it was taught.

    Attributes:
        name: As the sorting rules call it.
        units: `mm` or `px`: what sizes are measured in.
        views: ndarray of shape (n, LENGTH), dtype float32.
        pictures: Where each view came from.
        prints: ndarray of shape (n, markings.SIDE, markings.SIDE), dtype uint8: what is on each view's top.
        height_mm: Height of the parts, where the class says it; else the configuration does by their shape.
    """

    name: str
    units: str
    views: Floats32
    pictures: tuple[str, ...]
    prints: NDArray[np.uint8]
    height_mm: float | None = None

    @property
    def digest(self) -> str:
        """sha256 of the figures."""
        return hashlib.sha256(self.views.astype("<f4").tobytes() + self.prints.tobytes()).hexdigest()


def checked_name(name: str) -> str:
    """The name, when a class may be called so.

    Raises:
        InputError: It is empty, too long, or holds signs that file names and rules had better not have.
    """
    if not _NAME.fullmatch(name):
        raise InputError(
            f"{name!r} is no name for a class", "use up to 40 letters, digits, spaces, . + - _, a letter or digit first"
        )
    return name


def save_class(folder: Path, taught: TaughtClass) -> Path:
    """Put a class into a folder, in place of one of the same name; returns its JSON file.

    Raises:
        InputError: The name will not do, or the folder cannot be written.
    """
    stem = _stem(taught.name)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, views=taught.views.astype("<f4"), prints=taught.prints)
    data = buffer.getvalue()
    sha256 = hashlib.sha256(data).hexdigest()
    record = _Record(
        name=taught.name,
        features=VERSION,
        units=taught.units,
        height_mm=taught.height_mm,
        views=len(taught.views),
        pictures=taught.pictures,
        data=f"{stem}.{sha256[:12]}.npz",
        sha256=sha256,
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / record.data, data)
        _write(folder / f"{stem}.json", (record.model_dump_json(indent=1) + "\n").encode())
        for old in folder.glob(f"{stem}.????????????.npz"):
            if old.name != record.data:
                old.unlink()
    except OSError as error:
        raise InputError(f"{folder} cannot be written ({error.strerror})", "name another with --classes") from error
    return folder / f"{stem}.json"


def load_class(path: Path) -> TaughtClass:
    """The class whose JSON file this is.

    Raises:
        InputError: A file is missing, damaged, too large, changed since, or of another version.
    """
    again = "teach the class again, or remove it with controller classes remove"
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{path} is larger than {_MOST_BYTES} bytes", again)
        record = _Record.model_validate_json(path.read_bytes())
        file = path.parent / Path(record.data).name
        if file.stat().st_size > _MOST_BYTES:
            raise InputError(f"{file} is larger than {_MOST_BYTES} bytes", again)
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"{error.filename or path} cannot be read ({error.strerror})", again) from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"]) or "file"
        raise InputError(f"{path}: {key}: {first['msg']}", again) from error
    if hashlib.sha256(data).hexdigest() != record.sha256:
        raise InputError(f"{file} is not what was taught: its checksum differs", again)
    if record.features != VERSION:
        raise InputError(f"{path} was taught with version {record.features} of the features, this is {VERSION}", again)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            views, prints = np.asarray(arrays["views"], np.float32), np.asarray(arrays["prints"])
    except Exception as error:  # numpy lets through whatever its readers of archives and headers stumble over
        raise InputError(f"{file} is damaged ({error})", again) from error
    if views.shape != (record.views, LENGTH) or not _sound(views):
        raise InputError(f"{file} holds {views.shape} figures, not ({record.views}, {LENGTH}) finite ones", again)
    if prints.shape != (record.views, SIDE, SIDE) or prints.dtype != np.uint8:
        raise InputError(f"{file} holds pictures {prints.shape}, not ({record.views}, {SIDE}, {SIDE})", again)
    return TaughtClass(record.name, record.units, views, record.pictures, prints, record.height_mm)


def _sound(views: Floats32) -> bool:
    """Whether views (n, LENGTH) are numbers, but for whole blocks that a drawing leaves open."""
    said = np.ones(LENGTH, bool)
    for name in OPEN_BLOCKS:
        said[block(name)] = not np.isnan(views[:, block(name)]).all()
    return bool(np.isfinite(views[:, said]).all())


def load_classes(folder: Path) -> tuple[TaughtClass, ...]:
    """All classes of a folder by name; none when there is no such folder.

    Raises:
        InputError: See `load_class`.
    """
    if not folder.is_dir():
        return ()
    return tuple(sorted((load_class(path) for path in folder.glob("*.json")), key=lambda item: item.name))


def remove_class(folder: Path, name: str) -> None:
    """Forget a class.

    Raises:
        InputError: There is none of this name.
    """
    stem = _stem(name)
    path = folder / f"{stem}.json"
    if not path.is_file():
        known = ", ".join(item.name for item in load_classes(folder)) or "none"
        raise InputError(f"no class {name!r} in {folder}", f"known: {known}")
    path.unlink()
    for data in folder.glob(f"{stem}.????????????.npz"):
        data.unlink()


def digest_of(classes: tuple[TaughtClass, ...]) -> str:
    """Hash of a set of classes, for the ledger."""
    said = json.dumps([[item.name, item.units, item.height_mm, item.digest] for item in classes])
    return hashlib.sha256(said.encode()).hexdigest()[:16]


def _stem(name: str) -> str:
    return quote(checked_name(name), safe="").replace("%20", "_").replace(".", "%2E")


def _write(path: Path, data: bytes) -> None:
    """Put bytes into a file in one step, safe against a loss of power."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)

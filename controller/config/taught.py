"""Bins taught by jogging to them: kept in a file of their own, so that the configuration is never rewritten."""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from controller.config.cell import CellConfig, check_apart
from controller.config.loader import StrictModel, load_toml
from controller.errors import ConfigError

TAUGHT_BINS = "bins.toml"
_HEAD = "# Bins taught with `controller jog` and `controller bins set`: they stand here instead of where the\n"
_HEAD += "# configuration has them. Delete an entry, or this file, to go back.\n"


class TaughtBin(StrictModel):
    """Where a bin of the configuration really stands."""

    name: str = Field(min_length=1, max_length=40)
    center_mm: tuple[float, float]
    """Middle of the bin in `table`."""


class TaughtBins(StrictModel):
    """The file `bins.toml`."""

    bins: tuple[TaughtBin, ...] = ()


def load_taught(path: Path) -> dict[str, tuple[float, float]]:
    """Centres (mm, `table`) by name; empty when there is no such file.

    Raises:
        ConfigError: The file makes no sense.
    """
    if not path.exists():
        return {}
    return {taught.name: taught.center_mm for taught in load_toml(path, TaughtBins).bins}


def with_taught(config: CellConfig, path: Path) -> CellConfig:
    """The configuration with its bins where they were taught to stand.

    Raises:
        ConfigError: The file makes no sense, names a bin that the configuration does not have, or puts one into
            another.
    """
    taught = load_taught(path)
    known = [bin_.name for bin_ in config.bins]
    for name in taught:
        if name not in known:
            raise ConfigError(f"{path}: there is no bin {name!r}", f"{_closest(name, known)}delete the entry")
    if not taught:
        return config
    return _with_bins(config, taught)


def moved(config: CellConfig, name: str, center: tuple[float, float]) -> CellConfig:
    """The configuration with one bin somewhere else (mm, `table`).

    Raises:
        ConfigError: There is no bin of this name, or another stands there.
    """
    known = [bin_.name for bin_ in config.bins]
    if name not in known:
        raise ConfigError(f"there is no bin {name!r}", f"{_closest(name, known)}bins: {', '.join(known)}")
    return _with_bins(config, {name: center})


def _with_bins(config: CellConfig, centers: Mapping[str, tuple[float, float]]) -> CellConfig:
    """The configuration with bins at other centres (mm, `table`).

    Raises:
        ConfigError: Two of them would stand in one another.
    """
    bins = tuple(
        bin_.model_copy(update={"center_mm": centers[bin_.name]}) if bin_.name in centers else bin_
        for bin_ in config.bins
    )
    check_apart(bins)
    return config.model_copy(update={"bins": bins})


def save_taught(path: Path, name: str, center: tuple[float, float]) -> None:
    """Write down where a bin stands; whole or not at all.

    Raises:
        ConfigError: The file there makes no sense, or the folder cannot be written.
    """
    taught = load_taught(path) | {name: center}
    entries = [
        # A JSON string is a TOML basic string.
        f"\n[[bins]]\nname = {json.dumps(known)}\ncenter_mm = [{x:.2f}, {y:.2f}]\n"
        for known, (x, y) in sorted(taught.items())
    ]
    beside = path.with_name(path.name + ".new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("w", encoding="utf-8") as file:
            file.write(_HEAD + "".join(entries))
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}", "name a folder that can be written") from error


def _closest(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"did you mean {close[0]}? " if close else ""

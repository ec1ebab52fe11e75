"""Where the files that ship with the program are, from a source tree and from an installed wheel alike."""

from __future__ import annotations

from pathlib import Path

from controller.errors import ConfigError

_HERE = Path(__file__).resolve()
_IN_WHEEL = _HERE.parents[1] / "configs"
_IN_SOURCE = _HERE.parents[2] / "configs"


def shipped(relative: str = "") -> Path:
    """Path of a file or folder below `configs/`, e.g. `recipes/precise.toml`.

    Raises:
        ConfigError: The installation has no such file.
    """
    root = _IN_WHEEL if _IN_WHEEL.is_dir() else _IN_SOURCE
    path = root / relative
    if not path.exists():
        raise ConfigError(f"{path} is missing from this installation", "install the program again")
    return path


def named_or_path(name_or_path: str, folder: str) -> Path:
    """`configs/<folder>/<name>.toml` for the name of a shipped file, else the path as given.

    Raises:
        ConfigError: Neither exists; the shipped names are listed.
    """
    names = sorted(path.stem for path in shipped(folder).glob("*.toml"))
    if name_or_path in names:
        return shipped(f"{folder}/{name_or_path}.toml")
    path = Path(name_or_path)
    if path.is_file():
        return path
    raise ConfigError(f"{name_or_path}: no such file and not one of the shipped {folder}", "use " + ", ".join(names))

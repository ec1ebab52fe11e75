"""Where a run keeps what must outlive it."""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path

from controller.errors import LedgerError, SorterError
from controller.service.lock import InstanceLock
from controller.service.unit import STATE


class FolderTaken(SorterError):
    """The folder named for a run's results already holds something."""

    exit_code = 2


def state_folder() -> Path:
    """Folder of a real cell's ledger, lock and calibration: `$STATE_DIRECTORY`, else the XDG state folder."""
    given = os.environ.get("STATE_DIRECTORY")
    if given:
        return Path(given.split(os.pathsep)[0])
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "sorting-controller"


def folder_of_the_cell() -> Path:
    """Where daily commands look: the service's folder where a service is installed, else one's own."""
    return STATE if "STATE_DIRECTORY" not in os.environ and STATE.is_dir() else state_folder()


def not_permitted(error: PermissionError) -> SorterError:
    """What to tell whoever may not read or write a file, as a stranger to the service's folders may not."""
    remedy = "ask as root, or join its group and log in again; the service's: sudo usermod -aG sorter $USER"
    return SorterError(f"{error.filename or 'a file'}: {error.strerror or error}", remedy)


def new_run_folder(wanted: Path | None, now: datetime) -> Path:
    """An empty folder for one run: the one asked for, or a fresh one below `runs/`.

    Raises:
        FolderTaken: It is not empty.
        InstanceBusy: A run is using it right now.
        LedgerError: It cannot be made: read-only, no room, no permission.
    """
    if wanted is None:
        stem = Path("runs") / now.strftime("%Y%m%d-%H%M%S")
        wanted, count = stem, 1
        while wanted.exists():
            count += 1
            wanted = stem.with_name(f"{stem.name}-{count}")
    elif wanted.exists() and (not wanted.is_dir() or any(wanted.iterdir())):
        if (wanted / "lock").is_file():
            with InstanceLock(wanted):
                pass
        raise FolderTaken(f"{wanted} exists and is not empty", "name a new folder with --out")
    try:
        wanted.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LedgerError(f"{wanted}: {error.strerror or error}", "name a folder that can be written") from error
    return wanted

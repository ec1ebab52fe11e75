"""One instance a cell: a lock file that the operating system releases when its holder dies."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from types import TracebackType
from typing import IO

from controller.errors import InstanceBusy, LedgerError

try:
    import fcntl
except ImportError:  # no advisory locks on this system: the servo port's own exclusive lock remains
    fcntl = None  # type: ignore[assignment]  # a module where it exists


class InstanceLock:
    """Exclusive hold of a folder, as a context manager.

    Args:
        folder: The folder; made when missing. The lock is its file `lock`, which names the holder's process.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "lock"
        self._file: IO[str] | None = None

    def __enter__(self) -> InstanceLock:
        """Take the lock.

        Raises:
            InstanceBusy: Another process has it; the message names it.
            LedgerError: The folder cannot be written.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            file = self._path.open("a+", encoding="utf-8")
        except OSError as error:
            raise LedgerError(f"{self._path.parent}: {error.strerror}", "name a folder that can be written") from error
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                file.seek(0)
                holder = file.read().strip() or "unknown"
                file.close()
                raise InstanceBusy(
                    f"{self._path.parent} is in use by process {holder}", "stop that one or wait for its end"
                ) from error
        try:
            file.truncate(0)
            os.write(file.fileno(), f"{os.getpid()}\n".encode())
        except OSError as error:
            file.close()
            raise LedgerError(f"{self._path}: {error.strerror}", "free some space, make the folder writable") from error
        self._file = file
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Release the lock."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.truncate(0)
            self._file.close()
            self._file = None

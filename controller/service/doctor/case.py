"""What is examined: a machine, a configuration, a folder."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from controller.backends import DEVICES, Factory, Mode
from controller.config.cell import CellConfig
from controller.domain import ArmDescription
from controller.service.unit import run_command

# Status bit of adjtimex(2): nobody keeps the clock in step.
_STA_UNSYNC = 0x0040


class _Timex(ctypes.Structure):
    """The head of the kernel's struct timex, with room for the rest. Source: adjtimex(2)."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 256),
    )


def clock_in_step() -> bool | None:
    """Whether the kernel says that its clock is kept in step with others; None where it does not tell."""
    found = _Timex()
    try:
        if ctypes.CDLL(None).adjtimex(ctypes.byref(found)) < 0:
            return None
    except (OSError, AttributeError):
        return None
    return not found.status & _STA_UNSYNC


@dataclass(frozen=True, slots=True)
class Case:
    """Everything a check may look at.

    Attributes:
        state: Folder of ledger, lock and calibration.
        config: Path of the configuration, or None when there is none to look at.
        cell: What it says, when it is in order.
        arm: The arm it names.
        root: Root of the file system: `/sys`, `/dev` and `/etc` are looked for below it.
        run: Runs a command of the system.
        clock_in_step: Whether the clock is kept in step.
        now: The date.
        devices: Makes the devices.
        simulated: They are simulated: no files, no calibration and no taught bins belong to them.
    """

    state: Path
    config: Path | None = None
    cell: CellConfig | None = None
    arm: ArmDescription | None = None
    root: Path = Path("/")
    run: Callable[[Sequence[str]], str] = run_command
    clock_in_step: Callable[[], bool | None] = clock_in_step
    now: datetime = field(default_factory=lambda: datetime.now(UTC))
    devices: Factory = DEVICES[Mode.REAL]
    simulated: bool = False

    def path(self, absolute: str | Path) -> Path:
        """An absolute path, below the root that is examined."""
        return self.root / str(absolute).lstrip("/")

    def text(self, absolute: str) -> str | None:
        """Contents of a small file below the root, stripped; None when it cannot be read."""
        try:
            return self.path(absolute).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    @contextmanager
    def hold(self) -> Iterator[str | None]:
        """Keep other instances from starting inside the block, as far as the lock is there and may be read.

        Unlike a run's own hold it makes and changes no file, which another user might then be unable to write.

        Yields:
            None; or the process that is at work, as the lock names it, and then nothing is held.
        """
        try:
            import fcntl

            file = (self.state / "lock").open(encoding="utf-8")
        except (ImportError, OSError):
            yield None
            return
        with contextlib.closing(file):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                yield file.read().strip() or "unknown"
                return
            yield None

"""The computer: room on the disk, the clock, its own supply."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from controller.service.doctor.case import Case
from controller.service.doctor.finding import Finding, failed, ok, warning

GIB = 1024**3
LEAST_FREE = 0.1 * GIB
"""Below this the ledger may soon be refused its next record, which stops the cell."""
LITTLE_FREE = 1.0 * GIB

# Where the firmware of a Raspberry Pi tells what its supply did, and the bits that matter.
# Source: Raspberry Pi documentation, `vcgencmd get_throttled`.
_THROTTLED = "/sys/devices/platform/soc/soc:firmware/get_throttled"
_UNDERVOLTAGE_NOW, _UNDERVOLTAGE_BEFORE = 1 << 0, 1 << 16


def disk(case: Case) -> Finding:
    """The state folder has room and can be written."""
    folder = _existing(case.state)
    free = shutil.disk_usage(folder).free
    text = f"{free / GIB:.1f} GiB free for {case.state}"
    if os.statvfs(folder).f_flag & os.ST_RDONLY:
        return failed("disk", f"{folder} lies on a file system that cannot be written", "mount it writable")
    if free < LEAST_FREE:
        return failed("disk", text, "make room: the cell stops when the ledger cannot be written")
    if free < LITTLE_FREE:
        return warning("disk", text, "make room soon")
    return ok("disk", text)


def clock(case: Case) -> Finding:
    """The date in the records can be trusted."""
    text = case.now.isoformat(sep=" ", timespec="seconds")
    in_step = case.clock_in_step()
    if in_step is None:
        return ok("clock", f"{text}; this system does not say whether it is kept in step")
    if not in_step:
        return warning("clock", f"{text}, not kept in step with others", "switch on NTP: timedatectl set-ntp true")
    return ok("clock", f"{text}, kept in step")


def supply(case: Case) -> Finding | None:
    """The computer's own supply, where a Raspberry Pi tells; None elsewhere."""
    text = case.text(_THROTTLED)
    if text is None:
        return None
    try:
        bits = int(text, 16)
    except ValueError:
        return None
    remedy = "use the maker's supply and a short cable; feed the servos from their own"
    if bits & _UNDERVOLTAGE_NOW:
        return failed("supply", "the computer's voltage is too low now", remedy)
    if bits & _UNDERVOLTAGE_BEFORE:
        return warning("supply", "the computer's voltage was too low at times since it was started", remedy)
    return ok("supply", "the computer's voltage was never too low since it was started")


def _existing(path: Path) -> Path:
    """The path, or the nearest folder above it that is there."""
    while not path.exists() and path != path.parent:
        path = path.parent
    return path

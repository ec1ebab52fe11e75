"""Python, libraries, SQLite, and the unit under which the service runs."""

from __future__ import annotations

import platform
import re
import sqlite3
import sys
import tempfile
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from controller.errors import SorterError
from controller.service import unit
from controller.service.doctor.case import Case
from controller.service.doctor.finding import Finding, counted, failed, ok, warning

Version = tuple[int, ...]

DISTRIBUTION = "sorting-controller"
OLDEST_PYTHON = (3, 11)
WORST_EXPOSURE = 1.5
# Two connections that write or checkpoint at the same time could corrupt a database in WAL mode. Releases of these
# branches have the correction. Source: sqlite.org/wal.html#the_wal_reset_bug.
_WAL_FIXED = ((3, 51, 3), (3, 50, 7), (3, 44, 6))
_WAL_BROKEN_SINCE = (3, 7, 0)
# All of them are the module cv2: whichever was installed last has overwritten the others' files.
_OPENCVS = (
    "opencv-python",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)


def python(case: Case, version: Version = sys.version_info[:3]) -> Finding:
    """Python is new enough, and of 64 bits."""
    text = ".".join(str(part) for part in version)
    bits = 64 if sys.maxsize > 2**32 else 32
    if version < OLDEST_PYTHON or bits != 64:
        wanted = ".".join(str(part) for part in OLDEST_PYTHON)
        return failed("python", f"{text}, {bits} bit", f"install Python {wanted} or newer on a 64-bit system")
    return ok("python", f"{text}, {bits} bit, {platform.machine()}")


def libraries(case: Case) -> Finding:
    """Every library that the program asks for is there, in a version that it can work with."""
    try:
        wanted = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return warning("libraries", "the program runs from its sources", f"install it: pip install {DISTRIBUTION}")
    present = {d.metadata["Name"].lower(): d.version for d in metadata.distributions() if d.metadata["Name"]}
    return judge_libraries([line for line in wanted if "extra ==" not in line], present)


def judge_libraries(wanted: Sequence[str], present: dict[str, str]) -> Finding:
    """Compare requirements, e.g. `numpy>=2.0`, with what is installed."""
    found, wrong = [], []
    for line in wanted:
        match = re.match(r"[A-Za-z0-9._-]+", line)
        assert match is not None
        name = match.group().lower()
        version = present.get(name)
        if version is None:
            wrong.append(f"{name} is missing")
        elif not _within(version, line[match.end() :]):
            wrong.append(f"{name} {version} is not {line[match.end() :].split(';')[0].strip()}")
        else:
            found.append(f"{name} {version}")
    remedy = f"install the program again: pip install --force-reinstall {DISTRIBUTION}"
    if wrong:
        return failed("libraries", "; ".join(wrong), remedy)
    opencvs = [name for name in _OPENCVS if name in present]
    if len(opencvs) > 1:
        return warning(
            "libraries",
            f"{' and '.join(opencvs)} overwrite each other's files",
            f"pip uninstall {' '.join(opencvs)}, then pip install opencv-python-headless",
        )
    return ok("libraries", ", ".join(found))


def _within(version: str, bounds: str) -> bool:
    for sign, bound in re.findall(r"(>=|<)\s*([0-9.]+)", bounds.split(";", maxsplit=1)[0]):
        here, there = _padded(version), _padded(bound)
        if (sign == ">=" and here < there) or (sign == "<" and here >= there):
            return False
    return True


def _padded(version: str) -> Version:
    numbers = [int(part) for part in re.findall(r"\d+", version)[:4]]
    return tuple(numbers + [0] * (4 - len(numbers)))


def sqlite(case: Case, version: Version = sqlite3.sqlite_version_info) -> Finding:
    """SQLite has the correction of the WAL-reset error."""
    text = ".".join(str(part) for part in version)
    fixed = version >= _WAL_FIXED[0] or any(
        version[:2] == release[:2] and version >= release for release in _WAL_FIXED[1:]
    )
    if version >= _WAL_BROKEN_SINCE and not fixed:
        return warning(
            "sqlite",
            f"{text} can damage a database that two programs write to at the same moment; this program never does",
            "let no other program write to ledger.db; SQLite 3.51.3, 3.50.7 or 3.44.6 has the correction",
        )
    return ok("sqlite", text)


def exposure(case: Case) -> Finding:
    """The installed unit, or the one that would be installed, is as hard as promised."""
    installed = case.path(f"/etc/systemd/system/{unit.UNIT}")
    what = "the installed unit" if installed.is_file() else "the unit that would be installed"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / unit.UNIT
        if installed.is_file():
            path.write_text(installed.read_text(encoding="utf-8"), encoding="utf-8")
        else:
            plan = unit.plan(Path("/usr/bin/env"))
            path.write_text(plan.files[0].content, encoding="utf-8")
        try:
            said = case.run(("systemd-analyze", "security", "--offline=true", "--no-pager", str(path)))
        except SorterError as error:
            return ok("unit", f"not judged: {error.cause}")
    match = re.search(r"exposure level for .*?: ([0-9.]+)", said)
    if match is None:
        return ok("unit", "not judged: systemd-analyze says nothing that is understood")
    score = float(match.group(1))
    if score > WORST_EXPOSURE:
        remedy = "install the service again: sudo controller service install"
        return warning("unit", f"{what} has an exposure of {score}, more than {WORST_EXPOSURE}", remedy)
    return ok("unit", f"{what} has an exposure of {score} of 10, the less the better")


def service(case: Case) -> Finding:
    """The service, where it is installed, is as this version would install it, and has not failed."""
    found = unit.status(root=case.root, run=case.run)
    if not found.installed:
        return ok("service", "not installed")
    state = found.properties.get("ActiveState", "unknown")
    told = found.properties.get("NRestarts", "0")
    restarts = counted(int(told) if told.isdecimal() else 0, "restart")
    if state == "failed":
        why = found.properties.get("Result", "unknown")
        return warning("service", f"it has failed: {why}, after {restarts}", "see journalctl -u controller")
    if found.differing:
        names = ", ".join(path.name for path in found.differing)
        remedy = "install the service again: sudo controller service install"
        return warning("service", f"{names}: not as this version installs it", remedy)
    return ok("service", f"{state}, {restarts}")

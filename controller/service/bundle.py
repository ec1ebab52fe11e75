"""The support bundle: one archive from which somebody elsewhere can see what is wrong with a cell.

Texts only, each of limited size, without secrets; what could not be had is named with the reason. Nothing is changed
and nothing moves; devices are opened only where nobody is at work with them, as `controller doctor` does.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from itertools import islice
from pathlib import Path

from controller import __version__
from controller.config.taught import TAUGHT_BINS
from controller.errors import SorterError
from controller.ledger.schema import SCHEMA
from controller.ledger.selection import Table
from controller.ledger.view import LedgerView, json_line
from controller.service import unit
from controller.service.client import ControlClient, folder_of_running_cell
from controller.service.doctor.case import Case
from controller.service.doctor.examine import examine, worst
from controller.service.secrets import json_without_secrets, without_secrets

MOST_BYTES = 2_000_000
"""Of one text; of a longer one the end is kept, where the trouble is."""
LAST_LINES = 3000
"""Of the journal."""
_LAST_RECORDS: Mapping[Table, int] = {"runs": 200, "outcomes": 3000, "intents": 500, "events": 3000, "days": 1000}

_Texts = Iterable[tuple[str, str]]


@dataclass(slots=True)
class Bundle:
    """What was collected.

    Attributes:
        texts: By name within the archive.
        missing: What could not be had, and why.
        removed: How many secrets were taken out of each text.
    """

    texts: dict[str, str] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    removed: dict[str, int] = field(default_factory=dict)


def collect(case: Case) -> Bundle:
    """Everything there is to be had of a cell; blocks for some seconds when devices are opened."""
    bundle = Bundle()
    sources: dict[str, Callable[[], _Texts]] = {
        "versions.json": _versions,
        "system.txt": lambda: _system(case),
        "doctor.json": lambda: _doctor(case),
        "configuration": lambda: _configuration(case),
        "calibration": lambda: _files(case.state, "calibration", "*.json"),
        "run": lambda: _files(case.state, "", "report.json"),
        "ledger": lambda: _ledger(case.state / "ledger.db"),
        "cell": _cell,
        "journal.txt": lambda: _journal(case),
        "unit": lambda: _unit(case),
    }
    for what, source in sources.items():
        try:
            for name, text in source():
                _add(bundle, name, text)
        except SorterError as error:
            bundle.missing[what] = str(error)
        except Exception as error:  # one thing that cannot be had must not keep the others from being sent
            bundle.missing[what] = f"{type(error).__name__}: {error}"
    return bundle


def write(bundle: Bundle, path: Path, made_at: str) -> dict[str, object]:
    """Write the archive, readable by its owner only.

    Returns:
        Its table of contents, which is in it as `bundle.json`.

    Raises:
        SorterError: It cannot be written, or exists.
    """
    contents: dict[str, object] = {
        "made_at": made_at,
        "software": __version__,
        "files": [
            {
                "name": name,
                "bytes": len(text.encode()),
                "sha256": hashlib.sha256(text.encode()).hexdigest(),
                "secrets_removed": bundle.removed[name],
            }
            for name, text in bundle.texts.items()
        ],
        "missing": {what: without_secrets(why, *_names())[0] for what, why in bundle.missing.items()},
    }
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("bundle.json", json.dumps(contents, indent=1))
            for name, text in bundle.texts.items():
                archive.writestr(name, text)
    except OSError as error:
        raise SorterError(f"{path}: {error.strerror or error}", "name a new file with --out") from error
    return contents


def _add(bundle: Bundle, name: str, text: str) -> None:
    if len(text) > MOST_BYTES:
        text = f"[the first {len(text) - MOST_BYTES} characters are left out]\n{text[-MOST_BYTES:]}"
    suffix = Path(name).suffix
    if suffix == ".jsonl":
        cleaned = [_cleaned_json(line, None) for line in text.splitlines()]
        bundle.texts[name] = "".join(line + "\n" for line, _ in cleaned)
        bundle.removed[name] = sum(count for _, count in cleaned)
    elif suffix == ".json":
        bundle.texts[name], bundle.removed[name] = _cleaned_json(text, 1)
    else:
        bundle.texts[name], bundle.removed[name] = without_secrets(text, *_names())


def _cleaned_json(text: str, indent: int | None) -> tuple[str, int]:
    try:
        found, removed = json_without_secrets(json.loads(text), *_names())
    except (ValueError, RecursionError):
        return without_secrets(text, *_names())
    return json.dumps(found, indent=indent), removed


def _names() -> tuple[str, ...]:
    """The machine's, and the home of whoever collects: wherever it is, his own name is in its path."""
    home = os.path.expanduser("~")
    return platform.node(), home, os.path.realpath(home)


# --- the sources ------------------------------------------------------------------------------------------


def _versions() -> _Texts:
    libraries = {d.metadata["Name"]: d.version for d in metadata.distributions() if d.metadata["Name"]}
    found = {
        "controller": __version__,
        "ledger_schema": SCHEMA,
        "python": sys.version,
        "platform": platform.platform(),
        "machine": platform.machine(),
        "libraries": dict(sorted(libraries.items())),
    }
    yield "versions.json", json.dumps(found, indent=1)


def _system(case: Case) -> _Texts:
    lines = []
    for name in ("/etc/os-release", "/proc/version", "/proc/uptime", "/proc/loadavg", "/proc/meminfo"):
        lines.append(f"# {name}\n{case.text(name) or 'not there'}\n")
    for name in ("/dev/serial/by-id", "/dev/v4l/by-id"):
        folder = case.path(name)
        entries = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else ["not there"]
        lines.append(f"# {name}\n" + "\n".join(entries) + "\n")
    yield "system.txt", "\n".join(lines)


def _doctor(case: Case) -> _Texts:
    findings = examine(case)
    found = {"verdict": str(worst(findings)), "checks": [finding.to_json() for finding in findings]}
    yield "doctor.json", json.dumps(found, indent=1)


def _configuration(case: Case) -> _Texts:
    if case.config is None:
        raise SorterError("no configuration was named", "name it with --config")
    yield "configuration/cell.toml", _text_of(case.config)
    yield from _files(case.state, "configuration", TAUGHT_BINS)


def _files(folder: Path, name: str, pattern: str) -> _Texts:
    """Small text files below a folder of the same name, or of the folder itself."""
    where = folder / name if name == "calibration" else folder
    for path in sorted(where.glob(pattern)):
        yield f"{name}/{path.name}" if name else path.name, _text_of(path)


def _text_of(path: Path) -> str:
    try:
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - 2 * MOST_BYTES, 0))
            return file.read(2 * MOST_BYTES).decode("utf-8", "replace")
    except OSError as error:
        raise SorterError(f"{path}: {error.strerror or error}") from error


def _ledger(path: Path) -> Iterator[tuple[str, str]]:
    with LedgerView(path) as view:
        for table, last in _LAST_RECORDS.items():
            yield f"ledger/{table}.jsonl", "".join(json_line(row) + "\n" for row in view.rows(table, last=last))
        found = {"problems": list(islice(view.verify(), 100)), "counts": view.counts(), "schema": view.schema}
        yield "ledger/verify.json", json.dumps(found, indent=1)


def _cell() -> _Texts:
    client = ControlClient(folder_of_running_cell())
    yield "cell/status.json", json.dumps(client.ask("status"), indent=1)
    yield "cell/alarms.json", json.dumps(client.ask("alarms"), indent=1)


def _journal(case: Case) -> _Texts:
    text = case.run((
        "journalctl", f"--unit={unit.UNIT}", f"--lines={LAST_LINES}", "--output=short-iso-precise",
        "--no-hostname", "--no-pager", "--quiet",
    ))  # fmt: skip
    if not text.strip():
        # It keeps from strangers what it has, and says nothing of that either.
        raise SorterError("the journal shows nothing of the service", "ask as root: sudo controller bundle")
    yield "journal.txt", text


def _unit(case: Case) -> _Texts:
    for path in unit.installed_files(case.root):
        yield f"unit/{path.name}", _text_of(path)

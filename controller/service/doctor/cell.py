"""What belongs to one cell: calibration, ledger, and who is at work on it."""

from __future__ import annotations

import json
from datetime import UTC, datetime

from controller.calibration.store import load
from controller.errors import CalibrationMissing, SorterError
from controller.ledger.view import LedgerView
from controller.service.doctor.case import Case
from controller.service.doctor.finding import Finding, failed, ok, warning

OLD_CALIBRATION = 90.0
"""Days after which mounts have had time to settle and a touch test is due."""
CERTIFICATE = "certificate.json"


def instance(case: Case) -> Finding:
    """Whether a cell is at work in this folder."""
    with case.hold() as holder:
        if holder is not None:
            return ok("instance", f"process {holder} is at work: it has the devices, which are not opened here")
    return ok("instance", "nobody is at work")


def calibration(case: Case) -> Finding:
    """There is a calibration, it belongs together and to this arm, it was proved, and it is not old."""
    folder = case.state / "calibration"
    try:
        stored = load(folder)
        stored.check(arm=case.arm.name if case.arm is not None else None)
        name = stored.cell().calibration_id
    except CalibrationMissing as error:
        return failed("calibration", error.cause, error.remedy)
    days = _age(case, [noted.get("made_at", "") for noted in stored.provenance.values()])
    text = name if days is None else f"{name}, {days:.0f} days old"
    verdict = _verdict(case, name)
    prove = "prove it: controller calibrate check"
    if verdict is None:
        return warning("calibration", f"{text}, never proved", prove)
    if verdict != "passed":
        return failed("calibration", f"{text}: {verdict}", "calibrate again: controller calibrate arm")
    if days is not None and days > OLD_CALIBRATION:
        return warning("calibration", text, prove)
    return ok("calibration", f"{text}, {verdict}")


def _age(case: Case, dates: list[str]) -> float | None:
    """Days since the oldest of some dates; None when none is known."""
    known = []
    for date in dates:
        try:
            made = datetime.fromisoformat(date)
        except ValueError:
            continue
        known.append(made if made.tzinfo is not None else made.replace(tzinfo=UTC))
    return (case.now - min(known)).total_seconds() / 86400.0 if known else None


def _verdict(case: Case, calibration_id: str) -> str | None:
    """The verdict of the certificate that speaks of this calibration."""
    try:
        content = json.loads((case.state / "calibration" / CERTIFICATE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(content, dict) or content.get("calibration_id") != calibration_id:
        return None
    return str(content.get("verdict"))


def ledger(case: Case) -> Finding:
    """The ledger can be read, and everything in it adds up."""
    path = case.state / "ledger.db"
    if not path.exists():
        return ok("ledger", f"none yet; the first run makes {path}")
    try:
        with LedgerView(path) as view:
            problems, counts = view.verify(), view.counts()
    except SorterError as error:
        return failed("ledger", error.cause, error.remedy)
    if problems:
        remedy = "keep a copy of the file; controller ledger verify lists everything"
        return failed("ledger", f"{problems[0]} ({len(problems)} problems)", remedy)
    return ok("ledger", f"{counts['targets']} targets on record, all accounted for")

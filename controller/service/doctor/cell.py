"""What belongs to one cell: calibration, ledger, and who is at work on it."""

from __future__ import annotations

from datetime import UTC, datetime

from controller.calibration.approval import DUE, certificate_of
from controller.calibration.certificate import PASSED
from controller.calibration.store import CAMERA, load
from controller.config.taught import TAUGHT_BINS, load_taught, with_taught
from controller.cycle.preflight import check
from controller.errors import CalibrationMissing, SorterError
from controller.ledger.view import LedgerView
from controller.motion.planner import Planner
from controller.service.doctor.case import Case
from controller.service.doctor.finding import Finding, counted, failed, ok, warning
from controller.service.manual import by_ruler


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
    prove = "prove it: controller calibrate check"
    try:
        proof = certificate_of(folder, stored)
    except SorterError as error:
        return failed("calibration", f"{text}: {error.cause}", error.remedy)
    if proof.verdict != PASSED:
        return failed("calibration", f"{text}: {proof.verdict}", "calibrate again: controller calibrate arm")
    proved = proof.age(case.now)
    if proved is None or proved > DUE:
        when = "at an unknown time" if proved is None else f"{proved:.0f} days ago"
        return warning("calibration", f"{text}, {proof.verdict} {when}", prove)
    return ok("calibration", f"{text}, {proof.verdict}")


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
        return failed("ledger", f"{problems[0]} ({counted(len(problems), 'problem')})", remedy)
    return ok("ledger", f"{counts['targets']} targets on record, all accounted for")


def bins(case: Case) -> Finding:
    """Every bin, where it was taught to stand, is within the arm's reach and in no other."""
    assert case.cell is not None
    assert case.arm is not None
    file = case.state / TAUGHT_BINS
    taught = {} if case.simulated else load_taught(file)
    config = with_taught(case.cell, file) if taught else case.cell
    where = case.state / "calibration"
    known = by_ruler(config) if case.simulated or not (where / CAMERA).is_file() else load(where).cell()
    warnings = check(config, case.arm, Planner(case.arm, known, config.bin_values()))
    text = f"{len(config.bins)} within reach of {case.arm.title}, {len(taught)} taught"
    if warnings:
        return warning("bins", f"{text}; {'; '.join(warnings)}", "see controller config check")
    return ok("bins", text)

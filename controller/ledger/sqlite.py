"""The writer of the ledger: every record is on the disk before the call returns."""

from __future__ import annotations

import json
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from controller.domain import Outcome, PickPlan, Result
from controller.errors import LedgerError
from controller.ledger.failures import DAMAGED, as_ledger_error, code_of
from controller.ledger.opening import open_sound, set_aside
from controller.ledger.records import OBJECT_COLUMNS, PLAN_COLUMNS, object_row, plan_row
from controller.ledger.retention import prune
from controller.ledger.view import LedgerReader
from controller.ports import Clock

NOT_RESET = "not reset"
"""Reason of a run that ended in good order, but before anybody had reset what too many runs cut off had latched."""

_TARGET = ", ".join([*OBJECT_COLUMNS, *PLAN_COLUMNS])


@dataclass(frozen=True, slots=True)
class OpenTarget:
    """A target whose pick was begun by a run that ended without saying what became of it.

    Attributes:
        run_id: That run.
        target_id: The target.
        label: What it was.
        bin: Where it was meant to go.
        attempts: How often it had been tried.
        wall: When the last attempt began, ISO 8601, UTC.
    """

    run_id: int
    target_id: str
    label: str
    bin: str
    attempts: int
    wall: str


class SqliteLedger(LedgerReader):
    """The ledger of a running cell. One process at a time: the caller holds the cell's lock.

    Opening it brings an older file to the present schema (after a backup beside it), sets a damaged one aside, and
    settles what an earlier run left open as INDETERMINATE, once. Safe to use from several threads.

    Args:
        path: The file; it and its folder are made if missing.
        clock: The cell's clock.
        wall: Date and time for the record.

    Attributes:
        indeterminate: Targets that opening has settled as INDETERMINATE: the gripper or the table may hold them.
        unclean_runs: Number of runs that were cut off: the process was killed, or the power went.
        unclean_in_a_row: How many runs were cut off since the last that ended in good order, not counting
            those that ended so before the cell was reset.
        set_aside: Where a damaged ledger was moved, or None.

    Raises:
        LedgerError: The file cannot be opened or written, is not a ledger, or was written by a newer version.
    """

    def __init__(
        self, path: Path, *, clock: Clock, wall: Callable[[], datetime] = lambda: datetime.now(UTC)
    ) -> None:
        self._clock = clock
        self._wall = wall
        self._lock = threading.RLock()
        self._run_id: int | None = None
        self.set_aside: Path | None = None
        self.indeterminate: tuple[OpenTarget, ...] = ()
        self.unclean_runs = self.unclean_in_a_row = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LedgerError(
                f"{path.parent}: {error.strerror or error}", "name a folder that can be written"
            ) from error
        with as_ledger_error(path, "open"):
            try:
                connection = open_sound(path)
            except sqlite3.DatabaseError as error:
                if code_of(error) not in DAMAGED:
                    raise
                self.set_aside = set_aside(path, wall())
                connection = open_sound(path)
            super().__init__(path, connection)
            try:
                with self._transaction("reconcile"):
                    if self.set_aside is not None:
                        self._insert_event("ledger_damaged", clock.now(), {"set_aside": str(self.set_aside)})
                    self._reconcile()
            except BaseException:
                connection.close()
                raise

    # --- the Ledger port ------------------------------------------------------------------------------

    def intend(self, target_id: str, plan: PickPlan, attempt: int, at: float) -> None:
        """Commit the intent to pick; returns only when it would survive a loss of power.

        Raises:
            ValueError: The target already has an outcome, or this attempt is on record.
            LedgerError: It could not be written; nothing may move.
        """
        run_id = self._run()
        with self._transaction(f"record the intent to pick {target_id}"):
            self._insert(
                "intents",
                {
                    "run_id": run_id,
                    "target_id": target_id,
                    "attempt": attempt,
                    "at_s": float(at),
                    "wall": self._now(),
                    **object_row(plan.target),
                    **plan_row(plan),
                },
            )

    def conclude(self, outcome: Outcome) -> None:
        """Commit the one outcome of a target.

        Raises:
            ValueError: The target already has an outcome, or has no name.
            LedgerError: It could not be written; it may be tried again.
        """
        target_id = outcome.target.target_id
        run_id = self._run()
        with self._transaction(f"record the outcome of {target_id}"):
            self._insert(
                "outcomes",
                {
                    "run_id": run_id,
                    "target_id": target_id,
                    "result": str(outcome.result),
                    "reason": outcome.reason,
                    "attempts": outcome.attempts,
                    "started_at_s": float(outcome.started_at),
                    "finished_at_s": float(outcome.finished_at),
                    "wall": self._now(),
                    **object_row(outcome.target),
                    **plan_row(outcome.plan),
                },
            )

    def note(self, kind: str, at: float, **details: object) -> None:
        """Commit an event.

        Raises:
            LedgerError: It could not be written.
        """
        with self._transaction(f"record the event {kind}"):
            self._insert_event(kind, at, details)

    # --- runs -----------------------------------------------------------------------------------------

    @property
    def run_id(self) -> int | None:
        """The run in progress."""
        return self._run_id

    def begin_run(
        self,
        *,
        software_version: str,
        config_hash: str,
        calibration_id: str = "",
        mode: str = "",
        arm: str = "",
        seed: int | None = None,
        **details: object,
    ) -> int:
        """Begin a run: what was started, with which software, configuration and calibration.

        A changed configuration or calibration is a new run; the one in progress ends with the reason `changed`.
        """
        if self._run_id is not None:
            self.end_run("changed")
        row: dict[str, object] = {
            "started_wall": self._now(),
            "started_at_s": self._clock.now(),
            "boot_id": _boot_id(),
            "software_version": software_version,
            "config_hash": config_hash,
            "calibration_id": calibration_id,
            "mode": mode,
            "arm": arm,
            "seed": seed,
            "details": _json(details),
        }
        with self._transaction("begin a run"):
            run_id = self._insert("runs", row)
        self._run_id = run_id
        return run_id

    def end_run(self, reason: str) -> None:
        """End the run in progress in good order; harmless when there is none.

        Raises:
            LedgerError: It could not be written.
        """
        with self._transaction("end the run"):
            self._connection.execute(
                "UPDATE runs SET ended_wall = ?, ended_at_s = ?, end_reason = ? WHERE run_id = ?",
                (self._now(), self._clock.now(), reason, self._run_id),
            )
        self._run_id = None

    def prune(self, keep: timedelta = timedelta(days=400), most_bytes: int = 256 << 20) -> int:
        """Take away old records, keeping their counts by day; `days` has them.

        Args:
            keep: Records younger than this stay if they fit.
            most_bytes: Size the records may take; the oldest days go first, today's stay.

        Returns:
            Number of targets whose single records are gone.

        Raises:
            LedgerError: It could not be written; nothing is gone.
        """
        with self._transaction("take away old records"):
            gone = prune(self._connection, self._wall(), keep, most_bytes)
        with self._lock, as_ledger_error(self.path, "give back space"):
            # As a script: it frees a page at every step, and execute() takes only the first.
            self._connection.executescript("PRAGMA incremental_vacuum")
        return gone

    def close(self) -> None:
        """End the run in progress and release the file; harmless when closed.

        A target still open stays so, and is settled as INDETERMINATE when the ledger is opened again.
        """
        try:
            if self._run_id is not None:
                self.end_run("closed")
        except LedgerError:
            self._run_id = None  # the next start will call the run unclean, which it was
        finally:
            super().close()

    # --- inside ---------------------------------------------------------------------------------------

    @contextmanager
    def _transaction(self, operation: str) -> Iterator[None]:
        """One durable step: all of it is on the disk at the end, or none of it ever."""
        with self._lock, as_ledger_error(self.path, operation):
            try:
                self._connection.execute("BEGIN IMMEDIATE")
                yield
                self._connection.execute("COMMIT")
            except BaseException as error:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                if isinstance(error, sqlite3.IntegrityError):
                    raise ValueError(f"{operation}: {error}") from error
                raise

    def _run(self) -> int:
        """The run in progress; a record must never be lost for want of one."""
        return self._run_id or self.begin_run(software_version="", config_hash="")

    def _now(self) -> str:
        return self._wall().isoformat(timespec="milliseconds")

    def _insert(self, table: str, row: Mapping[str, object]) -> int:
        marks = ", ".join(f":{name}" for name in row)
        cursor = self._connection.execute(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks})", dict(row))
        return int(cursor.lastrowid or 0)

    def _insert_event(self, kind: str, at: float, details: Mapping[str, object]) -> None:
        row = {"run_id": self._run_id, "at_s": float(at), "wall": self._now(), "kind": kind, "details": _json(details)}
        self._insert("events", row)

    def _reconcile(self) -> None:
        """Give every target that an earlier run left open its one outcome, and end that run."""
        ask = self._connection.execute
        last_tries = ask(
            "SELECT run_id, target_id, label, bin, count(*), wall, max(attempt) FROM intents"
            " WHERE (run_id, target_id) NOT IN (SELECT run_id, target_id FROM outcomes)"
            " GROUP BY run_id, target_id ORDER BY intent_id"
        )
        self.indeterminate = tuple(OpenTarget(*row[:6]) for row in last_tries)
        reason = "the controller ended between the intent and the outcome"
        for open_ in self.indeterminate:
            ask(
                "INSERT INTO outcomes (run_id, target_id, result, reason, attempts, started_at_s, finished_at_s,"
                f" wall, {_TARGET})"
                f" SELECT run_id, target_id, ?, ?, ?, min(at_s) OVER (), at_s, ?, {_TARGET} FROM intents"
                " WHERE run_id = ? AND target_id = ? ORDER BY attempt DESC LIMIT 1",
                (str(Result.INDETERMINATE), reason, open_.attempts, self._now(), open_.run_id, open_.target_id),
            )
        self.unclean_runs = ask("UPDATE runs SET end_reason = 'unclean' WHERE end_reason IS NULL").rowcount
        last_clean = "SELECT max(run_id) FROM runs WHERE end_reason NOT IN ('unclean', ?)"
        since = f"SELECT count(*) FROM runs WHERE end_reason = 'unclean' AND run_id > coalesce(({last_clean}), 0)"
        row = ask(since, (NOT_RESET,)).fetchone()
        self.unclean_in_a_row = int(row[0])
        if self.unclean_runs or self.indeterminate:
            details = {"runs": self.unclean_runs, "targets": [open_.target_id for open_ in self.indeterminate]}
            self._insert_event("reconciled", self._clock.now(), details)


def _json(details: Mapping[str, object]) -> str:
    return json.dumps(details, default=str, sort_keys=True)


def _boot_id() -> str:
    """Identity of this start of the computer: the cell's clock is comparable only within one; "" if unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""

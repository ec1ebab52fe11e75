"""Reading a ledger: counts, export and the proof that every target was counted once."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import sqlite3
from collections.abc import Generator, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self
from urllib.parse import quote

from controller.domain import Result
from controller.errors import LedgerError
from controller.ledger.failures import as_ledger_error, damage
from controller.ledger.schema import SCHEMA, is_foreign, migrate, version_of
from controller.ledger.selection import EVERYTHING, TABLES, Selection, Table

_KEY: dict[Table, str] = {
    "runs": "run_id",
    "intents": "intent_id",
    "outcomes": "outcome_id",
    "events": "event_id",
    "days": "day, mode, label, bin, result",
}

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""What a formula begins with in the usual spreadsheets. Source: OWASP, "CSV Injection"."""

_OPEN_TARGETS = """
    SELECT DISTINCT run_id, target_id FROM intents
    EXCEPT SELECT run_id, target_id FROM outcomes
"""


class LedgerReader:
    """What can be asked of an open ledger.

    Args:
        path: Its file, for messages.
        connection: The open database; closed by `close`.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection

    def close(self) -> None:
        """Release the file; harmless when closed."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def schema(self) -> int:
        """Schema of the file as it is read."""
        with as_ledger_error(self.path, "read"):
            return version_of(self._connection)

    def rows(
        self, table: Table, selection: Selection = EVERYTHING, last: int | None = None
    ) -> Generator[dict[str, Any], None, None]:
        """The records of a table, oldest first; `days` counts what retention took away.

        Args:
            table: The table.
            selection: Which of them.
            last: Only so many of the newest.

        Raises:
            ValueError: There is no such table, or it has nothing of what is asked for.
            LedgerError: They cannot be read.
        """
        if table not in TABLES:
            raise ValueError(f"no table {table!r}; there are {', '.join(TABLES)}")
        where, values = selection.where(table)
        ask = f"SELECT * FROM {table} {where}"
        if last is not None:
            key = _KEY[table].replace(",", " DESC,")
            ask = f"SELECT * FROM ({ask} ORDER BY {key} DESC LIMIT ?)"
            values = (*values, last)
        with as_ledger_error(self.path, "read"):
            cursor = self._connection.cursor()
            try:
                cursor.execute(f"{ask} ORDER BY {_KEY[table]}", values)
                names = [column[0] for column in cursor.description]
                for values_ in cursor:
                    row: dict[str, Any] = dict(zip(names, values_, strict=True))
                    if "details" in row:
                        row["details"] = _details(row["details"])
                    yield row
            finally:
                # Who stops reading in between may have closed the ledger already.
                with suppress(sqlite3.ProgrammingError):
                    cursor.close()

    def counts(self, run_id: int | None = None) -> dict[str, int]:
        """Targets by result, plus `open` (begun without an outcome yet) and `targets` (all of them).

        Without those that retention took away: `days` counts them.
        """
        where, values = ("", ()) if run_id is None else ("WHERE run_id = ?", (run_id,))
        found: dict[str, int] = {str(result): 0 for result in Result}
        with as_ledger_error(self.path, "read"):
            results = self._connection.execute(f"SELECT result, count(*) FROM outcomes {where} GROUP BY result", values)
            found.update(results.fetchall())
            open_ = self._connection.execute(f"SELECT count(*) FROM ({_OPEN_TARGETS}) {where}", values)
            targets = self._connection.execute(
                "SELECT count(*) FROM (SELECT run_id, target_id FROM intents UNION"
                f" SELECT run_id, target_id FROM outcomes) {where}",
                values,
            )
            found["open"] = int(open_.fetchone()[0])
            found["targets"] = int(targets.fetchone()[0])
        return found

    # What comes after what is told by run and cell clock: somebody may set the computer's date back.

    @property
    def may_hold_part(self) -> bool:
        """Nobody knows what became of the last target, and nobody has reset the cell since: it may be in the jaws."""
        with as_ledger_error(self.path, "read"):
            row = self._connection.execute(
                "SELECT result IN ('indeterminate', 'aborted') AND NOT EXISTS (SELECT 1 FROM events e"
                " WHERE e.kind = 'operator' AND json_extract(e.details, '$.command') = 'reset'"
                " AND (e.run_id, e.at_s) >= (o.run_id, o.finished_at_s))"
                " FROM outcomes o ORDER BY outcome_id DESC LIMIT 1"
            ).fetchone()
        return row is not None and bool(row[0])

    def in_bins(self) -> dict[str, int]:
        """Parts put into each bin, by name, since an event `emptied` named it (or, without a `bin`, all of them)."""
        counts: dict[str, int] = {}
        with as_ledger_error(self.path, "read"):
            ask = self._connection.execute
            for (name,) in ask("SELECT DISTINCT bin FROM outcomes WHERE result IN ('placed', 'rejected')").fetchall():
                emptied = ask(
                    "SELECT run_id, at_s FROM events WHERE kind = 'emptied'"
                    " AND coalesce(json_extract(details, '$.bin'), ?1) = ?1 ORDER BY 1 DESC, 2 DESC LIMIT 1",
                    (name,),
                ).fetchone()
                (counts[name],) = ask(
                    "SELECT count(*) FROM outcomes WHERE bin = ? AND result IN ('placed', 'rejected')"
                    " AND (run_id, finished_at_s) > (?, ?)",
                    (name, *(emptied or (0, 0.0))),
                ).fetchone()
        return {name: count for name, count in counts.items() if count}

    def verify(self) -> tuple[str, ...]:
        """Everything that is wrong with the file or the record; empty for a sound ledger.

        Checks SQLite's own structure, that every record belongs to a run, that every target has one outcome at
        most, that all of its attempts and no others are on record, and that targets by result and open ones add up
        to all targets.
        """
        problems: list[str] = []
        with as_ledger_error(self.path, "verify"):
            ask = self._connection.execute
            problems += [str(line) for (line,) in ask("PRAGMA quick_check") if line != "ok"]
            problems += [f"{table} {row} names an unknown run" for table, row, *_ in ask("PRAGMA foreign_key_check")]
            problems += [
                f"target {target} of run {run} has {number} outcomes"
                for run, target, number in ask(
                    "SELECT run_id, target_id, count(*) FROM outcomes GROUP BY run_id, target_id HAVING count(*) > 1"
                )
            ]
            problems += [
                f"target {target} of run {run}: {tried} attempts on record, but its outcome says {said}"
                for run, target, tried, said in ask(
                    "SELECT run_id, target_id, count(i.intent_id) AS tried, o.attempts FROM outcomes o"
                    " LEFT JOIN intents i USING (run_id, target_id) GROUP BY run_id, target_id"
                    " HAVING o.attempts <> tried"
                )
            ]
        counts = self.counts()
        targets = counts.pop("targets")
        if sum(counts.values()) != targets:
            problems.append(f"{targets} targets, but {sum(counts.values())} by result and open")
        return tuple(problems)

    def export(
        self, format_: Literal["csv", "jsonl"], table: Table = "outcomes", selection: Selection = EVERYTHING
    ) -> Iterator[str]:
        """The records of a table as lines of text without their ends: CSV with a header, or one JSON object each."""
        if format_ == "jsonl":
            for row in self.rows(table, selection):
                yield json_line(row)
        elif format_ == "csv":
            rows = self.rows(table, selection)
            first = next(rows, None)
            with as_ledger_error(self.path, "read"):
                columns = [str(row[1]) for row in self._connection.execute(f"PRAGMA table_info({table})")]
            yield _csv_line(columns)
            for row in itertools.chain([] if first is None else [first], rows):
                yield _csv_line([json.dumps(v) if isinstance(v, dict) else v for v in row.values()])
        else:
            raise ValueError(f"no format {format_!r}; there are csv, jsonl")


class LedgerView(LedgerReader):
    """A ledger opened for reading only; a running cell may go on writing to it.

    An older one is read through a copy in memory, brought to the present schema; the file stays as it is.

    Args:
        path: The file.

    Raises:
        LedgerError: There is no such ledger, it is damaged, or a newer version wrote it.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise LedgerError(f"{path}: no such ledger", "check the name; a run writes ledger.db into its folder")
        with as_ledger_error(path, "open"):
            connection = _connect_for_reading(path)
            try:
                refuse_unknown(connection, path)
                if version_of(connection) < SCHEMA:
                    file, connection = connection, _migrated_copy(connection)
                    file.close()
            except BaseException:
                connection.close()
                raise
        super().__init__(path, connection)


def refuse_unknown(connection: sqlite3.Connection, path: Path) -> None:
    """Stop before touching a file that is not a ledger, or that a newer program wrote.

    Raises:
        LedgerError: It is one of these.
        sqlite3.Error: It is damaged.
    """
    if is_foreign(connection):
        raise LedgerError(f"{path}: a database, but not a ledger", "name another file")
    version = version_of(connection)
    if version < 0:
        raise damage(f"its schema is said to be {version}")
    if version > SCHEMA:
        raise LedgerError(
            f"{path}: written by a newer version (schema {version}, this program knows {SCHEMA})",
            "upgrade this program, or name another file",
        )


def _connect_for_reading(path: Path) -> sqlite3.Connection:
    address = f"file:{quote(str(path.resolve()))}?mode=ro"
    connection = sqlite3.connect(address, uri=True, isolation_level=None)
    try:
        connection.execute("SELECT count(*) FROM sqlite_master")
    except sqlite3.OperationalError:
        connection.close()
        if path.with_name(path.name + "-wal").exists():
            raise
        # A folder that cannot be written: SQLite wants to make the log's index there. Without a log nobody is
        # writing, so that the file may be read as it is.
        connection = sqlite3.connect(f"{address}&immutable=1", uri=True, isolation_level=None)
    except BaseException:
        connection.close()
        raise
    return connection


def _migrated_copy(connection: sqlite3.Connection) -> sqlite3.Connection:
    copy = sqlite3.connect(":memory:", isolation_level=None)
    try:
        connection.backup(copy)
        migrate(copy)
    except BaseException:
        copy.close()
        raise
    return copy


def json_line(row: Mapping[str, object]) -> str:
    """A record as one line of strict JSON: bytes become text, and what is no finite number null."""
    return json.dumps(_finite(row), default=_bytes_as_text, allow_nan=False)


def _finite(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: _finite(part) for key, part in value.items()}
    return [_finite(part) for part in value] if isinstance(value, list) else value


def _details(stored: object) -> dict[str, object]:
    """What an event or a run tells besides its columns; text that is no JSON object is given as it is."""
    text = _bytes_as_text(stored)
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {"text": text}
    return found if isinstance(found, dict) else {"text": text}


def _bytes_as_text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _csv_line(values: list[str] | list[object]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="").writerow([_inert(value) for value in values])
    return out.getvalue()


def _inert(value: object) -> object:
    """Text that a spreadsheet would take for a formula, as text: whoever names a class or a bin must not run there."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value

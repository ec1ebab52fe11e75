"""What SQLite's errors mean to the one who runs the cell."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from controller.errors import LedgerError

# Primary result codes (the low byte of the extended code). Source: sqlite.org/rescode.html.
_REMEDIES = {
    sqlite3.SQLITE_FULL: "free some space on that disk",
    sqlite3.SQLITE_READONLY: "make the folder and the file writable",
    sqlite3.SQLITE_CANTOPEN: "check that the folder exists and can be written",
    sqlite3.SQLITE_PERM: "make the folder and the file writable",
    sqlite3.SQLITE_IOERR: "check the disk: full, failing or removed",
    sqlite3.SQLITE_BUSY: "end the other program that writes to it",
    sqlite3.SQLITE_LOCKED: "end the other program that writes to it",
    sqlite3.SQLITE_CORRUPT: "start the cell again: a damaged ledger is set aside and a new one begun",
    sqlite3.SQLITE_NOTADB: "start the cell again: a damaged ledger is set aside and a new one begun",
}
DAMAGED = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB})


def code_of(error: sqlite3.Error) -> int:
    """Primary result code of an error, 0 when SQLite itself did not raise it."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF


def damage(cause: str) -> sqlite3.DatabaseError:
    """The error of a database that is damaged, for a reason that SQLite itself does not give as one."""
    error = sqlite3.DatabaseError(cause)
    error.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
    return error


@contextmanager
def as_ledger_error(path: Path, operation: str) -> Iterator[None]:
    """Turn SQLite's errors into one that names the file and the remedy.

    Raises:
        LedgerError: Any SQLite error but a broken constraint, which is the caller's to judge.
    """
    try:
        yield
    except sqlite3.IntegrityError:
        raise
    except UnicodeDecodeError as error:
        # SQLite's message quotes the damaged place, and Python cannot decode it.
        raise LedgerError(f"{path}: {operation}: damaged", _REMEDIES[sqlite3.SQLITE_CORRUPT]) from error
    except sqlite3.Error as error:
        raise LedgerError(f"{path}: {operation}: {error}", _REMEDIES.get(code_of(error), "")) from error

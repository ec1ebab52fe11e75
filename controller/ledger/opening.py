"""Opening a ledger for writing: what it must be before a run may rely on it."""

from __future__ import annotations

import sqlite3
from datetime import datetime
from pathlib import Path

from controller.errors import LedgerError
from controller.ledger.failures import damage
from controller.ledger.schema import SCHEMA, migrate, version_of
from controller.ledger.view import refuse_unknown


def open_sound(path: Path) -> sqlite3.Connection:
    """A connection that may write to a sound ledger at the present schema; an older one is backed up first.

    Raises:
        LedgerError: It is not a ledger, or was written by a newer version; the file is as it was.
        sqlite3.Error: It is damaged, or cannot be opened or written.
    """
    connection = sqlite3.connect(path, timeout=2.0, isolation_level=None, check_same_thread=False)
    try:
        refuse_unknown(connection, path)
        if version_of(connection) == 0:
            # Only a database without tables takes this on: pages given free can be handed back to the disk.
            connection.execute("PRAGMA auto_vacuum = INCREMENTAL")
        connection.execute("PRAGMA journal_mode = WAL")
        # FULL: a commit has reached the disk before it returns, not only the operating system.
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA journal_size_limit = 4194304")
        found = [str(line) for (line,) in connection.execute("PRAGMA quick_check")]
        if found != ["ok"]:
            raise damage("; ".join(found[:3]))
        version = version_of(connection)
        if version < SCHEMA:
            if version > 0:
                _back_up(connection, path.with_name(f"{path.name}.schema{version}"))
            connection.execute("BEGIN IMMEDIATE")
            migrate(connection)
            connection.execute("COMMIT")
    except UnicodeDecodeError as error:
        # SQLite's message quotes the damaged place, and Python cannot decode it.
        connection.close()
        raise damage("its schema is no text") from error
    except BaseException:
        connection.close()
        raise
    return connection


def _back_up(connection: sqlite3.Connection, path: Path) -> None:
    """Copy the database as it is."""
    copy = sqlite3.connect(path)
    try:
        connection.backup(copy)
    finally:
        copy.close()


def set_aside(path: Path, now: datetime) -> Path:
    """Rename a damaged ledger and its log, so that they can be looked into and a new one begun.

    Returns:
        The new name of the ledger.

    Raises:
        LedgerError: It cannot be renamed.
    """
    aside = path.with_name(f"{path.name}.damaged-{now.strftime('%Y%m%dT%H%M%S%f')}")
    try:
        for suffix in ("", "-wal", "-shm"):
            part = path.with_name(path.name + suffix)
            if part.exists():
                part.rename(aside.with_name(aside.name + suffix))
    except OSError as error:
        raise LedgerError(
            f"{path}: damaged, and cannot be set aside: {error.strerror or error}",
            "make the folder writable, or move the file away",
        ) from error
    return aside

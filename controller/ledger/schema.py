"""The tables of the ledger and the way from every older form to the present one.

The database itself refuses what must never happen: a second outcome of a target, an intent after the outcome,
a record changed, or taken away other than by retention, which first adds it to the counts of its day.
"""

from __future__ import annotations

import sqlite3

from controller.domain import Result
from controller.ledger.records import OBJECT_COLUMNS, PLAN_COLUMNS

# "SORT" in ASCII: tells a ledger from any other SQLite file (PRAGMA application_id).
APPLICATION_ID = 0x534F5254

_TARGET = ",\n".join(f"{name} {kind}" for name, kind in {**OBJECT_COLUMNS, **PLAN_COLUMNS}.items())
_RESULTS = ", ".join(f"'{result}'" for result in Result)

_V1 = (
    """
    CREATE TABLE runs (
      run_id INTEGER PRIMARY KEY AUTOINCREMENT,
      started_wall TEXT NOT NULL,
      started_at_s REAL NOT NULL,
      boot_id TEXT NOT NULL,
      software_version TEXT NOT NULL,
      config_hash TEXT NOT NULL,
      calibration_id TEXT NOT NULL,
      mode TEXT NOT NULL,
      arm TEXT NOT NULL,
      seed INTEGER,
      details TEXT NOT NULL,
      ended_wall TEXT,
      ended_at_s REAL,
      end_reason TEXT
    )
    """,
    f"""
    CREATE TABLE intents (
      intent_id INTEGER PRIMARY KEY AUTOINCREMENT,
      run_id INTEGER NOT NULL REFERENCES runs,
      target_id TEXT NOT NULL CHECK (target_id <> ''),
      attempt INTEGER NOT NULL,
      at_s REAL NOT NULL,
      wall TEXT NOT NULL,
      {_TARGET},
      UNIQUE (run_id, target_id, attempt)
    )
    """,
    f"""
    CREATE TABLE outcomes (
      outcome_id INTEGER PRIMARY KEY AUTOINCREMENT,
      run_id INTEGER NOT NULL REFERENCES runs,
      target_id TEXT NOT NULL CHECK (target_id <> ''),
      result TEXT NOT NULL CHECK (result IN ({_RESULTS})),
      reason TEXT NOT NULL,
      attempts INTEGER NOT NULL,
      started_at_s REAL NOT NULL,
      finished_at_s REAL NOT NULL,
      wall TEXT NOT NULL,
      {_TARGET},
      UNIQUE (run_id, target_id)
    )
    """,
    """
    CREATE TABLE events (
      event_id INTEGER PRIMARY KEY AUTOINCREMENT,
      run_id INTEGER REFERENCES runs,
      at_s REAL NOT NULL,
      wall TEXT NOT NULL,
      kind TEXT NOT NULL,
      details TEXT NOT NULL
    )
    """,
    """
    CREATE TABLE days (
      day TEXT NOT NULL,
      mode TEXT NOT NULL,
      label TEXT NOT NULL,
      bin TEXT NOT NULL,
      result TEXT NOT NULL,
      targets INTEGER NOT NULL,
      attempts INTEGER NOT NULL,
      PRIMARY KEY (day, mode, label, bin, result)
    ) WITHOUT ROWID
    """,
    # Empty but within the transaction that takes old records away.
    "CREATE TABLE pruning (before TEXT NOT NULL)",
    "CREATE INDEX outcomes_by_wall ON outcomes (wall)",
    "CREATE INDEX events_by_wall ON events (wall)",
    """
    CREATE TRIGGER no_intent_after_outcome BEFORE INSERT ON intents
    WHEN EXISTS (SELECT 1 FROM outcomes WHERE run_id = NEW.run_id AND target_id = NEW.target_id)
    BEGIN SELECT RAISE(ABORT, 'the target already has an outcome'); END
    """,
    *(
        f"""
        CREATE TRIGGER {table}_never_{verb.lower()}d BEFORE {verb} ON {table}
        WHEN {condition}
        BEGIN SELECT RAISE(ABORT, 'the ledger only grows'); END
        """
        for table in ("intents", "outcomes", "events")
        for verb, condition in (("UPDATE", "TRUE"), ("DELETE", "NOT EXISTS (SELECT 1 FROM pruning)"))
    ),
)

# MIGRATIONS[n] leads from schema n to n + 1.
MIGRATIONS: tuple[tuple[str, ...], ...] = (_V1,)
SCHEMA = len(MIGRATIONS)


def version_of(connection: sqlite3.Connection) -> int:
    """Schema of a database, 0 for an empty one."""
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def is_foreign(connection: sqlite3.Connection) -> bool:
    """The database has tables, but was not made by this project."""
    mark = int(connection.execute("PRAGMA application_id").fetchone()[0])
    tables = int(connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0])
    return tables > 0 and mark != APPLICATION_ID


def migrate(connection: sqlite3.Connection) -> None:
    """Bring a database to `SCHEMA`, within the transaction that the caller has begun if half of it must not stay."""
    for step in range(version_of(connection), SCHEMA):
        for statement in MIGRATIONS[step]:
            connection.execute(statement)
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {SCHEMA}")

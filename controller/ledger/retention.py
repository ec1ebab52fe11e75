"""What is kept for how long: single records for months, counts by day for ever.

A target goes with all of its records or stays with all of them; one that is still open stays.
"""

from __future__ import annotations

import sqlite3
from datetime import datetime, timedelta

# Days taken away at a time when the file is too large: few enough to keep what fits.
_STEP = timedelta(days=1)


def prune(connection: sqlite3.Connection, now: datetime, keep: timedelta, most_bytes: int) -> int:
    """Take away records older than `keep`, and then the oldest days until the rest fits into `most_bytes`.

    Runs within the transaction that the caller has begun. Today's records are never taken away.

    Returns:
        Number of targets whose single records are gone.
    """
    before = now - keep
    gone = _prune_before(connection, before)
    today = now.replace(hour=0, minute=0, second=0, microsecond=0)
    while _bytes_used(connection) > most_bytes:
        oldest = connection.execute(
            "SELECT min(wall) FROM (SELECT min(wall) AS wall FROM outcomes UNION SELECT min(wall) FROM events)"
        ).fetchone()[0]
        if oldest is None or datetime.fromisoformat(oldest) >= today:
            break
        before = min(_midnight_after(datetime.fromisoformat(oldest)), today)
        gone += _prune_before(connection, before)
    return gone


def _prune_before(connection: sqlite3.Connection, before: datetime) -> int:
    limit = before.isoformat(timespec="milliseconds")
    ask = connection.execute
    ask("INSERT INTO pruning VALUES (?)", (limit,))
    ask(
        "INSERT INTO days"
        " SELECT substr(o.wall, 1, 10), r.mode, o.label, coalesce(o.bin, ''), o.result, count(*), sum(o.attempts)"
        " FROM outcomes o JOIN runs r USING (run_id) WHERE o.wall < ? GROUP BY 1, 2, 3, 4, 5"
        " ON CONFLICT DO UPDATE SET targets = targets + excluded.targets, attempts = attempts + excluded.attempts",
        (limit,),
    )
    ask(
        "DELETE FROM intents WHERE (run_id, target_id) IN (SELECT run_id, target_id FROM outcomes WHERE wall < ?)",
        (limit,),
    )
    gone = ask("DELETE FROM outcomes WHERE wall < ?", (limit,)).rowcount
    ask("DELETE FROM events WHERE wall < ?", (limit,))
    ask("DELETE FROM pruning")
    return gone


def _midnight_after(moment: datetime) -> datetime:
    return moment.replace(hour=0, minute=0, second=0, microsecond=0) + _STEP


def _bytes_used(connection: sqlite3.Connection) -> int:
    figures = ("page_size", "page_count", "freelist_count")
    page, pages, free = (int(connection.execute(f"PRAGMA {figure}").fetchone()[0]) for figure in figures)
    return page * (pages - free)

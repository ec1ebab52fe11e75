"""What a cell spent a period with, from the runs and events of its ledger.

All moments of a run are its start on the calendar plus what the cell's clock has counted since. On a real cell that is
the time of day, whatever somebody did to the computer's date; in simulation it is simulated time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any

from controller.ledger.events import STATE, Doing
from controller.ledger.selection import Selection, Table
from controller.ledger.view import LedgerReader

OFF = "off"
"""The program was not running."""
_SHORTEST = timedelta(seconds=1)
"""A shorter rest of a period is no time off."""
TICK = timedelta(milliseconds=1)
"""The last record of a run still belongs to it, and to a period that ends with it: both end so much later."""
# What lies beyond was not written by this program.
_YEARS = range(1970, 2500)
_LONGEST_RUN = 3.2e9  # s, a hundred years


@dataclass(frozen=True, slots=True)
class Run:
    """A start of the program.

    Attributes:
        row: Its record.
        begin, end: When it began and ended, or was last heard of.
    """

    row: dict[str, Any]
    begin: datetime
    end: datetime

    @property
    def run_id(self) -> int:
        """Its number."""
        return int(self.row["run_id"])

    def at(self, at_s: object) -> datetime:
        """A time of the cell's clock on the calendar."""
        seconds = number(at_s) - number(self.row["started_at_s"])
        return self.begin + timedelta(seconds=seconds) if abs(seconds) < _LONGEST_RUN else self.begin

    def within(self, since: datetime, until: datetime) -> Selection:
        """Records of this run in a period."""
        start = number(self.row["started_at_s"])
        return Selection(
            run_id=self.run_id,
            from_s=start + (since - self.begin).total_seconds(),
            to_s=start + (until - self.begin).total_seconds(),
        )


@dataclass(frozen=True, slots=True)
class Span:
    """A stretch of time spent with one thing.

    Attributes:
        doing: A value of `Doing`, or `OFF`.
        begin, end: From, to.
        code, cause, remedy: Why, for holds and faults.
    """

    doing: str
    begin: datetime
    end: datetime
    code: str = ""
    cause: str = ""
    remedy: str = ""

    @property
    def seconds(self) -> float:
        """How long it took."""
        return (self.end - self.begin).total_seconds()


def runs_of(ledger: LedgerReader, now: datetime) -> list[Run]:
    """Every run, oldest first.

    Args:
        ledger: The ledger.
        now: The present: until then a real cell's run that has not ended goes on.
    """
    found = []
    for row in ledger.rows("runs"):
        run = Run(row, date(row["started_wall"]), now)
        last = row["ended_at_s"]
        if last is None:
            last = _last_heard_of(ledger, run)
        goes_on = row["end_reason"] is None and row["mode"] == "real"
        found.append(run if goes_on else replace(run, end=max(run.begin, run.at(last))))
    return found


def spans_of(ledger: LedgerReader, runs: Sequence[Run], since: datetime, until: datetime) -> list[Span]:
    """What the period was spent with, without gaps, oldest first; what was the same throughout is one span."""
    spans: list[Span] = []
    at = since
    for run in runs:
        if run.end <= since or run.begin >= until:
            continue
        begin, end = max(run.begin, at), min(run.end, until)
        if begin > at:
            spans.append(Span(OFF, at, begin))
        at = max(at, end)
        spans += _spans_within(ledger, run, begin, end)
    if until - at >= _SHORTEST:
        spans.append(Span(OFF, at, until))
    return _joined(spans)


def _spans_within(ledger: LedgerReader, run: Run, begin: datetime, end: datetime) -> Iterator[Span]:
    before = replace(run.within(run.begin, begin), kind=STATE)
    present = Span(str(Doing.STOPPED), begin, end)
    for row in ledger.rows("events", before, last=1):
        present = _span(row["details"], begin, end)
    ends = end == run.end
    for row in ledger.rows("events", replace(run.within(begin, end + ends * TICK), kind=STATE)):
        at = min(run.at(row["at_s"]), end)
        if at > present.begin:
            yield replace(present, end=at)
        present = _span(row["details"], at, end)
    # A fault that ended its run took no time, and is told all the same.
    if end > present.begin or (ends and present.code):
        yield present


def _span(details: Any, begin: datetime, end: datetime) -> Span:
    told = {name: str(details.get(name, "")) for name in ("doing", "code", "cause", "remedy")}
    known = told["doing"] if told["doing"] in set(Doing) else str(Doing.STOPPED)
    return Span(known, begin, end, told["code"], told["cause"], told["remedy"])


def _joined(spans: Sequence[Span]) -> list[Span]:
    joined: list[Span] = []
    for span in spans:
        last = joined[-1] if joined else None
        if last is not None and (last.doing, last.code, last.end) == (span.doing, span.code, span.begin):
            joined[-1] = replace(last, end=span.end)
        else:
            joined.append(span)
    return joined


def _last_heard_of(ledger: LedgerReader, run: Run) -> float:
    columns: dict[Table, str] = {"intents": "at_s", "outcomes": "finished_at_s", "events": "at_s"}
    last = [number(run.row["started_at_s"])]
    for table, column in columns.items():
        last += [number(row[column]) for row in ledger.rows(table, Selection(run_id=run.run_id), last=1)]
    return max(last)


def date(wall: object) -> datetime:
    """A date of the record; the beginning of the calendar when it is none."""
    try:
        found = datetime.fromisoformat(str(wall))
    except ValueError:
        return datetime.fromtimestamp(0, UTC)
    if found.year not in _YEARS:
        return datetime.fromtimestamp(0, UTC)
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)


def number(value: object) -> float:
    """A figure of the record; 0 where somebody has put something else."""
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else 0.0

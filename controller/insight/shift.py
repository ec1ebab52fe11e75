"""The figures of a shift, counted from the ledger alone: what was sorted, how fast, what kept the cell from it."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

from controller.domain import Result
from controller.insight.evaluation import bounds
from controller.insight.shift_time import OFF, TICK, Run, Span, date, number, runs_of, spans_of
from controller.insight.statistics import spread
from controller.ledger.events import EASED, OPERATOR, WARNING, Doing
from controller.ledger.selection import Selection
from controller.ledger.view import LedgerReader

SHIFT = timedelta(hours=8)
"""How far back a report looks that is not told otherwise."""

STEPS = tuple(timedelta(minutes=m) for m in (1, 2, 5, 10, 15, 30, 60, 120, 240, 480, 1440, 2880, 10080))
"""Widths of the columns of parts over time."""
_MOST_COLUMNS = 32

_DONE = (str(Result.PLACED), str(Result.REJECTED))
_LOST = (Doing.HELD, Doing.FAULT)
_CHANGES = {
    "software_version": "software",
    "config_hash": "configuration",
    "calibration_id": "calibration",
    "arm": "arm",
}


def figures(
    ledger: LedgerReader,
    names: Mapping[str, str],
    now: datetime,
    since: datetime | None = None,
    until: datetime | None = None,
) -> dict[str, Any]:
    """Everything a shift report tells.

    Args:
        ledger: The ledger.
        names: Of every code of the fault catalogue.
        now: The present, with a time zone: dates are told in it.
        since: Beginning of the period; `SHIFT` before its end when left out.
        until: End of the period; when the cell was last heard of, when left out.

    Returns:
        JSON; times in s, dates as ISO 8601.
    """
    runs = runs_of(ledger, now)
    until = until or max((run.end for run in runs), default=now) + TICK
    since = since or until - SHIFT
    # What lies before the first record is not known to be downtime.
    first = min((run.begin for run in runs), default=since)
    begin = min(max(since, first), until)
    spans = spans_of(ledger, runs, begin, until)
    inside = [run for run in runs if run.end > begin and run.begin < until]
    outcomes = [
        (run.at(row["finished_at_s"]), row)
        for run in inside
        for row in ledger.rows("outcomes", run.within(begin, until))
    ]
    outcomes.sort(key=lambda pair: pair[0])
    rows = [row for _, row in outcomes]
    results = Counter(str(row["result"]) for row in rows)
    done = [at for at, row in outcomes if row["result"] in _DONE]
    seconds = _times(spans)
    lost = sum(seconds[doing] for doing in _LOST)
    ready = seconds[Doing.SORTING] + seconds[Doing.WAITING]
    first_try = sum(row["attempts"] == 1 for row in rows if row["result"] in _DONE)
    return {
        "ledger": str(ledger.path),
        "since": begin.astimezone(now.tzinfo).isoformat(timespec="seconds"),
        "until": until.astimezone(now.tzinfo).isoformat(timespec="seconds"),
        "hours": round((until - begin).total_seconds() / 3600.0, 4),
        "mode": ", ".join(sorted({str(run.row["mode"]) for run in inside})),
        "arm": ", ".join(sorted({str(run.row["arm"]) for run in inside})),
        "targets": len(rows),
        "results": {str(result): results[str(result)] for result in Result},
        "attempts": int(sum(number(row["attempts"]) for row in rows)),
        "success": bounds(len(done), len(rows)),
        "first_try": bounds(first_try, len(rows)),
        "parts_per_hour": {
            "period": _rate(len(done), (until - begin).total_seconds()),
            "while_sorting": _rate(len(done), seconds[Doing.SORTING]),
        },
        "cycle_s": spread(_cycles(done, spans), ("median", "p95", "max")),
        "cycles": [round(cycle, 3) for cycle in _cycles(done, spans)],
        "time_s": {name: round(value, 1) for name, value in seconds.items()},
        "availability": round(ready / (ready + lost), 5) if ready + lost > 0 else None,
        "downtime": _downtime(spans, names),
        "bins": _by(rows, "bin"),
        "classes": _classes(rows),
        "columns": _columns(outcomes, begin, until, now),
        "spans": [
            {"doing": span.doing, "code": span.code, "begin_s": round((span.begin - begin).total_seconds(), 1),
             "end_s": round((span.end - begin).total_seconds(), 1)}
            for span in spans
        ],
        "alarms": sorted(
            [*_alarms(spans, names, now), *_warnings(ledger, inside, names, begin, until, now)],
            key=lambda alarm: str(alarm["at"]),
        ),
        "changes": _changes(ledger, runs, begin, until, now),
        "operators": _operators(ledger, inside, begin, until, now),
        "counted_by_day": _counted_by_day(ledger, since, until),
    }  # fmt: skip


def _times(spans: Sequence[Span]) -> dict[str, float]:
    seconds = dict.fromkeys([*map(str, Doing), OFF], 0.0)
    for span in spans:
        seconds[span.doing] += span.seconds
    return seconds


def _rate(parts: int, seconds: float) -> float | None:
    return round(3600.0 * parts / seconds, 1) if seconds > 0 else None


def _cycles(done: Sequence[datetime], spans: Sequence[Span]) -> list[float]:
    """From one part in its bin to the next, s, as long as nothing but sorting happened in between."""
    begins = [span.begin for span in spans]
    at_work = [bisect_right(begins, at) - 1 for at in done]
    return [
        (there - here).total_seconds()
        for here, there, span, next_span in zip(done, done[1:], at_work, at_work[1:], strict=False)
        if span == next_span and spans[span].doing == Doing.SORTING
    ]


def _downtime(spans: Sequence[Span], names: Mapping[str, str]) -> list[dict[str, Any]]:
    """What the cell did not sort for, the longest first; that nothing lay on the table is not the cell's."""
    causes: dict[tuple[str, str], list[float]] = defaultdict(list)
    for span in spans:
        if span.doing not in (Doing.SORTING, Doing.WAITING):
            causes[span.doing, span.code].append(span.seconds)
    lines = [
        {
            "code": code or doing,
            "name": _name(code or doing, names),
            "unplanned": doing in _LOST,
            "times": len(lasted),
            "seconds": round(sum(lasted), 1),
        }
        for (doing, code), lasted in causes.items()
    ]
    return sorted(lines, key=lambda line: -float(line["seconds"]))


def _name(code: str, names: Mapping[str, str]) -> str:
    own = {str(Doing.STOPPED): "stopped, waiting for start", OFF: "the program did not run"}
    return own.get(code) or names.get(code, code)


def _by(rows: Sequence[Mapping[str, Any]], column: str) -> dict[str, dict[str, int]]:
    """Parts put down, by a column and class, the most frequent first."""
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for row in rows:
        if row["result"] in _DONE:
            table[str(row[column] or "none")][str(row["label"])] += 1
    return {key: dict(table[key].most_common()) for key in sorted(table, key=lambda key: -table[key].total())}


def _classes(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for row in rows:
        table[str(row["label"])][str(row["result"])] += 1
    return {label: dict(table[label]) for label in sorted(table)}


def _columns(
    outcomes: Sequence[tuple[datetime, Mapping[str, Any]]], begin: datetime, until: datetime, now: datetime
) -> dict[str, Any]:
    """Parts over time: placed, rejected and all others, in columns that begin at round times of day."""
    step = next((step for step in STEPS if (until - begin) / step <= _MOST_COLUMNS), STEPS[-1])
    local = begin.astimezone(now.tzinfo)
    midnight = local.replace(hour=0, minute=0, second=0, microsecond=0)
    at = midnight + (local - midnight) // step * step
    starts: list[datetime] = []
    while at < until and len(starts) <= 10 * _MOST_COLUMNS:
        starts.append(at)
        at += step
    counts = [Counter[str]() for _ in starts]
    for when, row in outcomes:
        result = str(row["result"])
        counts[max(bisect_right(starts, when) - 1, 0)][result if result in _DONE else "other"] += 1
    kinds = (*_DONE, "other")
    # The first and the last column may reach beyond the period.
    covered = [(min(start + step, until) - max(start, begin)).total_seconds() for start in starts]
    return {
        "step_s": step.total_seconds(),
        "covered_s": [round(seconds, 3) for seconds in covered],
        "starts": [start.isoformat(timespec="minutes") for start in starts],
        **{kind: [count[kind] for count in counts] for kind in kinds},
    }


def _alarms(spans: Sequence[Span], names: Mapping[str, str], now: datetime) -> list[dict[str, Any]]:
    return [
        {
            "at": span.begin.astimezone(now.tzinfo).isoformat(timespec="seconds"),
            "code": span.code,
            "name": _name(span.code, names),
            "cause": span.cause,
            "remedy": span.remedy,
            "doing": span.doing,
            "lasted_s": round(span.seconds, 1),
        }
        for span in spans
        if span.doing in _LOST
    ]


def _warnings(
    ledger: LedgerReader, runs: Sequence[Run], names: Mapping[str, str], begin: datetime, until: datetime, now: datetime
) -> list[dict[str, Any]]:
    """What was not in order although the cell went on, each until it was over or the run was."""
    lines: list[dict[str, Any]] = []
    for run in runs:
        open_: dict[str, tuple[dict[str, Any], datetime]] = {}
        for row in ledger.rows("events", run.within(begin, until)):
            at, told = run.at(row["at_s"]), row["details"]
            code = str(told.get("code", ""))
            if row["kind"] == WARNING and code not in open_:
                line = {
                    "at": at.astimezone(now.tzinfo).isoformat(timespec="seconds"),
                    "code": code,
                    "name": _name(code, names),
                    "cause": str(told.get("cause", "")),
                    "remedy": str(told.get("remedy", "")),
                    "doing": WARNING,
                    "lasted_s": round((min(run.end, until) - at).total_seconds(), 1),
                }
                lines.append(line)
                open_[code] = line, at
            elif row["kind"] == EASED and code in open_:
                line, since = open_.pop(code)
                line["lasted_s"] = round((at - since).total_seconds(), 1)
    return lines


def _changes(
    ledger: LedgerReader, runs: Sequence[Run], begin: datetime, until: datetime, now: datetime
) -> list[dict[str, Any]]:
    """Starts of the program, what had changed since the one before, and what the record tells of itself."""
    lines: list[tuple[datetime, str]] = []
    before: Run | None = None
    for run in runs:
        if begin <= run.begin < until:
            differing = [
                f"{name} {run.row[column] or '-'}"
                for column, name in _CHANGES.items()
                if before is None or run.row[column] != before.row[column]
            ]
            cut_off = before is not None and before.row["end_reason"] == "unclean"
            text = f"run {run.run_id} began"
            text += f"; {', '.join(differing)}" if differing else "; nothing had changed"
            lines.append((run.begin, text + ("; the run before was cut off" if cut_off else "")))
        before = run
    kinds = {
        "ledger_damaged": "the record was damaged and a new one begun",
        "classes": "taught classes",
        "model": "trained model",
        "configuration": "the configuration was read again",
        "clock_jumped": "the computer's date has jumped",
    }
    for kind, text in kinds.items():
        for row in ledger.rows("events", Selection(since=begin, until=until, kind=kind)):
            told = ", ".join(f"{key} {value}" for key, value in row["details"].items())
            lines.append((date(row["wall"]), f"{text}: {told}"))
    return [
        {"at": at.astimezone(now.tzinfo).isoformat(timespec="seconds"), "what": text}
        for at, text in sorted(lines, key=lambda line: line[0])
    ]


def _operators(
    ledger: LedgerReader, runs: Sequence[Run], begin: datetime, until: datetime, now: datetime
) -> list[dict[str, Any]]:
    lines = []
    for run in runs:
        for row in ledger.rows("events", run.within(begin, until)):
            if row["kind"] == OPERATOR:
                at = run.at(row["at_s"]).astimezone(now.tzinfo).isoformat(timespec="seconds")
                told = row["details"]
                lines.append({"at": at, "command": str(told.get("command", "")), "uid": told.get("uid")})
    return lines


def _counted_by_day(ledger: LedgerReader, since: datetime, until: datetime) -> dict[str, int]:
    """Targets by result on days of the period whose single records are gone."""
    counts: Counter[str] = Counter()
    for row in ledger.rows("days", Selection(since=since, until=until)):
        counts[str(row["result"])] += int(number(row["targets"]))
    return dict(counts)

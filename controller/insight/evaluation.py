"""Many simulated runs put together: totals, rates with their confidence, errors, confusion, where time goes."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from controller.insight.statistics import spread
from controller.insight.trial import Record

TOTALS = (
    "parts",
    "reachable",
    "sorted",
    "correct",
    "missorted",
    "silent",
    "rejected",
    "left",
    "dropped",
    "indeterminate",
    "phantoms",
    "collisions",
    "attempts",
    "nudges",
    "first_try",
)
"""Figures of single runs that are added up."""

_CONFIDENCE = 1.959964
"""Standard normal quantile of 97.5 %: bounds hold with 95 % confidence."""


def bounds(hits: int, trials: int) -> dict[str, float | None]:
    """A rate with its 95 % confidence bounds, rounded to 1e-5; None without a trial.

    Source: Wilson (1927), the score interval, which keeps its meaning at rates of 0 and 1.
    """
    if trials == 0:
        return {"value": None, "low": None, "high": None}
    rate, z2 = hits / trials, _CONFIDENCE**2
    middle = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    half = _CONFIDENCE / (1 + z2 / trials) * math.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials**2))
    low, high = max(0.0, middle - half), min(1.0, middle + half)
    return {"value": round(rate, 5), "low": round(low, 5), "high": round(high, 5)}


def summary(head: Mapping[str, Any], records: Sequence[Record]) -> dict[str, Any]:
    """The figures of an evaluation.

    Args:
        head: What was run: level, arm, seeds.
        records: One for each run, of `Trial.record`; a run that could not begin has only `seed` and `error`.

    Returns:
        JSON; lengths mm, angles degrees, times s.
    """
    runs = [record for record in records if "figures" in record]
    broken = [{"seed": r["seed"], "error": r["error"]} for r in records if r.get("error")]
    total = {key: sum(int(run["figures"].get(key) or 0) for run in runs) for key in TOTALS}
    seen = [item for run in runs for item in run["seen"]]
    outcomes = [outcome for run in runs for outcome in run["outcomes"]]
    alike = [item for item in seen if item["true"] == item["seen"]]
    angles = [abs(item["angle_deg"]) for item in seen if item["angle_deg"] is not None]
    cycles = [duration for run in runs for duration in cycle_durations(run["spans"])]
    times = ("sim_s", "wall_s", "calibration_s")
    work = {key: sum(float(run["figures"].get(key) or 0.0) for run in runs) for key in times}
    processor = sum(float(run.get("cpu_s", 0.0)) for run in runs)
    return {
        **head,
        "runs": len(records),
        "broken_runs": broken,
        **total,
        "rates": {
            "correct of reachable": bounds(min(total["correct"], total["reachable"]), total["reachable"]),
            "sorted at the first try, of tried": bounds(total["first_try"], len(outcomes)),
            "missorted of sorted": bounds(total["missorted"], total["sorted"]),
            "silent of sorted": bounds(total["silent"], total["sorted"]),
            "named rightly, of located": bounds(len(alike), len(seen)),
        },
        "looks": {
            "located": len(seen),
            "missed": sum(len(run["missed"]) for run in runs),
            "false": sum(run["false"] for run in runs),
            "refused": sum(len(run["refused"]) for run in runs),
        },
        "localization_error_mm": spread([math.hypot(i["dx"], i["dy"]) for i in seen], ("mean", "median", "p95", "max")),
        "orientation_error_deg": spread(angles, ("mean", "median", "p95", "max")),
        "size_error_mm": spread([item["size_mm"] for item in alike], ("mean", "median", "p95", "max")),
        "confusion": confusion((item["true"], item["seen"]) for item in seen),
        "destinations": confusion((outcome["true"] or "nothing", _end(outcome)) for outcome in outcomes),
        "results": dict(Counter(outcome["verdict"] for outcome in outcomes).most_common()),
        "cycle_s": spread(cycles, ("mean", "median", "p95", "max")),
        "breakdown_s": breakdown([run["spans"] for run in runs]),
        "sim_s": round(work["sim_s"], 2),
        "wall_s": round(work["wall_s"], 2),
        "cpu_s": round(processor, 2),
        # Calibration is part of a run's processor time, so its simulated time counts as well.
        "times_real_time": round((work["sim_s"] + work["calibration_s"]) / processor, 2) if processor else None,
        "failures": sum(len(run["failures"]) for run in runs),
    }


def _end(outcome: Record) -> str:
    """Where a target ended: the bin it was put into, or what became of it."""
    return str(outcome["bin"] if outcome["result"] in ("placed", "rejected") else outcome["result"])


def confusion(pairs: Iterable[tuple[str, str]]) -> dict[str, dict[str, int]]:
    """How often the first of a pair came with the second; rows and columns sorted."""
    table: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for true, seen in pairs:
        table[true][seen] += 1
    return {true: dict(sorted(row.items())) for true, row in sorted(table.items())}


# --- where the time of a cycle goes -----------------------------------------------------------------------


def cycles_of(spans: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
    """(begin, end) of every cycle that took a part to a bin: from one CAPTURE to the next, through PLACE."""
    found: list[tuple[float, float]] = []
    begin: float | None = None
    placed = False
    for span in spans:
        if span["lane"] != "state":
            continue
        if span["name"] in ("CAPTURE", "IDLE"):
            if begin is not None and placed:
                found.append((begin, span["begin"]))
            begin, placed = (span["begin"] if span["name"] == "CAPTURE" else None), False
        placed = placed or span["name"] == "PLACE"
    return found


def cycle_durations(spans: Sequence[Mapping[str, Any]]) -> list[float]:
    """How long each of `cycles_of` took, s."""
    return [end - begin for begin, end in cycles_of(spans)]


def within(spans: Sequence[Mapping[str, Any]], begin: float, end: float) -> list[dict[str, Any]]:
    """The spans of a cycle, with times from its begin."""
    return [
        {**span, "begin": span["begin"] - begin, "end": span["end"] - begin}
        for span in spans
        if span["begin"] >= begin - 1e-9 and span["end"] <= end + 1e-9
    ]


def breakdown(runs: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, dict[str, float]]:
    """Mean time a cycle spends on each thing, s, by lane."""
    total: defaultdict[str, Counter[str]] = defaultdict(Counter)
    count = 0
    for spans in runs:
        for begin, end in cycles_of(spans):
            count += 1
            for span in within(spans, begin, end):
                total[span["lane"]][span["name"]] += span["end"] - span["begin"]
    return {lane: {name: round(time / count, 4) for name, time in names.items()} for lane, names in total.items()}


def median_cycle(records: Sequence[Record]) -> tuple[int, list[dict[str, Any]]] | None:
    """Seed and spans of the cycle of median duration of all runs, or None without a cycle."""
    cycles = sorted(
        (end - begin, record["seed"], begin, end, number)
        for number, record in enumerate(records)
        for begin, end in cycles_of(record.get("spans", ()))
    )
    if not cycles:
        return None
    _, seed, begin, end, number = cycles[len(cycles) // 2]
    return seed, within(records[number]["spans"], begin, end)

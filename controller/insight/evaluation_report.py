"""The report of an evaluation: one HTML file that needs nothing else."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

from controller.config.cell import CellConfig
from controller.insight.charts import error_map, gantt, histogram, matrix
from controller.insight.evaluation import cycle_durations, median_cycle
from controller.insight.page import head, table, text
from controller.insight.report import FATES
from controller.insight.trial import Record

MOST_FAILURES = 60
"""Failures shown with pictures; the rest is in the JSON beside the report."""

_NAMES = {
    "runs": "tables",
    "parts": "parts on them",
    "reachable": "of them within reach",
    **FATES,
    "phantoms": "attempts at what was no part",
    "collisions": "touches of what should not be touched",
    "attempts": "attempts",
    "nudges": "pushes to make room for the jaws",
    "first_try": "sorted at the first attempt",
    "localization_error_mm": "error of the located centre, mm",
    "orientation_error_deg": "error of the orientation modulo the symmetry, degrees",
    "size_error_mm": "error of the sides, mm",
    "cycle_s": "cycle time, s",
    "sim_s": "sorting, s of the cells' clocks",
    "wall_s": "sorting, s of the wall clock",
    "cpu_s": "the whole runs, s of processor time",
    "times_real_time": "simulated seconds, calibration included, for one of processor time",
}
_BAD = ("missorted", "silent", "dropped", "indeterminate", "phantoms", "collisions")


def rows(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures of an evaluation as (name, value), in words a person reads."""
    lines = [(name, text(figures[key])) for key, name in _NAMES.items() if figures.get(key) is not None]
    lines += [(name, _rate(rate)) for name, rate in figures.get("rates", {}).items()]
    looks = figures.get("looks", {})
    lines += [(f"objects {name}, over all looks", text(count)) for name, count in looks.items()]
    return lines


def comparison(new: Mapping[str, Any], old: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """(name, old, new) of everything two evaluations tell, where it differs."""
    lines = []
    for key in dict.fromkeys([*old, *new]):
        if key in ("wall_s", "cpu_s", "confusion", "destinations", "breakdown_s", "broken_runs"):
            continue
        before, after = old.get(key), new.get(key)
        if key == "rates":
            before, after = before or {}, after or {}
            names = dict.fromkeys([*before, *after])
            pairs = [(name, _rate(before.get(name)), _rate(after.get(name))) for name in names]
        else:
            pairs = [(_NAMES.get(key, key), text(before), text(after))]
        lines += [pair for pair in pairs if pair[1] != pair[2]]
    return lines


def page(
    figures: Mapping[str, Any], records: Sequence[Record], config: CellConfig, old: Mapping[str, Any] | None = None
) -> str:
    """A self-contained HTML page.

    Args:
        figures: Of `evaluation.summary`.
        records: The runs, with their seeds.
        config: Of the cell.
        old: Figures of another evaluation, to compare with.
    """
    title = f"Evaluation in simulation: {figures.get('arm', '')}, level {figures.get('level', '')}"
    lines = [head(title)]
    first, last = min(r["seed"] for r in records), max(r["seed"] for r in records)
    lines.append(f"<p>Seeds {first} to {last}; made again by <code>{html.escape(command(figures))}</code></p>")
    lines.append(table(rows(figures), {name for key, name in _NAMES.items() if key in _BAD and figures.get(key)}))
    lines += [f'<p class="bad">seed {r["seed"]}: {html.escape(r["error"])}</p>' for r in figures["broken_runs"]]
    if old is not None:
        lines.append("<h2>Compared</h2><table><tr><th></th><th>before</th><th>now</th></tr>")
        lines += [
            f"<tr><td>{html.escape(a)}</td><td>{html.escape(b)}</td><td>{html.escape(c)}</td></tr>"
            for a, b, c in comparison(figures, old)
        ]
        lines.append("</table>")
    lines.append("<h2>Where it looked wrong</h2>")
    seen = [item for record in records for item in record.get("seen", ())]
    outline = [(float(x), float(y)) for x, y in config.work_area_outline(config.table.T_base_table())]
    points = [(item["x"], item["y"], item["dx"], item["dy"]) for item in seen]
    lines.append(error_map(points, outline, "Error of the located centre over the table"))
    errors = [math.hypot(item["dx"], item["dy"]) for item in seen]
    lines.append(histogram(errors, "Error of the located centre", "mm"))
    lines.append(matrix(figures["confusion"], "What was seen, all looks", "true \\ seen"))
    lines.append("<h2>What became of the parts</h2>")
    lines.append(matrix(figures["destinations"], "Where targets ended", "true \\ end", diagonal=False))
    lines.append(table([(name, str(count)) for name, count in figures["results"].items()]))
    lines.append("<h2>Where the time goes</h2>")
    durations = [d for record in records for d in cycle_durations(record.get("spans", ()))]
    lines.append(histogram(durations, "Cycle time", "s"))
    cycle = median_cycle(records)
    if cycle is not None:
        seed, spans = cycle
        lanes = ("state", "camera", "computing", "arm", "gripper")
        bars = {lane: [(s["name"], s["begin"], s["end"]) for s in spans if s["lane"] == lane] for lane in lanes}
        lines.append(gantt(bars, f"A cycle of median length, seed {seed}"))
    for lane, times in figures["breakdown_s"].items():
        lines.append(f"<h3>{html.escape(lane)}, mean of a cycle</h3>")
        lines.append(table([(name, f"{time:.3f} s") for name, time in times.items()]))
    lines += _failures(figures, records)
    return "\n".join(lines) + "</html>\n"


def _failures(figures: Mapping[str, Any], records: Sequence[Record]) -> list[str]:
    found = [(record["seed"], failure) for record in records for failure in record.get("failures", ())]
    lines = [f"<h2>What went wrong: {len(found)}</h2>"]
    if len(found) > MOST_FAILURES:
        lines.append(f"<p>The first {MOST_FAILURES}; the others are in the JSON beside this page.</p>")
    for seed, failure in found[:MOST_FAILURES]:
        what = f"{failure['kind']}, seed {seed}, at {failure['at_s']} s: {failure['text']}"
        lines.append(f'<div class="failure"><p class="bad">{html.escape(what)}<br>')
        lines.append(f"<code>{html.escape(replay(figures, seed))}</code></p>")
        lines += [
            f'<img alt="{when}" title="{when}" src="data:image/jpeg;base64,{failure[when]}">'
            for when in ("before", "after")
            if when in failure
        ]
        lines.append("</div>")
    return lines


def command(figures: Mapping[str, Any]) -> str:
    """The command line that makes these figures again."""
    return (
        f"controller evaluate --sim --seeds {figures['seeds']} --parts {figures['parts_per_table']} "
        f"--level {figures['level']}{'' if figures.get('pick_proof', True) else ' --no-pick-proof'}{_extra(figures)}"
    )


def replay(figures: Mapping[str, Any], seed: int) -> str:
    """The command line that runs one of the tables again."""
    return (
        f"controller run --sim --level {figures['level']} --parts {figures['parts_per_table']} --seed {seed}"
        f"{_extra(figures)}"
    )


def _extra(figures: Mapping[str, Any]) -> str:
    config = f" --config {figures['config']}" if figures.get("config") else ""
    config += f" --disturb '{figures['disturb']}'" if figures.get("disturb") else ""
    return config + (f" --arm {figures['arm']}" if figures.get("arm_given") else "")


def _rate(rate: Mapping[str, float | None] | None) -> str:
    if rate is None or rate["value"] is None or rate["low"] is None or rate["high"] is None:
        return "-"
    return f"{100 * rate['value']:.2f} % ({100 * rate['low']:.2f} to {100 * rate['high']:.2f} % with 95 % confidence)"

"""The report of an evaluation: one HTML file that needs nothing else."""

from __future__ import annotations

import html
import math
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from controller.config.cell import CellConfig
from controller.insight import comparison
from controller.insight.charts import error_map, gantt, histogram, matrix
from controller.insight.comparison import Evaluation
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


def page(evaluation: Evaluation, config: CellConfig, before: Evaluation | None = None, before_name: str = "") -> str:
    """A self-contained HTML page.

    Args:
        evaluation: Its figures and its runs.
        config: Of the cell.
        before: Another evaluation, to compare with.
        before_name: Its file.
    """
    figures, records = evaluation.figures, evaluation.records
    lines = [head(f"Evaluation in simulation: {figures.get('arm', '')}, level {figures.get('level', '')}")]
    lines.append(f"<p>Seeds {figures['seeds']}; made again by <code>{html.escape(command(figures))}</code></p>")
    lines.append(table(rows(figures), {name for key, name in _NAMES.items() if key in _BAD and figures.get(key)}))
    lines += [f'<p class="bad">seed {r["seed"]}: {html.escape(r["error"])}</p>' for r in figures["broken_runs"]]
    if before is not None:
        lines += _compared(evaluation, before, before_name)
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


def _compared(now: Evaluation, before: Evaluation, name: str) -> list[str]:
    changed = comparison.settings(now, before)
    return [
        f"<h2>Compared with {html.escape(name)}</h2>",
        f"<p>That was <code>{html.escape(command(before.figures))}</code></p>",
        table(changed, heading=comparison.SETTINGS_HEADING) if changed else "<p>Both were set alike.</p>",
        table([d.row() for d in comparison.differences(now, before)], heading=comparison.DIFFERENCES_HEADING),
        f"<p>{comparison.HOW_JUDGED}</p>",
    ]


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
    seeds = figures["seeds"].split()  # one by one when it was cut off: the whole range goes on from there
    return _evaluate(figures, seeds[0] if len(seeds) == 1 else f"{seeds[0]}-{seeds[-1]}")


def replay(figures: Mapping[str, Any], seed: int) -> str:
    """The command line that runs one of the tables again."""
    if not figures.get("pick_proof", True):  # which `controller run` never leaves out
        return _evaluate(figures, str(seed))
    return f"controller run --sim --seed {seed}{_setting(figures)}"


def _evaluate(figures: Mapping[str, Any], seeds: str) -> str:
    proof = "" if figures.get("pick_proof", True) else " --no-pick-proof"
    return f"controller evaluate --sim --seeds {seeds}{_setting(figures)}{proof}"


def _setting(figures: Mapping[str, Any]) -> str:
    given = {
        "--parts": figures["parts_per_table"],
        "--level": figures["level"],
        "--config": figures.get("config"),
        "--classes": figures.get("classes"),
        "--disturb": figures.get("disturb"),
        "--arm": figures["arm"] if figures.get("arm_given") else None,
    }
    return "".join(f" {option} {shlex.quote(str(value))}" for option, value in given.items() if value)


def _rate(rate: Mapping[str, float | None] | None) -> str:
    if rate is None or rate["value"] is None or rate["low"] is None or rate["high"] is None:
        return "-"
    return f"{100 * rate['value']:.2f} % ({100 * rate['low']:.2f} to {100 * rate['high']:.2f} % with 95 % confidence)"

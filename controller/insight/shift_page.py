"""The shift report as a page: one HTML file that needs nothing else."""

from __future__ import annotations

import html
import shlex
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

from controller.insight.charts import histogram
from controller.insight.page import head, table
from controller.insight.shift import STEPS
from controller.insight.shift_charts import BLUE, GRAY, GREEN, ORANGE, RED, WIDTH, YELLOW, bars, columns, legend, strip

_STYLE = """
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(9.5rem,1fr));gap:.8rem;margin:1.2rem 0}
.tiles div,.charts>div{background:var(--card);border-radius:8px;padding:.7rem .9rem}
.tiles b{display:block;font-size:1.5rem;font-variant-numeric:tabular-nums;line-height:1.25}
.tiles span,.legend,.sub{color:var(--soft);font-size:.9rem}
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(26rem,100%),1fr));gap:.8rem;margin:.8rem 0}
.charts svg{margin:.2rem 0;width:100%}
.strip svg{width:100%;height:44px;margin:0;background:var(--card);border-radius:4px}
.strip div{position:relative;height:1.6rem;font-size:.8rem}
.strip span{position:absolute;transform:translateX(-50%)}.strip span:first-child{transform:none}
.legend{margin:.2rem 0}.legend span{margin-right:1rem;white-space:nowrap}
.legend i{display:inline-block;width:.8em;height:.8em;border-radius:2px;margin-right:.35em;
box-shadow:0 0 0 1px var(--line)}
@media(max-width:40rem){body{margin:1rem auto}.legend span{display:inline-block}}
"""
_RESULTS = {"placed": GREEN, "rejected": BLUE, "other": RED}
_DOINGS = {"sorting": GREEN, "waiting": BLUE, "held": ORANGE, "fault": RED, "paused": YELLOW, "stopped": GRAY}
_MARKS = (*STEPS, timedelta(days=30), timedelta(days=90))
_MOST_LINES = 200
"""Lines of a table; the ledger has them all."""


def page(figures: Mapping[str, Any]) -> str:
    """A self-contained page.

    Args:
        figures: Of `controller.insight.shift.figures`.
    """
    since, until = (datetime.fromisoformat(figures[key]) for key in ("since", "until"))
    day = since.strftime("%d %B %Y").lstrip("0")
    period = f"{since:%H:%M} to {until:%H:%M}" if since.date() == until.date() else f"to {until:%d %B %Y, %H:%M}"
    where = ", ".join(filter(None, (figures["arm"], "simulated time" if "sim" in figures["mode"] else "")))
    lines = [
        head(f"Shift report, {day}", _STYLE),
        f'<p class="sub">{period} ({_long(figures["hours"] * 3600)}){f"; {html.escape(where)}" if where else ""}</p>',
        _tiles(figures),
        _timeline(figures, since),
        f'<div class="charts">{"".join(f"<div>{chart}</div>" for chart in _charts(figures))}</div>',
        "<h2>Alarms</h2>",
        _listing(
            [(_when(a["at"]), a["name"], _long(a["lasted_s"]), a["cause"], a["remedy"]) for a in figures["alarms"]],
            ("when", "alarm", "lasted", "cause", "remedy"),
            "none",
        ),
        "<h2>What became of the parts</h2>",
        _results(figures),
        "<h2>Starts and changes</h2>",
        _listing([(_when(c["at"]), c["what"]) for c in figures["changes"]], ("when", "what"), "none"),
        "<h2>Operators</h2>",
        _listing(
            [(_when(o["at"]), o["command"], _user(o["uid"])) for o in figures["operators"]],
            ("when", "command", "user"),
            "no commands",
        ),
        f'<p class="sub">From {html.escape(figures["ledger"])}; every figure is counted from its records: '
        f"<code>{html.escape(_export(figures['ledger'], since, until))}</code></p>",
    ]
    return "\n".join(lines) + "</html>\n"


def _export(ledger: str, since: datetime, until: datetime) -> str:
    """The command that shows the records themselves; dates are written to the second, the last one rounded up."""
    begin, end = (f"{moment:%Y-%m-%dT%H:%M:%S}" for moment in (since, until + timedelta(seconds=1)))
    return f"controller ledger export {shlex.quote(ledger)} --since {begin} --until {end}"


def _tiles(figures: Mapping[str, Any]) -> str:
    rate, cycle = figures["parts_per_hour"], figures["cycle_s"]
    done = figures["results"]["placed"] + figures["results"]["rejected"]
    tiles = [
        (str(done), f"of {figures['targets']} parts in a bin"),
        (_figure(rate["period"]), f"parts an hour; {_figure(rate['while_sorting'])} while sorting"),
        (_percent(figures["success"]["value"]), f"success; {_percent(figures['first_try']['value'])} at the first try"),
        (f"{_figure(cycle['median'])} s", f"from part to part; 95 % below {_figure(cycle['p95'])} s"),
        (_percent(figures["availability"]), "of the time it was to sort, it could"),
        (str(len(figures["alarms"])), "alarms" if len(figures["alarms"]) != 1 else "alarm"),
    ]
    return '<div class="tiles">' + "".join(f"<div><b>{a}</b><span>{b}</span></div>" for a, b in tiles) + "</div>"


def _timeline(figures: Mapping[str, Any], since: datetime) -> str:
    spans = [
        (s["doing"], s["begin_s"], s["end_s"], f"{s['code'] or s['doing']}: {_long(s['end_s'] - s['begin_s'])}")
        for s in figures["spans"]
    ]
    end = max((span[2] for span in spans), default=0.0)
    step = next((mark for mark in _MARKS if end / mark.total_seconds() <= 6), _MARKS[-1])
    midnight = since.replace(hour=0, minute=0, second=0, microsecond=0)
    first = midnight + -((midnight - since) // step) * step
    marks = []
    while (first - since).total_seconds() <= end:
        text = f"{first:%d %b}" if step >= timedelta(days=1) else f"{first:%H:%M}"
        marks.append(((first - since).total_seconds(), text))
        first += step
    time = figures["time_s"]
    shares = {f"{name} {_long(time[name])}": colour for name, colour in _DOINGS.items() if time[name] > 0}
    if time["off"] > 0:
        shares[f"program off {_long(time['off'])}"] = "transparent"
    return strip(spans, marks, _DOINGS) + legend(shares)


def _charts(figures: Mapping[str, Any]) -> list[str]:
    over_time = figures["columns"]
    form = "%d %b" if over_time["step_s"] >= 86400 else "%H:%M"
    # A column of which the period has next to nothing shows no rate of thousands.
    hours = [max(seconds, over_time["step_s"] / 20.0) / 3600.0 for seconds in over_time["covered_s"]]
    labels = [datetime.fromisoformat(start).strftime(form) for start in over_time["starts"]]
    series = {
        kind: [round(count / length, 1) for count, length in zip(over_time[kind], hours, strict=True)]
        for kind in _RESULTS
    }
    downtime = figures["downtime"]
    total, so_far, pareto = sum(line["seconds"] for line in downtime), 0.0, []
    for line in downtime[:10]:
        so_far += line["seconds"]
        kind = "unplanned" if line["unplanned"] else "planned"
        share = f"{_long(line['seconds'])}, {line['times']} x; up to here {_percent(so_far / total if total else None)}"
        pareto.append((line["name"], {kind: line["seconds"]}, share))
    bins = [
        (name, {"parts": sum(counts.values())}, _shortened([f"{count} {label}" for label, count in counts.items()]))
        for name, counts in figures["bins"].items()
    ]
    return [
        columns(labels, series, _RESULTS, "Parts per hour") + legend(_RESULTS),
        bars(bins, {"parts": GREEN}, "Parts in each bin"),
        histogram(figures["cycles"], "Time from part to part", "s", bins=30, width=WIDTH),
        bars(pareto, {"unplanned": RED, "planned": GRAY}, "Downtime, the longest first"),
    ]


def _results(figures: Mapping[str, Any]) -> str:
    results = [name for name, count in figures["results"].items() if count]
    lines = [
        (label, *(str(counts.get(name, "") or "") for name in results), str(sum(counts.values())))
        for label, counts in figures["classes"].items()
    ]
    if len(lines) > 1:
        totals = [str(figures["results"][name]) for name in results]
        lines.append(("all", *totals, str(figures["targets"])))
    found = _listing(lines, ("class", *(name.replace("_", " ") for name in results), "in all"), "none")
    gone = figures["counted_by_day"]
    if gone:
        told = ", ".join(f"{count} {name}" for name, count in gone.items())
        found += f'<p class="sub">Further parts of this period are on record by day only: {html.escape(told)}.</p>'
    return found


def _listing(lines: Sequence[Sequence[str]], heading: Sequence[str], otherwise: str) -> str:
    if not lines:
        return f"<p>{otherwise}</p>"
    more = f"<p>and {len(lines) - _MOST_LINES} more</p>" if len(lines) > _MOST_LINES else ""
    return table(lines[:_MOST_LINES], heading=heading) + more


def _shortened(pieces: Sequence[str], most: int = 44) -> str:
    """As many as fit behind a bar."""
    shown = list(pieces)
    while len(", ".join(shown)) > most and len(shown) > 1:
        shown.pop()
    return ", ".join(shown) + (f", {len(pieces) - len(shown)} more" if len(shown) < len(pieces) else "")


def _user(uid: object) -> str:
    return "" if uid is None else f"user {uid}"


def _when(date: str) -> str:
    return datetime.fromisoformat(date).strftime("%d %b %H:%M:%S")


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"


def _long(seconds: float) -> str:
    """A length of time for people."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172800 else f"{seconds / 86400:.1f} d"

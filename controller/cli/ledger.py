"""`controller ledger`: look into the durable record, export it, prove that it adds up."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table as Grid
from rich.text import Text

from controller.cli.output import stdout
from controller.cli.period import SINCE_HELP, UNTIL_HELP, local, moment
from controller.domain import Result
from controller.errors import LedgerError
from controller.ledger.selection import Selection, Table
from controller.ledger.view import LedgerView, json_line
from controller.service.folders import folder_of_the_cell

group = typer.Typer(help="The durable record: look into it, export it, verify it.", no_args_is_help=True)


class Records(StrEnum):
    """The tables of the record."""

    OUTCOMES = "outcomes"
    """One line a part: what became of it."""
    INTENTS = "intents"
    """One line an attempt, written before the arm moved."""
    RUNS = "runs"
    """One line a start of the program: software, configuration, calibration."""
    EVENTS = "events"
    """Sorting, waiting, holds, faults, operators' commands."""
    DAYS = "days"
    """Counts of days whose single records are gone."""


File = Annotated[
    Path | None,
    typer.Argument(
        metavar="DB", show_default=False, help="A ledger, or the folder of a run (default: the cell's own)."
    ),
]
Of = Annotated[Records, typer.Option("--of", help="Which records.")]
Since = Annotated[str | None, typer.Option(metavar="DATE", help=SINCE_HELP)]
Until = Annotated[str | None, typer.Option(metavar="DATE", help=UNTIL_HELP)]
Class = Annotated[str | None, typer.Option("--class", metavar="NAME", help="Only parts of this class.")]
InBin = Annotated[str | None, typer.Option("--bin", metavar="NAME", help="Only parts for this bin.")]
Outcome = Annotated[Result | None, typer.Option("--outcome", help="Only parts that ended so.")]
Run = Annotated[int | None, typer.Option("--run", min=1, help="Only this run, by its number.")]
Kind = Annotated[str | None, typer.Option("--kind", metavar="NAME", help="Only events of this kind.")]


def ledger_file(given: Path | None) -> Path:
    """The ledger somebody means: a file, the one in a folder, or the cell's own."""
    path = given or folder_of_the_cell()
    return path / "ledger.db" if path.is_dir() or given is None else path


@group.command()
def show(
    db: File = None,
    of: Of = Records.OUTCOMES,
    since: Since = None,
    until: Until = None,
    class_: Class = None,
    bin_: InBin = None,
    outcome: Outcome = None,
    run: Run = None,
    kind: Kind = None,
    last: Annotated[int, typer.Option(min=1, help="Only so many of the newest.")] = 30,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a record on stdout.")] = False,
) -> None:
    """Show the newest records.

    Example: controller ledger show runs/20261122-061500 --outcome grasp_missed --since 8h
    """
    selection = _selection(of, since, until, class_, bin_, outcome, run, kind)
    with LedgerView(ledger_file(db)) as view:
        rows = list(view.rows(_name(of), selection, last))
        if as_json:
            for row in rows:
                print(json_line(row))
            return
        grid = Grid(*_SHOWN[of], box=None, pad_edge=False)
        for row in rows:
            grid.add_row(*(Text(text(row)) for text in _SHOWN[of].values()))
        console = stdout()
        console.print(grid if rows else "no such records")
        if of is Records.OUTCOMES and rows:
            counts = {name: number for name, number in view.counts().items() if number}
            console.print(f"in all {counts.pop('targets', 0)} targets: {_listed(counts)}")


@group.command()
def export(
    db: File = None,
    of: Of = Records.OUTCOMES,
    since: Since = None,
    until: Until = None,
    class_: Class = None,
    bin_: InBin = None,
    outcome: Outcome = None,
    run: Run = None,
    kind: Kind = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Into this file; .json or .jsonl means --json.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line instead of CSV.")] = False,
) -> None:
    """Export every record that is asked for, as CSV with a header or as JSON lines.

    Example: controller ledger export --since 2026-11-01 --out november.csv
    """
    selection = _selection(of, since, until, class_, bin_, outcome, run, kind)
    as_json = as_json or (out is not None and out.suffix in (".json", ".jsonl"))
    with LedgerView(ledger_file(db)) as view:
        lines = view.export("jsonl" if as_json else "csv", _name(of), selection)
        if out is None:
            for line in lines:
                sys.stdout.write(line + "\n")
            return
        try:
            with out.open("w", encoding="utf-8", newline="") as file:
                file.writelines(line + "\n" for line in lines)
        except OSError as error:
            raise LedgerError(f"{out}: {error.strerror or error}", "name a file that can be written") from error


@group.command()
def verify(
    db: File = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> int:
    """Prove that the file is sound and every target has one outcome; the exit code is 1 when it is not.

    Example: controller ledger verify --json
    """
    path = ledger_file(db)
    with LedgerView(path) as view:
        problems, counts, schema = view.verify(), view.counts(), view.schema
    if as_json:
        found = {"path": str(path), "sound": not problems, "problems": problems, "schema": schema, "counts": counts}
        print(json.dumps(found))
    else:
        for problem in problems:
            print(problem)
        targets = counts.pop("targets")
        listed = _listed({name: number for name, number in counts.items() if number})
        print(f"{path}: {'NOT SOUND' if problems else 'sound'}, {targets} targets{': ' if listed else ''}{listed}")
    return 1 if problems else 0


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.add_typer(group, name="ledger")


def _selection(
    of: Records,
    since: str | None,
    until: str | None,
    class_: str | None,
    bin_: str | None,
    outcome: Result | None,
    run: int | None,
    kind: str | None,
) -> Selection:
    now = datetime.now().astimezone()
    selection = Selection(
        moment(since, now), moment(until, now), run, class_, bin_, None if outcome is None else str(outcome), kind
    )
    try:
        selection.where(_name(of))
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    return selection


def _name(of: Records) -> Table:
    return of.value


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{number} {name}" for name, number in counts.items())


def _plain(name: str) -> Callable[[Mapping[str, Any]], str]:
    return lambda row: "" if row[name] is None else str(row[name])


def _date(name: str) -> Callable[[Mapping[str, Any]], str]:
    return lambda row: "" if row[name] is None else local(row[name])


def _place(row: Mapping[str, Any]) -> str:
    x, y = row["x_mm"], row["y_mm"]
    return f"{x:.1f}, {y:.1f}" if isinstance(x, float) and isinstance(y, float) else ""


def _told(row: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in row["details"].items())


# What a person sees of a record: heading, and how the text is made.
_SHOWN: Mapping[Records, Mapping[str, Callable[[Mapping[str, Any]], str]]] = {
    Records.OUTCOMES: {
        "when": _date("wall"), "run": _plain("run_id"), "target": _plain("target_id"), "class": _plain("label"),
        "at x, y mm": _place, "outcome": _plain("result"), "bin": _plain("bin"), "tries": _plain("attempts"),
        "why": _plain("reason"),
    },
    Records.INTENTS: {
        "when": _date("wall"), "run": _plain("run_id"), "target": _plain("target_id"), "try": _plain("attempt"),
        "class": _plain("label"), "at x, y mm": _place, "bin": _plain("bin"),
    },
    Records.RUNS: {
        "run": _plain("run_id"), "began": _date("started_wall"), "ended": _date("ended_wall"),
        "end": _plain("end_reason"), "mode": _plain("mode"), "arm": _plain("arm"),
        "software": _plain("software_version"), "configuration": _plain("config_hash"),
        "calibration": _plain("calibration_id"),
    },
    Records.EVENTS: {"when": _date("wall"), "run": _plain("run_id"), "kind": _plain("kind"), "what": _told},
    Records.DAYS: {name: _plain(name) for name in ("day", "mode", "label", "bin", "result", "targets", "attempts")},
}  # fmt: skip

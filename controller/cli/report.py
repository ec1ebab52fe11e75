"""`controller report`: what a shift was like, as one HTML file or as JSON."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from controller.cli.ledger import File, ledger_file
from controller.cli.output import stdout
from controller.cli.period import SINCE_HELP, UNTIL_HELP, moment
from controller.errors import LedgerError
from controller.insight.shift import figures
from controller.insight.shift_page import page
from controller.ledger.view import LedgerView
from controller.service.faults import CATALOGUE


def report(
    db: File = None,
    since: Annotated[
        str | None, typer.Option(metavar="DATE", help=f"{SINCE_HELP} Default: 8 h before the end.")
    ] = None,
    until: Annotated[
        str | None, typer.Option(metavar="DATE", help=f"{UNTIL_HELP} Default: when the cell was last heard of.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The HTML file (default: shift-DATE.html here).")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="The figures as one JSON object on stdout; HTML only with --out.")
    ] = False,
) -> None:
    """Report on a shift: parts per hour and bin, success, cycle times, downtime, alarms, changes.

    Example: controller report --since 2026-11-22T06:00 --until 2026-11-22T14:00 --out morning.html
    """
    now = datetime.now().astimezone()
    begin, end = moment(since, now), moment(until, now)
    if begin is not None and begin >= (end or now):
        raise typer.BadParameter("--since is not before --until")
    names = {code: fault.name for code, fault in CATALOGUE.items()}
    with LedgerView(ledger_file(db)) as view:
        found = figures(view, names, now, begin, end)
    if not as_json and out is None:
        out = Path(f"shift-{datetime.fromisoformat(found['until']):%Y%m%d-%H%M}.html")
    if out is not None:
        try:
            out.write_text(page(found), encoding="utf-8")
        except OSError as error:
            raise LedgerError(f"{out}: {error.strerror or error}", "name a file that can be written") from error
    if as_json:
        print(json.dumps(found))
    else:
        done = found["results"]["placed"] + found["results"]["rejected"]
        stdout().print(f"{done} of {found['targets']} parts in a bin, alarms: {len(found['alarms'])}; {out}")


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("report")(report)

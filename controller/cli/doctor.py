"""`controller doctor`: what is wrong with this machine and cell, and what to do about it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from controller.backends import DEVICES, Mode
from controller.cli.config import default_config
from controller.cli.output import stdout
from controller.service import unit
from controller.service.doctor.case import Case
from controller.service.doctor.examine import examine, worst
from controller.service.doctor.finding import Finding, Level, counted
from controller.service.folders import folder_of_the_cell

_STYLES = {Level.OK: "green", Level.WARNING: "yellow", Level.FAILED: "bold red"}


def doctor(
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help=f"The cell's TOML file (default: {unit.CONFIG}, when it is there)."),
    ] = None,
    state: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of ledger and calibration (default: the service's).")
    ] = None,
    sim: Annotated[bool, typer.Option("--sim", help="Look at the simulated cell's devices instead.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> int:
    """Look at software, disk, clock, calibration, ledger and devices; moves nothing.

    The devices are opened unless a cell is at work with them; as at every start, settings of the camera and the servos
    that are not as they must be are corrected then.

    The exit code is 1 when a check has failed; warnings alone give 0.

    Examples: controller doctor --config my-cell.toml | controller doctor --sim
    """
    if config is None:
        config = default_config() if sim else unit.CONFIG if unit.CONFIG.is_file() else None
    case = Case(state or folder_of_the_cell(), config)
    findings = examine(dataclasses.replace(case, devices=DEVICES[Mode.SIM], simulated=True) if sim else case)
    verdict = worst(findings)
    if as_json:
        print(json.dumps({"verdict": str(verdict), "checks": [finding.to_json() for finding in findings]}))
    else:
        _table(findings, verdict)
    return 1 if verdict is Level.FAILED else 0


def _table(findings: list[Finding], verdict: Level) -> None:
    grid = Table(box=None, show_header=False, pad_edge=False)
    for _ in range(3):
        grid.add_column(overflow="fold")  # a path is of no use without its end
    for finding in findings:
        grid.add_row(Text(str(finding.level), style=_STYLES[finding.level]), finding.name, Text(finding.finding))
        if finding.remedy:
            grid.add_row("", "", Text(f"-> {finding.remedy}", style="italic"))
    console = stdout()
    console.print(grid)
    counts = {level: sum(finding.level is level for finding in findings) for level in Level}
    bad = f"{counts[Level.FAILED]} failed, {counted(counts[Level.WARNING], 'warning')}"
    console.print(f"{len(findings)} checks: " + ("all well" if verdict is Level.OK else bad))


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("doctor")(doctor)

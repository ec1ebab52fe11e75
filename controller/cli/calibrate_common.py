"""Options and the output that all `controller calibrate` commands share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from controller.backends import Level
from controller.cli.output import stdout

AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="The cell's TOML file.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the simulated world.")]
LevelOf = Annotated[Level, typer.Option("--level", help="How imperfect the simulated world is.")]


def print_result(result: dict[str, Any], out: Path | None, as_json: bool) -> None:
    """A calibration's figures as a table, or as one line of JSON; where they were written to."""
    if as_json:
        print(json.dumps(result))
        return
    grid = Table("figure", "value", box=None, pad_edge=False)
    for key, value in result.items():
        grid.add_row(key, json.dumps(value))
    stdout().print(grid)
    if out is not None:
        print(f"written to {out}")

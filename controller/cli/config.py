"""`controller config`: begin, check, show and explain a cell's configuration."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from controller.backends import nominal_camera
from controller.cli.output import stdout
from controller.config.arm import load_arm
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.config.taught import TAUGHT_BINS, load_taught, with_taught
from controller.cycle.preflight import check as preflight
from controller.domain import CellCalibration
from controller.errors import InputError
from controller.motion.planner import Planner
from controller.service.doctor.finding import counted
from controller.service.folders import state_folder
from controller.vision.recipe import load_recipe

SIMULATED = "simulated"
"""What a configuration names as port when its cell exists in simulation only."""

group = typer.Typer(help="Begin, check, show and explain a cell's configuration.", no_args_is_help=True)

ConfigFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="The cell's TOML file (default: the simulated cell).")
]
AsJson = Annotated[bool, typer.Option("--json", help="JSON on stdout, for machines.")]


def default_config(arm: str | None = None) -> Path:
    """The configuration of the simulated cell, which ships with the program; an arm of another reach has its own."""
    own = shipped("cells") / f"{arm}.toml"
    return own if own.is_file() else shipped("sim.toml")


def taught_file(bins: Path | None, sim: bool) -> Path | None:
    """The file of taught bins: the one named, else a real cell's own; a simulated cell has none."""
    return bins if bins is not None or sim else state_folder() / TAUGHT_BINS


@group.command()
def check(
    config: ConfigFile = None,
    bins: Annotated[
        Path | None,
        typer.Option("--bins", metavar="FILE", help="Taught bins (real cell: bins.toml in the state folder)."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check a configuration as a whole: keys, ranges, rules, the arm's reach to every bin where it was taught to stand.

    Example: controller config check --config my-cell.toml
    """
    path = config or default_config()
    cell = load_cell(path)
    taught = taught_file(bins, sim=cell.arm.port == SIMULATED)
    moved = {} if taught is None else load_taught(taught)
    if taught is not None:
        cell = with_taught(cell, taught)
    arm = load_arm(cell.arm.description)
    load_recipe(cell.vision.recipe)
    camera, T_table_camera = nominal_camera(cell)
    by_ruler = CellCalibration("by ruler", camera, T_table_camera, cell.table.T_base_table())
    warnings = preflight(cell, arm, Planner(arm, by_ruler, cell.bin_values()))
    if as_json:
        said = {"config": str(path), "ok": True, "warnings": warnings, "digest": cell.digest, "taught": sorted(moved)}
        print(json.dumps(said))
        return
    for warning in warnings:
        print(f"warning: {warning}")
    there = f" ({', '.join(sorted(moved))} where taught)" if moved else ""
    bins_, rules = counted(len(cell.bins), "bin"), counted(len(cell.sorting.rules), "rule")
    print(f"{path}: in order: {arm.title}, {bins_}{there}, {rules}")


@group.command()
def show(config: ConfigFile = None, as_json: AsJson = False) -> None:
    """Show a configuration with every default filled in.

    Example: controller config show --json
    """
    cell = load_cell(config or default_config())
    if as_json:
        print(cell.model_dump_json())
        return
    table = Table("key", "value", box=None, pad_edge=False)
    for key, value in _flat(cell.model_dump(mode="json")):
        table.add_row(key, json.dumps(value))
    stdout().print(table)


@group.command()
def new(
    out: Annotated[Path, typer.Argument(metavar="FILE", help="The file to write; it must not exist.")],
    as_json: AsJson = False,
) -> None:
    """Write the commented start of a real cell's configuration.

    Example: controller config new cell.toml
    """
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(shipped("cell.toml").read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{out}: {error.strerror or error}", "name a new file in a folder you may write to") from error
    if as_json:
        print(json.dumps({"config": str(out)}))
        return
    print(f"written to {out}: measure what it asks for, then controller config check --config {out}")


@group.command()
def schema() -> None:
    """Print the JSON Schema of the configuration, for editors that check TOML while you type.

    Example: controller config schema > cell.schema.json
    """
    print(json.dumps(CellConfig.model_json_schema(), indent=1))


def _flat(value: object, key: str = "") -> list[tuple[str, object]]:
    if isinstance(value, dict):
        return [row for name, part in value.items() for row in _flat(part, f"{key}.{name}" if key else name)]
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [row for i, part in enumerate(value) for row in _flat(part, f"{key}[{i}]")]
    return [(key, value)]


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.add_typer(group, name="config")

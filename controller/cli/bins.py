"""`controller bins`: where the bins stand, and teaching one by jogging the open jaws over its middle."""

from __future__ import annotations

import json
from typing import Annotated

import typer
from rich.table import Table

from controller.backends import Level
from controller.cli.config import default_config, taught_file
from controller.cli.control import At, control_folder
from controller.cli.motion import AsJson, BinsFile, Calibration, ConfigFile, Sim, manual_options
from controller.cli.output import stdout
from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.config.taught import load_taught, moved, save_taught, with_taught
from controller.cycle.preflight import check
from controller.errors import InputError
from controller.motion.planner import Planner
from controller.service.client import ControlClient
from controller.service.manual import calibration_of, manual_cell

group = typer.Typer(help="Where the bins stand; teach one by jogging to it.", no_args_is_help=True)


@group.command("list")
def list_(config: ConfigFile = None, bins: BinsFile = None, as_json: AsJson = False) -> None:
    """List the bins, and which of them were taught.

    Example: controller bins list --config cell.toml
    """
    path = taught_file(bins, sim=config is None)
    cell = load_cell(config or default_config())
    taught = load_taught(path) if path is not None else {}
    if path is not None:
        cell = with_taught(cell, path)
    table = Table("bin", "centre, mm", "inner size, mm", "walls, mm", "takes", "taught", box=None, pad_edge=False)
    for bin_ in cell.bins:
        if as_json:
            print(json.dumps(bin_.model_dump(mode="json") | {"taught": bin_.name in taught}))
        (x, y), (length, width) = bin_.center_mm, bin_.size_mm
        place, size = f"{x:.1f}, {y:.1f}", f"{length:g} x {width:g}"
        yes = "yes" if bin_.name in taught else ""
        table.add_row(bin_.name, place, size, f"{bin_.wall_mm:g}", str(bin_.capacity), yes)
    if not as_json:
        stdout().print(table)


@group.command("set")
def set_(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A bin of the configuration.")],
    config: ConfigFile = None,
    at: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="X Y", help="Its middle in the table's system, mm, instead of where the arm stands."),
    ] = None,
    sim: Sim = False,
    calibration: Calibration = None,
    bins: BinsFile = None,
    as_json: AsJson = False,
) -> None:
    """Teach where a bin stands: below the jaws as they were jogged there, or at a measured place. Moves nothing.

    Examples: controller bins set squares --config cell.toml | controller bins set squares --at -190 226

    To teach one: controller jog, open jaws over the bin's middle, q; then this command.

    The configuration is not rewritten: taught bins are kept in bins.toml in the state folder.
    """
    options = manual_options(config, sim, 0, Level.DYNAMIC, calibration, bins)
    path = taught_file(bins, sim)
    if path is None:
        raise InputError("a simulated cell keeps no taught bins", "name a file with --bins FILE")
    if at is None and sim:
        raise InputError("a simulated arm starts at its rest pose, not over a bin", "use --at X Y, or `set` in jog")
    if at is None:
        with manual_cell(options) as cell:
            tool = cell.planner.tool(cell.planner.posture(cell.arm.state().positions))
            at = float(tool[0]), float(tool[1])
    changed = moved(options.config, name, (round(at[0], 2), round(at[1], 2)))
    arm = load_arm(changed.arm.description)
    check(changed, arm, Planner(arm, calibration_of(options), changed.bin_values()))
    save_taught(path, name, at)
    if as_json:
        print(json.dumps({"bin": name, "center_mm": [round(at[0], 2), round(at[1], 2)], "file": str(path)}))
    else:
        print(f"{name} stands at {at[0]:.1f}, {at[1]:.1f} mm; kept in {path}")


@group.command("emptied")
def emptied(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="The bin; all of them when left out.")] = None,
    at: At = None,
) -> None:
    """Tell the running cell that a bin was emptied: it counts what lies in it from nothing again. Moves nothing.

    Example: controller bins emptied squares
    """
    ControlClient(control_folder(at)).ask("emptied", **({} if name is None else {"bin": name}))
    print(f"{name or 'every bin'} counts as empty")


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.add_typer(group, name="bins")

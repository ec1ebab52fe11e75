"""`controller calibrate`: lens and table from pictures of a printed board, the arm from the marker on its gripper."""

from __future__ import annotations

import typer

from controller.cli.calibrate_arm import arm, check, restore
from controller.cli.calibrate_pictures import camera, robot, table

group = typer.Typer(help="Measure lens, table and arm, and certify the whole.", no_args_is_help=True)
for command in (camera, table, arm, check, robot, restore):
    group.command()(command)


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.add_typer(group, name="calibrate")

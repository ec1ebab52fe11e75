"""`controller service`: install, remove and look at the systemd service."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from controller.config.cell import load_cell
from controller.errors import SorterError
from controller.service import unit

group = typer.Typer(help="Install, remove and look at the systemd service.", no_args_is_help=True)

ConfigFile = Annotated[Path, typer.Option("--config", metavar="FILE", help="The cell's TOML file.")]
ArmSerial = Annotated[
    str | None, typer.Option(metavar="SERIAL", help="USB serial number of the servo adapter (default: any U2D2).")
]
CameraSerial = Annotated[
    str | None, typer.Option(metavar="SERIAL", help="USB serial number of the camera (default: any USB camera).")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only print what would be written and run.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]


@group.command()
def install(
    config: ConfigFile = unit.CONFIG,
    arm_serial: ArmSerial = None,
    camera_serial: CameraSerial = None,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Install the service: unit, user, kernel modules, names of the devices. It comes up STOPPED; nothing moves.

    Example: sudo controller service install --config /etc/sorter/cell.toml
    """
    path = config.absolute()
    if path.is_file():
        load_cell(path)
    try:
        program = unit.program()
    except SorterError as error:
        if not dry_run:
            raise
        program = Path(sys.executable).parent / "controller"
        print(f"warning: {error}", file=sys.stderr)
    plan = unit.plan(
        program,
        path,
        arm_serial=arm_serial,
        camera_serial=camera_serial,
        interpreter=Path(sys.executable).resolve(),
    )
    if not dry_run:
        unit.install(plan)
    if as_json:
        files = [{"path": str(file.path), "content": file.content} for file in plan.files]
        warnings = [str(warning) for warning in plan.warnings]
        print(json.dumps({"done": not dry_run, "files": files, "commands": plan.commands, "warnings": warnings}))
        return
    for file in plan.files:
        print(f"# --- {file.path}\n{file.content}" if dry_run else f"written {file.path}")
    if dry_run:
        print("# --- commands")
        _print_commands(plan.commands)
    for warning in plan.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for number, step in enumerate(plan.next_steps, 1):
        print(f"{number}. {step}", file=sys.stderr)


@group.command()
def uninstall(dry_run: DryRun = False, as_json: AsJson = False) -> None:
    """Stop the service (the arm parks) and take its files away. Ledger, calibration and configuration stay.

    Example: sudo controller service uninstall
    """
    if dry_run:
        found = unit.installed_files()
        commands = (*(unit.UNINSTALL_BEFORE if found else ()), *unit.UNINSTALL_AFTER)
    else:
        found, commands = unit.uninstall(), ()
    if as_json:
        print(json.dumps({"done": not dry_run, "files": [str(path) for path in found], "commands": commands}))
        return
    for path in found:
        print(f"{'would remove' if dry_run else 'removed'} {path}")
    if not found:
        print("nothing of the service is installed")
    _print_commands(commands)


@group.command()
def status(as_json: AsJson = False) -> int:
    """Say whether the service is installed and running; the exit code is 0 only when it runs.

    Example: controller service status --json
    """
    found = unit.status()
    if as_json:
        differing = [str(path) for path in found.differing]
        figures = {"installed": found.installed, "active": found.active, "differing": differing}
        print(json.dumps(figures | {"properties": found.properties}))
    else:
        print("installed" if found.installed else "not installed: sudo controller service install")
        if found.installed:
            for path in found.differing:
                print(f"{path}: not as this version writes it: run controller service install again")
        for name, value in found.properties.items():
            print(f"{name}: {value}")
        if not found.properties:
            print("systemd does not run on this machine")
    return 0 if found.active else 1


def _print_commands(commands: tuple[tuple[str, ...], ...]) -> None:
    for command in commands:
        print(" ".join(command))


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.add_typer(group, name="service")

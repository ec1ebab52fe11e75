"""`controller identify`: the arm's own figures, so that it goes where it is told."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from controller.backends import Level
from controller.calibration.identified import IDENTIFICATION, save_identified, to_json
from controller.calibration.store import ARM
from controller.cli.interrupts import exit_code, on_interrupt
from controller.cli.motion import AsJson, ConfigFile, LevelOf, Seed, Sim, manual_options
from controller.cli.output import stdout
from controller.errors import SafetyStop
from controller.service.folders import state_folder
from controller.service.identifying import identify_arm
from controller.service.manual import manual_cell


def identify(
    config: ConfigFile = None,
    sim: Sim = False,
    seed: Seed = 0,
    level: LevelOf = Level.DYNAMIC,
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write the figures into this calibration (real cell: the stored one)."),
    ] = None,
    speed: Annotated[float, typer.Option(metavar="PERCENT", min=30, max=100, help="Arm speed.")] = 70.0,
    as_json: AsJson = False,
) -> int:
    """Measure what the arm's servos and links are really like, from nine ordinary moves. The table must be clear.

    Examples: controller identify --sim | controller identify --config cell.toml

    Masses, gains and friction differ from arm to arm by a fifth, which costs millimetres at the tool. The figures
    are kept in identification.json beside the cell's calibration. Ctrl-C stops the arm along its path; it then holds.
    """
    options = manual_options(config, sim, seed, level, None, None)
    folder = calibration if calibration is not None or sim else state_folder() / "calibration"
    if folder is not None and (folder / ARM).is_file():
        options = replace(options, calibration=folder)
    stopping = "stopping: the arm slows down along its path and holds; once more gives up waiting"
    with manual_cell(options) as cell, on_interrupt(cell.arm.request_stop, stopping) as received:
        arm = cell.arm.description
        try:
            found = identify_arm(cell, speed / 100.0, lambda line: print(line, file=sys.stderr))
        except SafetyStop:
            if received:
                return exit_code(received)
            raise
    if folder is not None:
        save_identified(folder, arm, found)
    if as_json:
        print(json.dumps(to_json(arm, found)))
        return 0
    units = ("stiffness, Nm/rad", "back-EMF, Nm s/rad", "friction, Nm", "rotor, kg m2", "model off by, deg")
    table = Table("joint", *units, box=None, pad_edge=False)
    for name, servo, before, after in zip(arm.joint_names, found.joints, found.before, found.after, strict=True):
        off = f"{math.degrees(before):.2f} -> {math.degrees(after):.2f}"
        figures = (servo.stiffness, servo.damping, servo.friction, servo.inertia)
        table.add_row(name, *(f"{value:.3g}" for value in figures), off)
    stdout().print(table)
    print(f"kept in {folder / IDENTIFICATION}" if folder is not None else "not kept: name a folder with --calibration")
    return 0


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("identify")(identify)

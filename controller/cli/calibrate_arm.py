"""`controller calibrate arm|check|restore`: the arm, from the marker on its gripper and from what it touches."""

from __future__ import annotations

import json
import secrets
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from controller.backends import Devices, Level
from controller.calibration.approval import certificate_of
from controller.calibration.store import load, load_calibration, restore_previous
from controller.cli.calibrate_common import AsJson, ConfigFile, LevelOf, Seed, print_result
from controller.cli.config import default_config
from controller.cli.interrupts import exit_code, on_interrupt
from controller.cli.output import stdout
from controller.config.cell import load_cell
from controller.errors import CalibrationError, ConfigError, SafetyStop
from controller.service.folders import state_folder
from controller.service.self_calibration import (
    CalibrationOptions,
    calibrate_arm_in,
    calibrate_camera_and_table,
    calibrate_cell,
    check_cell,
    open_cell,
    own_folder,
)

Sim = Annotated[bool, typer.Option("--sim", help="The simulated cell: no hardware is touched.")]
ArmName = Annotated[
    str | None, typer.Option("--arm", metavar="NAME", help="Another arm than the configuration's, e.g. pincherx_100.")
]
Folder = Annotated[
    Path | None,
    typer.Option("--calibration", metavar="DIR", help="Folder of the calibration (real cell: in its state folder)."),
]

_MISSES = {
    "touch_mm": "seen by the camera",
    "truth_mm": "truth of the simulated world",
    "moved_mm": "without the last correction",
    "before_mm": "before calibration, by ruler",
}


def arm(
    config: ConfigFile = None,
    sim: Sim = False,
    seed: Seed = 0,
    level: LevelOf = Level.DYNAMIC,
    arm_name: ArmName = None,
    calibration: Folder = None,
    as_json: AsJson = False,
) -> int:
    """Where the arm stands and how its joints are mounted: it shows the marker on its gripper to the camera.

    Examples: controller calibrate arm --sim --calibration cal | controller calibrate arm --config cell.toml |
    controller calibrate arm --sim --arm pincherx_100 --calibration cal

    Moves the arm. A real cell needs camera.json and table.json in the folder, and an empty table; the simulated
    cell makes both first. An arm without a wrist roll needs one thing more: a round part of 35 to 60 mm, as high as
    the configuration says, alone in the middle of the work area. It pushes it to and fro: what comes to rest before
    the closed jaws tells where they are, which the marker never does. Without it such an arm gets no certificate.
    Ctrl-C stops the arm along its path, parks it and lets go of the torque.
    """
    options = _options(config, sim, seed, level, calibration, arm_name)
    with open_cell(options) as (devices, folder), _stoppable(devices) as received:
        began = devices.clock.now()
        with _or_interrupted(received):
            if devices.presenter is not None:
                calibrate_camera_and_table(devices, options.config, folder, options.say)
            made = calibrate_arm_in(devices, options.config, folder, options.say)
        took = devices.clock.now() - began
    if received:
        return exit_code(received)
    result = {"residual_mm": made.to_json()["residual_mm"], "points": made.points, "touches": made.touches}
    result |= {"sim_s": round(took, 3)}
    result |= {"calibration_id": made.calibration_id, "calibration": str(folder)}
    shown = ("T_base_table", "joint_offsets", "sigma", "singular_values", "error_map")
    details = {key: made.to_json()[key] for key in shown}
    print_result(result | details, folder, as_json)
    return 0


def check(
    config: ConfigFile = None,
    sim: Sim = False,
    seed: Seed = 0,
    level: LevelOf = Level.DYNAMIC,
    arm_name: ArmName = None,
    calibration: Folder = None,
    points: Annotated[int, typer.Option(min=20, max=200, help="Places to touch.")] = 30,
    as_json: AsJson = False,
) -> int:
    """The certificate: sends the arm to fresh places, at least 15 mm from any it was fitted at, and looks.

    Examples: controller calibrate check --sim --calibration cal | controller calibrate check --config cell.toml

    Moves the arm down to 5 mm over the table, which must be empty. Writes certificate.json and certificate.png into
    the folder; without one, a simulated cell is calibrated first. Exit code 1 when the verdict is `failed`.
    """
    options = _options(config, sim, seed, level, calibration, arm_name)
    result: dict[str, Any] = {}
    given = own_folder(options)
    if given is not None:
        load_calibration(given)  # files that are missing or do not belong together: said before anything is opened
    with open_cell(options) as (devices, folder), _stoppable(devices) as received, _or_interrupted(received):
        if given is None:
            calibrate_cell(devices, options.config, folder, options.say)
        began = devices.clock.now()
        result = check_cell(devices, options.config, folder, secrets.randbelow(2**31), options.say, points)
        result["sim_s"] = round(devices.clock.now() - began, 3)
    if received:
        return exit_code(received)
    if as_json:
        print(json.dumps(result))
    else:
        _certificate(result, folder)
    return 0 if result["verdict"] == "passed" else 1


def restore(
    calibration: Folder = None,
    as_json: AsJson = False,
) -> None:
    """Go back to the calibration before the last one; once more returns to the last one.

    Example: controller calibrate restore

    Every `calibrate` keeps what it replaces. Swaps the files made last, with their certificate; moves nothing.
    """
    folder = calibration or state_folder() / "calibration"
    swapped = restore_previous(folder)
    stored = load(folder)
    result: dict[str, Any] = {"calibration": str(folder), "restored": list(swapped)}
    result |= {"calibration_id": stored.arm.calibration_id if stored.arm is not None else None}
    try:
        result |= {"certificate": certificate_of(folder, stored).verdict}
    except CalibrationError as error:
        result |= {"certificate": str(error)}
    print_result(result, None, as_json)


def _options(
    config: Path | None, sim: bool, seed: int, level: Level, folder: Path | None, arm_name: str | None
) -> CalibrationOptions:
    if config is None and not sim:
        raise ConfigError(
            "a real cell needs its configuration", "name it with --config FILE, or try the simulation with --sim"
        )
    cell = load_cell(config or default_config(arm_name))
    if arm_name is not None:
        cell = cell.model_copy(update={"arm": cell.arm.model_copy(update={"description": arm_name})})
    return CalibrationOptions(cell, sim, seed, level, folder, lambda line: print(line, file=sys.stderr))


def _stoppable(devices: Devices) -> AbstractContextManager[list[int]]:
    return on_interrupt(devices.arm.request_stop, "stopping: the arm parks; once more gives up waiting")


@contextmanager
def _or_interrupted(received: list[int]) -> Iterator[None]:
    """A stop that was asked for is no error."""
    try:
        yield
    except SafetyStop:
        if not received:
            raise


def _certificate(result: dict[str, Any], folder: Path) -> None:
    grid = Table("touch error, mm", "mean", "p95", "max", box=None, pad_edge=False)
    for key, what in _MISSES.items():
        if key in result:
            grid.add_row(what, *(f"{result[key][figure]:.2f}" for figure in ("mean", "p95", "max")))
    stdout().print(grid)
    print(
        "the marker cannot show where the jaws are: what touched tells it to "
        f"{result['unseen_mm']:.1f} mm, which the verdict counts"
    )
    mean, p95 = (result["limits_mm"][figure] for figure in ("mean", "p95"))
    print(f"{result['verdict']} at {result['points']} places (limits: mean {mean:g}, p95 {p95:g} mm)")
    print(f"Certificate and heat map: {folder}")

"""`controller calibrate`: lens and table from pictures of a printed board, the arm from the marker on its gripper."""

from __future__ import annotations

import json
import secrets
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Annotated, Any

import cv2
import typer
from rich.table import Table

from controller.backends import Devices, Level
from controller.calibration.approval import certificate_of
from controller.calibration.boards import BoardView, parse_board
from controller.calibration.camera import CameraCalibration, LensModel, fit_views
from controller.calibration.coverage import coverage_picture
from controller.calibration.guided import TABLE_FRAMES
from controller.calibration.hand_eye import Carried, fit_hand_eye, read_robot_pose
from controller.calibration.store import load, load_calibration, restore_previous
from controller.calibration.table import calibrate_table
from controller.calibration.views import find_views
from controller.cli.camera import open_camera
from controller.cli.config import default_config
from controller.cli.interrupts import exit_code, on_interrupt
from controller.cli.live import capture_live
from controller.cli.output import stdout
from controller.config.cell import load_cell
from controller.errors import CalibrationError, ConfigError, InputError, SafetyStop
from controller.service.folders import state_folder
from controller.service.self_calibration import (
    CalibrationOptions,
    calibrate_arm_in,
    calibrate_camera_and_table,
    calibrate_cell,
    check_cell,
    open_cell,
    own_folder,
    provenance_now,
)
from controller.vision.read import read_image

group = typer.Typer(help="Measure lens, table and arm, and certify the whole.", no_args_is_help=True)

BoardSpec = Annotated[str, typer.Option(metavar="SPEC", help="The board, e.g. charuco:10x7:28:21:DICT_5X5_100.")]
Out = Annotated[Path | None, typer.Option(metavar="FILE", help="Write the calibration into FILE.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="The cell's TOML file.")]
Sim = Annotated[bool, typer.Option("--sim", help="The simulated cell: no hardware is touched.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the simulated world.")]
LevelOf = Annotated[Level, typer.Option("--level", help="How imperfect the simulated world is.")]
ArmName = Annotated[
    str | None, typer.Option("--arm", metavar="NAME", help="Another arm than the configuration's, e.g. pincherx_100.")
]
Folder = Annotated[
    Path | None,
    typer.Option("--calibration", metavar="DIR", help="Folder of the calibration (real cell: in its state folder)."),
]


@group.command()
def camera(
    board: BoardSpec,
    images: Annotated[
        list[Path] | None, typer.Argument(metavar="[IMAGE...]", help="Views of the board, ten or more; none: live.")
    ] = None,
    out: Out = None,
    config: ConfigFile = None,
    device: Annotated[str | None, typer.Option(metavar="PATH", help="Live: another camera.")] = None,
    save: Annotated[Path | None, typer.Option(metavar="DIR", help="Live: keep the views in DIR.")] = None,
    sim: Annotated[bool, typer.Option("--sim", help="Live: simulated camera, and hands with the board.")] = False,
    model: Annotated[
        LensModel | None, typer.Option("--model", help="Fit exactly these distortion terms; else the evidence decides.")
    ] = None,
    seed: Seed = 0,
    level: LevelOf = Level.DYNAMIC,
    as_json: AsJson = False,
) -> None:
    """Lens (intrinsics and distortion) from views of a board: from pictures, or live with a guide.

    Examples: controller calibrate camera views/*.jpg --board chessboard:9x6:25 --out camera.json |
    controller calibrate camera --config cell.toml --board charuco:10x7:28:21:DICT_5X5_100 --out camera.json

    Live, hold the board before the camera: it says where to and how to tilt it, and takes a view by itself when the
    board is held still and shows something new. FILE.png beside --out shows what the views cover.
    """
    shown = parse_board(board)
    seen: list[tuple[str, BoardView]]
    rejected: list[tuple[str, str]]
    if images:
        pictures, rejected = [], []
        for path in images:
            try:
                pictures.append((str(path), read_image(path)))
            except InputError as error:
                rejected.append((str(path), error.cause.removeprefix(f"{path} ")))
                print(f"warning: {error}", file=sys.stderr)
        seen, without = find_views(pictures, shown)
        rejected += without
    else:
        if not sim and config is None and device is None:
            raise InputError("no picture was named", "name pictures; live: --config FILE, --device PATH or --sim")
        capture = capture_live(config, shown, device=device, sim=sim, seed=seed, level=level, save=save)
        seen, rejected = capture.taken, []
    made = fit_views(seen, rejected, shown, model=model)
    if out is not None:
        made.save(out, provenance_now())
        left_out = {name for name, _ in made.views_rejected}
        picture = coverage_picture([view for name, view in seen if name not in left_out], made)
        cv2.imwrite(str(out.with_suffix(".png")), picture)
    _report(made.to_json(), out, as_json)


@group.command()
def table(
    camera: Annotated[Path, typer.Option(metavar="FILE", help="Lens, from `calibrate camera --out`.")],
    board: BoardSpec,
    images: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[IMAGE...]", help="The board lying on the table, unmoved; none: taken now."),
    ] = None,
    out: Out = None,
    config: ConfigFile = None,
    device: Annotated[str | None, typer.Option(metavar="PATH", help="Taken now: another camera.")] = None,
    as_json: AsJson = False,
) -> None:
    """The table's plane and the camera's pose over it, from one or more pictures of the board lying there.

    Examples: controller calibrate table sheet.png --camera camera.json --board charuco:10x7:28:21:DICT_5X5_100 |
    controller calibrate table --config cell.toml --camera camera.json --board charuco:10x7:28:21:DICT_5X5_100

    Taken now, ten pictures are averaged. Corner markers (`controller board --corners`) in view are noted.
    """
    lens, shown = CameraCalibration.load(camera), parse_board(board)
    if images:
        pictures = [(str(path), read_image(path)) for path in images]
    elif config is None and device is None:
        raise InputError("no picture was named", "name pictures; to take them now: --config FILE or --device PATH")
    else:
        with open_camera(config, device, False) as (seen, clock):
            pictures = [(f"picture {k + 1}", seen.capture(clock.now(), timeout=5.0).image) for k in range(TABLE_FRAMES)]
    made = calibrate_table(pictures, lens, shown)
    if out is not None:
        made.save(out, provenance_now())
    _report(made.to_json(lens), out, as_json)


@group.command()
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
    _report(result | details, folder, as_json)
    return 0


@group.command()
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


@group.command()
def robot(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="The board at different robot poses.")],
    camera: Annotated[Path, typer.Option(metavar="FILE", help="Lens, from `calibrate camera --out`.")],
    board: BoardSpec,
    carried: Annotated[Carried, typer.Option(help="What the robot carries.")] = Carried.BOARD,
    as_json: AsJson = False,
) -> None:
    """Where a camera stands against a robot of another make, one that knows its own pose (hand-eye).

    Example: controller calibrate robot views/*.png --camera camera.json --board charuco:5x7:36:18:DICT_6X6_250

    Beside IMAGE.png lies IMAGE_pose.yaml: x, y, z in metres and the quaternion qx, qy, qz, qw of the tool in the
    robot's base, a line each. Moves nothing.
    """
    lens, shown = CameraCalibration.load(camera), parse_board(board)
    pictures = [(str(path), read_image(path)) for path in images]
    wrong = next((name for name, image in pictures if image.shape[1::-1] != lens.camera.image_size), None)
    if wrong is not None:
        raise InputError(f"{wrong}: not of the size the lens was calibrated at", "use the same camera as it was")
    seen, rejected = find_views(pictures, shown)
    poses = [read_robot_pose(Path(name).with_name(f"{Path(name).stem}_pose.yaml")) for name, _ in seen]
    found = fit_hand_eye([view for _, view in seen], poses, lens.camera, shown, carried)
    left_out = [{"image": name, "reason": why} for name, why in rejected]
    if found.board_scale != 1.0:
        print(
            f"warning: by the robot's moves the board is {found.board_scale:.3f} times as large as {shown.spec} says "
            f"(+- {found.scale_sigma:.3f}), and was taken so: measure the print",
            file=sys.stderr,
        )
    _report(found.to_json() | {"views_rejected": left_out}, None, as_json)


@group.command()
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
    _report(result, None, as_json)


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


_MISSES = {
    "touch_mm": "seen by the camera",
    "truth_mm": "truth of the simulated world",
    "moved_mm": "without the last correction",
    "before_mm": "before calibration, by ruler",
}


def _report(result: dict[str, Any], out: Path | None, as_json: bool) -> None:
    if as_json:
        print(json.dumps(result))
        return
    grid = Table("figure", "value", box=None, pad_edge=False)
    for key, value in result.items():
        grid.add_row(key, json.dumps(value))
    stdout().print(grid)
    if out is not None:
        print(f"written to {out}")


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.add_typer(group, name="calibrate")

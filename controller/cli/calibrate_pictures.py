"""`controller calibrate camera|table|robot`: from pictures of a printed board."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import cv2
import typer

from controller.backends import Level
from controller.calibration.board_search import BoardView
from controller.calibration.board_spec import parse_board
from controller.calibration.camera import CameraCalibration, LensModel, fit_views
from controller.calibration.coverage import coverage_picture
from controller.calibration.guided import TABLE_FRAMES
from controller.calibration.hand_eye import Carried, fit_hand_eye, read_robot_pose
from controller.calibration.table import calibrate_table
from controller.calibration.views import find_views
from controller.cli.calibrate_common import AsJson, ConfigFile, LevelOf, Seed, print_result
from controller.cli.camera import open_camera
from controller.cli.live import capture_live
from controller.errors import InputError
from controller.service.self_calibration import provenance_now
from controller.vision.read import read_image

BoardSpec = Annotated[str, typer.Option(metavar="SPEC", help="The board, e.g. charuco:10x7:28:21:DICT_5X5_100.")]
Out = Annotated[Path | None, typer.Option(metavar="FILE", help="Write the calibration into FILE.")]


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
        if not pictures:
            raise InputError("none of the pictures can be read", "check their paths and permissions")
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
    print_result(made.to_json(), out, as_json)


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
    print_result(made.to_json(lens), out, as_json)


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
    print_result(found.to_json() | {"views_rejected": left_out}, None, as_json)

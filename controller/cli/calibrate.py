"""`controller calibrate`: lens and table from pictures of a printed board."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from controller.calibration.boards import parse_board
from controller.calibration.camera import CameraCalibration, calibrate_camera
from controller.calibration.table import calibrate_table
from controller.cli.output import stdout
from controller.errors import InputError
from controller.vision.read import read_image

group = typer.Typer(help="Measure lens and table from pictures of a printed board.", no_args_is_help=True)

BoardSpec = Annotated[str, typer.Option(metavar="SPEC", help="The board, e.g. charuco:10x7:28:21:DICT_5X5_100.")]
Out = Annotated[Path | None, typer.Option(metavar="FILE", help="Write the calibration into FILE.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]


@group.command()
def camera(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Views of the board, ten or more.")],
    board: BoardSpec,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Lens (intrinsics and distortion) from views of a board.

    Example: controller calibrate camera views/*.jpg --board chessboard:9x6:25 --out camera.json
    """
    pictures = []
    unreadable = []
    for path in images:
        try:
            pictures.append((str(path), read_image(path)))
        except InputError as error:
            unreadable.append({"image": str(path), "reason": str(error)})
            print(f"warning: {error}", file=sys.stderr)
    made = calibrate_camera(pictures, parse_board(board))
    if out is not None:
        made.save(out)
    result = made.to_json()
    result["views_rejected"] = [*result["views_rejected"], *unreadable]
    _report(result, out, as_json)


@group.command()
def table(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="The board lying on the table, unmoved.")],
    camera: Annotated[Path, typer.Option(metavar="FILE", help="Lens, from `calibrate camera --out`.")],
    board: BoardSpec,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """The table's plane and the camera's pose over it, from one or more pictures of the board lying there.

    Example: controller calibrate table sheet.png --camera camera.json --board charuco:10x7:28:21:DICT_5X5_100
    """
    lens = CameraCalibration.load(camera)
    made = calibrate_table([(str(path), read_image(path)) for path in images], lens, parse_board(board))
    if out is not None:
        made.save(out)
    _report(made.to_json(lens), out, as_json)


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

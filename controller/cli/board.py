"""`controller board`: a calibration board, or markers for gripper and table, to print with a ruler on it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from controller.calibration.board_spec import parse_board
from controller.calibration.marker import ArmMarker
from controller.calibration.printing import lay_out, lay_out_corners, lay_out_marker, write_sheet


def board(
    out: Annotated[Path, typer.Option(metavar="FILE", help="Write it into FILE, .pdf or .png.")],
    spec: Annotated[
        str | None, typer.Option("--board", metavar="SPEC", help="The board, e.g. charuco:10x7:28:21:DICT_5X5_100.")
    ] = None,
    marker: Annotated[bool, typer.Option("--marker", help="The marker for the gripper instead of a board.")] = False,
    corners: Annotated[bool, typer.Option("--corners", help="The table's four corner markers instead.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """A board to print, the gripper's marker or the table's: on the smallest paper that takes it, with a ruler.

    Examples: controller board --board charuco:10x7:28:21:DICT_5X5_100 --out board.pdf | controller board --marker
    --out marker.pdf
    """
    if (spec is not None) + marker + corners != 1:
        raise typer.BadParameter("name either a board with --board SPEC, or --marker, or --corners")
    if spec is not None:
        name, sheet, then = spec, lay_out(parse_board(spec)), "glue it onto something flat and stiff"
    elif marker:
        name, sheet, then = "marker", lay_out_marker(ArmMarker()), "glue it onto the gripper as it says"
    else:
        name, sheet, then = "corners", lay_out_corners(), "lay the four flat on the table, at the picture's rim"
    write_sheet(sheet, out)
    if as_json:
        page = {"paper": sheet.paper, "size_mm": sheet.size, "middle_mm": [round(value, 3) for value in sheet.middle]}
        print(json.dumps({"board": name, "out": str(out), **page}))
        return
    way = "landscape" if sheet.size[0] > sheet.size[1] else "portrait"
    print(f"written to {out}: {sheet.paper} {way}")
    print(f"Print it at 100 % (not fitted to the page), measure its ruler, and {then}.")


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("board")(board)

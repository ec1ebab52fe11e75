"""`controller board`: a calibration board to print, with its own name and a ruler on it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from controller.calibration.boards import parse_board
from controller.calibration.printing import write_board


def board(
    spec: Annotated[
        str, typer.Option("--board", metavar="SPEC", help="The board, e.g. charuco:10x7:28:21:DICT_5X5_100.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Write it into FILE, .pdf or .png.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """A calibration board to print: the smallest paper of A4 and A3 that takes it, with a ruler to check its scale.

    Example: controller board --board charuco:10x7:28:21:DICT_5X5_100 --out board.pdf
    """
    sheet = write_board(parse_board(spec), out)
    if as_json:
        page = {"paper": sheet.paper, "size_mm": sheet.size, "middle_mm": [round(value, 3) for value in sheet.middle]}
        print(json.dumps({"board": spec, "out": str(out), **page}))
        return
    way = "landscape" if sheet.size[0] > sheet.size[1] else "portrait"
    print(f"written to {out}: {sheet.paper} {way}")
    print("Print it at 100 % (not fitted to the page), measure its ruler, and glue it onto something flat and stiff.")


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("board")(board)

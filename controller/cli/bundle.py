"""`controller bundle`: everything a helper elsewhere needs to see, in one archive without secrets."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from controller.cli.output import stdout
from controller.errors import InputError
from controller.service import unit
from controller.service.bundle import collect, write
from controller.service.doctor.case import Case
from controller.service.folders import folder_of_the_cell


def bundle(
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="DIR", show_default=False, help="Folder of the ledger, or of a run (default: the cell's own)."
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help=f"The cell's TOML file (default: {unit.CONFIG}, when it is there)."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A new .zip (default: bundle-DATE.zip here).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The table of contents on stdout.")] = False,
) -> None:
    """Collect configuration, doctor's findings, calibration, last logs, records and alarms into one archive.

    Passwords, tokens, keys, mail addresses and names of homes and of the machine are taken out; pictures are not in it.
    Look into it before you send it: it is a plain archive of texts.

    Example: controller bundle --config cell.toml
    """
    if folder is not None and not folder.is_dir():
        raise InputError(f"{folder}: no such folder", "name the folder of a run, or leave it out")
    if out is not None and out.suffix != ".zip":
        raise typer.BadParameter(f"{out}: a bundle is a .zip")
    if config is None and unit.CONFIG.is_file():
        config = unit.CONFIG
    now = datetime.now(UTC)
    path = out or Path(f"bundle-{now.astimezone():%Y%m%d-%H%M%S}.zip")
    contents = write(collect(Case(folder or folder_of_the_cell(), config)), path, now.isoformat(timespec="seconds"))
    if as_json:
        print(json.dumps({"path": str(path), **contents}))
        return
    console = stdout()
    files, missing = contents["files"], contents["missing"]
    assert isinstance(files, list)
    assert isinstance(missing, dict)
    console.print(f"{path}: {len(files)} files, {sum(file['secrets_removed'] for file in files)} secrets taken out")
    for what, why in missing.items():
        console.print(f"without {what}: {why}", markup=False)


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("bundle")(bundle)

"""`controller classes`: what was taught, how well it is told apart, and how to forget it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from controller.cli.detect import picture_files
from controller.cli.looking import Looking
from controller.cli.output import stdout
from controller.config.cell import CellConfig
from controller.errors import InputError
from controller.service.folders import state_folder
from controller.vision.appearance.palette import name_of
from controller.vision.classes.features import block
from controller.vision.classes.store import TaughtClass, load_classes, remove_class
from controller.vision.classes.taught import Taught

group = typer.Typer(help="Show, test and remove taught classes.", no_args_is_help=True)

ClassesFolder = Annotated[
    Path | None, typer.Option("--classes", metavar="DIR", help="Folder of taught classes (default: the cell's own).")
]
AsJson = Annotated[bool, typer.Option("--json", help="JSON on stdout, for machines.")]


def classes_folder(given: Path | None) -> Path:
    """The folder named on the command line, else the cell's own."""
    return given if given is not None else state_folder() / "classes"


def with_classes(cell: CellConfig, given: Path | None) -> CellConfig:
    """The cell with the folder of taught classes that the command line names, if it names one."""
    if given is None:
        return cell
    return cell.model_copy(update={"vision": cell.vision.model_copy(update={"classes": str(given.resolve())})})


@group.command("list")
def list_(classes: ClassesFolder = None, as_json: AsJson = False) -> None:
    """List the taught classes.

    Example: controller classes list
    """
    folder = classes_folder(classes)
    known = load_classes(folder)
    if as_json:
        for item in known:
            print(json.dumps(_entry(item)))
        return
    console = stdout()
    if not known:
        console.print(f"nothing was taught yet ({folder}): controller teach NAME IMAGE...")
        return
    table = Table("class", "views", "units", "colour", "digest", box=None, pad_edge=False)
    for item in known:
        entry = _entry(item)
        table.add_row(item.name, str(entry["views"]), item.units, str(entry["colour"]), item.digest[:12])
    console.print(table)


@group.command()
def show(name: str, classes: ClassesFolder = None, as_json: AsJson = False) -> None:
    """Show one class, and how its views are told from the others' when each is left out in turn.

    Example: controller classes show "M8 nut"
    """
    known = load_classes(classes_folder(classes))
    chosen = next((item for item in known if item.name == name), None)
    if chosen is None:
        names = ", ".join(item.name for item in known) or "none"
        raise InputError(f"no class {name!r}", f"known: {names}")
    confusion = Taught(known).confusion()[name]
    if as_json:
        print(json.dumps(_entry(chosen) | {"pictures": list(chosen.pictures), "left_one_out": dict(confusion)}))
        return
    console = stdout()
    for key, value in _entry(chosen).items():
        console.print(f"{key}: {value}")
    console.print("pictures: " + ", ".join(dict.fromkeys(chosen.pictures)))
    console.print("left one out: " + ", ".join(f"{said} {count}" for said, count in confusion.most_common()))


@group.command("test")
def name_pictures(
    images: Annotated[
        list[Path] | None, typer.Argument(metavar="[IMAGE...]", help="Pictures to name; without, the taught views.")
    ] = None,
    classes: ClassesFolder = None,
    recipe: Annotated[str, typer.Option(metavar="precise|FILE", help="How to look.")] = "precise",
    camera: Annotated[Path | None, typer.Option(metavar="FILE", help="Lens, from `calibrate camera --out`.")] = None,
    table: Annotated[Path | None, typer.Option(metavar="FILE", help="Table, from `calibrate table --out`.")] = None,
    height_mm: Annotated[float, typer.Option(min=0.0, max=500.0, help="Height of the parts.")] = 20.0,
    as_json: AsJson = False,
) -> None:
    """Name what pictures show; without pictures, cross-validate the taught views (confusion matrix).

    Example: controller classes test new-photos/
    """
    taught = Taught(load_classes(classes_folder(classes)))
    if not taught.classes:
        raise InputError("nothing was taught yet", "controller teach NAME IMAGE...")
    if not images:
        confusion = taught.confusion()
        if as_json:
            print(json.dumps({"confusion": {name: dict(row) for name, row in confusion.items()}}))
        else:
            stdout().print(confusion_table(confusion))
        return
    looking = Looking(recipe, camera, table, height_mm)
    for path in picture_files(images):
        detections, surfaces, plane = looking.at(path)
        known = dict(zip(surfaces.which, taught.names(detections, surfaces, plane), strict=True))
        said = [known.get(k) or "unknown" for k in range(len(detections))]
        if as_json:
            objects = [
                {"class": name, "center_px": [round(v, 2) for v in item.center_px]}
                for name, item in zip(said, detections, strict=True)
            ]
            print(json.dumps({"image": str(path), "objects": objects}), flush=True)
        else:
            stdout().print(f"{path}: " + (", ".join(said) or "nothing"), soft_wrap=True)


@group.command()
def remove(name: str, classes: ClassesFolder = None) -> None:
    """Forget a class.

    Example: controller classes remove "M8 nut"
    """
    remove_class(classes_folder(classes), name)
    print(f"{name} is forgotten")


def confusion_table(confusion: Mapping[str, Counter[str]]) -> Table:
    """What the views of each class were taken for when each was left out."""
    names = [*confusion, "unknown"]
    grid = Table("left one out", *names, box=None, pad_edge=False)
    for name, row in confusion.items():
        grid.add_row(name, *(str(row[said]) if row[said] else "." for said in names))
    return grid


def _entry(item: TaughtClass) -> dict[str, str | int]:
    mean = item.views[:, block("colour")].mean(axis=0)
    colour = name_of(mean)[0] if np.isfinite(mean).all() else "any"
    return {
        "class": item.name,
        "views": len(item.views),
        "units": item.units,
        "colour": colour,
        "sha256": item.digest,
    }


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.add_typer(group, name="classes")

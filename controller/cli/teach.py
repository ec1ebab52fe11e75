"""`controller teach`: show a part some times, and it is known."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from controller.backends import Level
from controller.cli.classes import ClassesFolder, classes_folder, confusion_table
from controller.cli.config import default_config
from controller.cli.looking import Looking
from controller.cli.output import stderr, stdout
from controller.cli.teach_sources import Shown, from_camera, from_pictures, from_simulation
from controller.config.cell import load_cell
from controller.errors import InputError
from controller.vision.classes.drawn import drawn_class
from controller.vision.classes.store import MOST_VIEWS, TaughtClass, checked_name, load_classes, save_class
from controller.vision.classes.taught import Admission, admit
from controller.vision.drawings.outline import read_drawing


def teach(
    name: Annotated[str, typer.Argument(help="What the part shall be called, also in sorting rules.")],
    images: Annotated[
        list[Path] | None, typer.Argument(metavar="[IMAGE...]", help="Pictures of it, or folders of pictures.")
    ] = None,
    recipe: Annotated[str, typer.Option(metavar="precise|FILE", help="How to look.")] = "precise",
    camera: Annotated[Path | None, typer.Option(metavar="FILE", help="Lens, from `calibrate camera --out`.")] = None,
    table: Annotated[Path | None, typer.Option(metavar="FILE", help="Table, from `calibrate table --out`.")] = None,
    height_mm: Annotated[float, typer.Option(min=0.0, max=500.0, help="Height of the parts.")] = 20.0,
    drawing: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Learn it from a DXF or SVG outline instead; say its height.")
    ] = None,
    faces: Annotated[int, typer.Option(min=1, max=6, help="How many different sides of it are shown.")] = 1,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="The cell, to show it to its camera.")] = None,
    sim: Annotated[bool, typer.Option("--sim", help="Show one of the configuration's simulated_kinds.")] = False,
    level: Annotated[Level, typer.Option(help="--sim: how imperfect the simulated world is.")] = Level.DYNAMIC,
    seed: Annotated[int, typer.Option(min=0, help="--sim: seed of the simulated world.")] = 0,
    views: Annotated[int, typer.Option(min=3, max=100, help="Camera: how many views to take.")] = 12,
    classes: ClassesFolder = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON on stdout, for machines.")] = False,
) -> None:
    """Teach a class of parts from 5 to 30 views: nothing but it may lie in the pictures, one or more of it in each.

    Examples: controller teach "M8 nut" photos/nut*.png | controller teach "M8 nut" --config cell.toml |
    controller teach "blue arrow" --sim --config configs/sim_taught.toml | controller teach bracket --drawing
    bracket.dxf --height-mm 12

    Without pictures the cell's camera is used: lay the part, press Enter, lay it elsewhere; nothing moves. The class
    is let in only when cross-validation recognises it; a refused one leaves the known classes as they were. Sorting
    rules may name it at once: label = "M8 nut".
    """
    checked_name(name)
    folder = classes_folder(classes)
    known = load_classes(folder)
    say = stderr().print
    shown: Iterator[Shown]
    if bool(images) + sim + (drawing is not None) > 1:
        raise typer.BadParameter("pictures, --sim and --drawing exclude one another")
    if drawing is not None:
        if height_mm == 0.0:
            raise typer.BadParameter("a drawn part needs its height: --height-mm above 0")
        outline = read_drawing(drawing)
        admission = admit(drawn_class(name, outline, height_mm, drawing.name), known, faces)
        save_class(folder, admission.new)
        long, short = outline.size
        say(f"{long:.1f} x {short:.1f} x {height_mm:g} mm, {len(outline.holes)} holes")
        _report(admission, folder, as_json)
        return
    if sim:
        cell = load_cell(config or default_config())
        looking, shown = from_simulation(name, cell, level, seed, views, recipe, say)
    elif images:
        looking = Looking(recipe, camera, table, height_mm)
        shown = from_pictures(images, looking)
    elif config is not None:
        looking, shown = from_camera(name, load_cell(config), views, recipe, say)
    else:
        raise typer.BadParameter("name pictures of it, or the cell whose camera shall see it with --config")
    new = collected(name, shown, "mm" if looking.calibrated else "px")
    admission = admit(new, known, faces)
    save_class(folder, admission.new)
    _report(admission, folder, as_json)


def collected(name: str, shown: Iterator[Shown], units: str) -> TaughtClass:
    """All views of a class.

    Raises:
        InputError: There are none, or far too many.
    """
    views, prints, pictures = [], [], []
    for item in shown:
        views.append(item.views)
        prints.append(item.prints)
        pictures += [item.picture] * len(item.views)
        if len(pictures) > MOST_VIEWS:
            raise InputError(f"more than {MOST_VIEWS} views of {name!r}", "choose some of the pictures")
    if not views:
        raise InputError(f"{name!r} was not shown", "show it 5 to 30 times")
    return TaughtClass(name, units, np.concatenate(views), tuple(pictures), np.concatenate(prints))


def _report(admission: Admission, folder: Path, as_json: bool) -> None:
    new = admission.new
    if as_json:
        result = {"class": new.name, "views": len(new.views), "units": new.units, "folder": str(folder)}
        result |= {"digest": admission.taught.digest, "warnings": list(admission.warnings)}
        print(json.dumps(result | {"confusion": {k: dict(v) for k, v in admission.confusion.items()}}))
        return
    console = stdout()
    pictures = len(set(new.pictures))
    plural = "" if pictures == 1 else "s"
    console.print(f"{new.name}: {len(new.views)} views from {pictures} picture{plural}, kept in {folder}")
    console.print(confusion_table(admission.confusion))
    for warning in admission.warnings:
        console.print(f"warning: {warning}")


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("teach")(teach)

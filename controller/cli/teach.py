"""`controller teach`: show a part some times, and it is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from controller.cli.classes import ClassesFolder, classes_folder, confusion_table
from controller.cli.detect import picture_files
from controller.cli.looking import Looking
from controller.cli.output import stdout
from controller.errors import InputError
from controller.vision.classes.features import features
from controller.vision.classes.store import TaughtClass, checked_name, load_classes, save_class
from controller.vision.classes.taught import admit


def teach(
    name: Annotated[str, typer.Argument(help="What the part shall be called, also in sorting rules.")],
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Pictures of it, or folders of pictures.")],
    recipe: Annotated[str, typer.Option(metavar="precise|FILE", help="How to look.")] = "precise",
    camera: Annotated[Path | None, typer.Option(metavar="FILE", help="Lens, from `calibrate camera --out`.")] = None,
    table: Annotated[Path | None, typer.Option(metavar="FILE", help="Table, from `calibrate table --out`.")] = None,
    height_mm: Annotated[float, typer.Option(min=0.0, max=500.0, help="Height of the parts.")] = 20.0,
    faces: Annotated[int, typer.Option(min=1, max=6, help="How many different sides of it are shown.")] = 1,
    classes: ClassesFolder = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON on stdout, for machines.")] = False,
) -> None:
    """Teach a class of parts from 5 to 30 views: nothing but it may lie in the pictures, one or more of it in each.

    Example: controller teach "M8 nut" photos/nut*.png

    The class is let in only when cross-validation recognises it; a refused one leaves the known classes as they were.
    Sorting rules may name it at once: label = "M8 nut".
    """
    checked_name(name)
    folder = classes_folder(classes)
    known = load_classes(folder)
    looking = Looking(recipe, camera, table, height_mm)
    views, pictures = [], []
    for path in picture_files(images):
        detections, surfaces, plane = looking.at(path)
        if not surfaces.which:
            raise InputError(f"{path} shows nothing", "take pictures with the part whole in view, on a plain table")
        views.append(features(detections, surfaces, plane))
        pictures += [path.name] * len(surfaces.which)
    new = TaughtClass(name, "mm" if looking.calibrated else "px", np.concatenate(views), tuple(pictures))
    admission = admit(new, known, faces)
    new = admission.new
    save_class(folder, new)
    if as_json:
        result = {"class": name, "views": len(new.views), "units": new.units, "folder": str(folder)}
        result |= {"digest": admission.taught.digest, "warnings": list(admission.warnings)}
        print(json.dumps(result | {"confusion": {k: dict(v) for k, v in admission.confusion.items()}}))
        return
    console = stdout()
    console.print(f"{name}: {len(new.views)} views from {len(set(pictures))} pictures, kept in {folder}")
    console.print(confusion_table(admission.confusion))
    for warning in admission.warnings:
        console.print(f"warning: {warning}")


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("teach")(teach)

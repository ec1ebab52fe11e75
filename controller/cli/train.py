"""`controller train`: classes from a folder of annotated pictures."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from controller.cli.annotate import FILE, read_annotations
from controller.cli.classes import ClassesFolder, classes_folder, confusion_table
from controller.cli.looking import Looking
from controller.cli.output import stderr, stdout
from controller.cli.train_network import learn_folder, learn_network, learn_painted
from controller.errors import InputError
from controller.vision.classes.features import LENGTH, features
from controller.vision.classes.markings import SIDE, tiles_of
from controller.vision.classes.store import TaughtClass, checked_name, load_classes, save_class
from controller.vision.classes.taught import LEAST_VIEWS, Taught
from controller.vision.classes.training import Examples, by_class, cross_validated

_NEAR = 0.3
"""An object found this share of its size from an annotated centre is the annotated one."""


def train(
    folder: Annotated[
        Path | None, typer.Argument(metavar="[DIR]", help="Folder of pictures with annotations.json.")
    ] = None,
    recipe: Annotated[str, typer.Option(metavar="precise|FILE", help="How to look.")] = "precise",
    classes: ClassesFolder = None,
    dry: Annotated[bool, typer.Option("--dry", help="Only say how well it would do.")] = False,
    model: Annotated[
        Path | None, typer.Option(metavar="FILE.onnx", help="Learn a small network instead, and a recipe beside it.")
    ] = None,
    painted: Annotated[int, typer.Option(min=0, max=200_000, help="Network: learn shapes from so many crops.")] = 0,
    epochs: Annotated[int, typer.Option(min=1, max=500, help="Network: how often it sees every crop.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Network: of crops, weights and order.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="JSON on stdout, for machines.")] = False,
) -> None:
    """Learn the classes of a folder of annotated pictures, and say how well each way of learning does.

    Example: controller train photos

    A network of your own: controller train photos --model parts.onnx, then detect --recipe parts.toml. The one that
    ships was learnt by: controller train --painted 24000 --epochs 22 --model shapes.onnx

    Cross-validates, picture by picture, a support vector machine on the paper's variables, one on all features, and
    the nearest views; the views are kept as taught classes, usable in sorting rules at once.
    """
    if model is not None:
        _learn_network(model, folder, painted, recipe, epochs, seed, as_json)
        return
    if folder is None or painted:
        raise typer.BadParameter("name the folder of annotated pictures, or a network's file with --model")
    target = classes_folder(classes)
    examples, prints, missed = _examples(folder, recipe)
    counts = Counter(examples.labels)
    rare = [name for name, count in counts.items() if count < LEAST_VIEWS]
    if rare or len(counts) < 2:
        what = f"class {rare[0]!r} has {counts[rare[0]]} examples" if rare else f"{len(counts)} classes"
        raise InputError(f"{folder}: {what}", f"annotate {LEAST_VIEWS} objects and more of two classes and more")
    said = cross_validated(examples)
    share = {
        way: round(float(np.mean([a == b for a, b in zip(examples.labels, names, strict=True)])), 4)
        for way, names in said.items()
    }
    if not dry:
        _keep(examples, prints, target)
    if as_json:
        result = {"examples": len(examples.labels), "not_found": missed, "right": share, "kept": not dry}
        confusion = {way: by_class(examples.labels, names) for way, names in said.items()}
        print(json.dumps(result | {"confusion": confusion}))
        return
    console = stdout()
    console.print(f"{len(examples.labels)} examples of {len(counts)} classes, {missed} annotated objects not found")
    table = Table("way of learning", "right, unseen pictures", box=None, pad_edge=False)
    for way, value in share.items():
        table.add_row(way, f"{value:.1%}")
    console.print(table)
    nearest = by_class(examples.labels, said["nearest_views"])
    console.print(confusion_table({name: Counter(row) for name, row in nearest.items()}))
    if not dry:
        console.print(f"kept as taught classes in {target}")


def _learn_network(
    file: Path, folder: Path | None, painted: int, recipe: str, epochs: int, seed: int, as_json: bool
) -> None:
    if (folder is None) == (painted == 0):
        raise typer.BadParameter("a network learns from a folder, or from --painted crops")
    names, seen, new = learn_folder(folder, recipe) if folder is not None else learn_painted(painted, seed)
    say = stderr().print
    settings, written, right = learn_network(file, names, seen, new, epochs=epochs, seed=seed, say=say)
    if as_json:
        result = {"model": settings.file, "sha256": settings.sha256, "recipe": str(written), "classes": list(names)}
        print(json.dumps(result | {"learnt": len(seen.labels), "new": len(new.labels), "right": round(right, 4)}))
        return
    stdout().print(f"{settings.file}: {right:.1%} of {len(new.labels)} new crops right; use it with --recipe {written}")


def _examples(folder: Path, recipe: str) -> tuple[Examples, NDArray[np.uint8], int]:
    """Every annotated object that detection finds, what is printed on each, and how many it does not find."""
    looking = Looking(recipe)
    labels, pictures = [], []
    prints = [np.zeros((0, SIDE, SIDE), np.uint8)]
    rows, papers, missed = [np.empty((0, LENGTH), np.float32)], [np.empty((0, 3))], 0
    for entry in read_annotations(folder / FILE)["images"]:
        detections, surfaces, plane = looking.at(folder / Path(entry["file"]).name, whole_only=False)
        values = features(detections, surfaces, plane)
        seen = [detections[k] for k in surfaces.which]
        for thing in entry["objects"]:
            if thing.get("cut_by_border"):
                continue
            near = [math.dist(item.center_px, thing["centre_px"]) / max(item.size_px) for item in seen]
            if not near or min(near) > _NEAR:
                missed += 1
                continue
            k = int(np.argmin(near))
            item = seen[k]
            relative = item.descriptors.side_difference / math.sqrt(max(item.area_px, 1.0))
            papers.append(np.array([[item.descriptors.extent, item.descriptors.compactness, relative]]))
            rows.append(values[k : k + 1])
            prints.append(tiles_of(surfaces.image, [item]))
            labels.append(checked_name(thing.get("label", thing["class"])))
            pictures.append(entry["file"])
    stacked = np.concatenate(papers).astype(np.float32), np.concatenate(rows)
    return Examples(tuple(labels), tuple(pictures), *stacked), np.concatenate(prints), missed


def _keep(examples: Examples, prints: NDArray[np.uint8], target: Path) -> None:
    """Save the examples as taught classes, beside those of other names."""
    names = np.array(examples.labels)
    new = [
        TaughtClass(
            str(name),
            "px",
            examples.features[names == name],
            tuple(p for p, own in zip(examples.pictures, names == name, strict=True) if own),
            prints[names == name],
        )
        for name in np.unique(names)
    ]
    kept = [item for item in load_classes(target) if item.name not in set(examples.labels)]
    # Refuses classes in other units before anything is written.
    Taught((*kept, *new))
    for item in new:
        save_class(target, item)


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("train")(train)

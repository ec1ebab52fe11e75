"""`controller annotate`: propose what lies in a folder's pictures, for people to correct and machines to learn from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from controller.cli.classes import ClassesFolder
from controller.cli.detect import picture_files
from controller.cli.looking import Looking
from controller.cli.output import stdout
from controller.domain import Detection, Shape
from controller.errors import InputError
from controller.vision.classes.store import load_classes
from controller.vision.classes.taught import Taught
from controller.vision.read import read_image

FILE = "annotations.json"
_FLAGS = ("hole", "touching", "cut_by_border")


def annotate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of pictures.")],
    recipe: Annotated[str, typer.Option(metavar="precise|FILE", help="How to look.")] = "precise",
    classes: ClassesFolder = None,
    again: Annotated[bool, typer.Option("--again", help="Propose anew also where annotations exist.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="JSON on stdout, for machines.")] = False,
) -> None:
    """Propose annotations for the pictures of a folder and write them into its annotations.json.

    Example: controller annotate photos

    Correct the file by hand; what stands there is never changed by a second call, only new pictures are added, unless
    with --again. With --classes, taught names take the place of the shapes' names.
    """
    files = picture_files([folder])
    path = folder / FILE
    content = read_annotations(path) if path.exists() else _empty()
    known = {entry["file"]: entry for entry in content["images"]}
    taught = Taught(load_classes(classes)) if classes is not None else None
    if taught is not None:
        content["classes"] = list(dict.fromkeys([*content["classes"], *taught.classifier.names]))
    looking = Looking(recipe)
    added = 0
    for file in files:
        if file.name in known and not again:
            continue
        detections, surfaces, plane = looking.at(file, whole_only=False)
        if taught is not None:
            detections = taught.label(detections, surfaces, plane)
        height, width = read_image(file).shape[:2]
        objects = [_object(item) for item in detections]
        known[file.name] = {"file": file.name, "size": [width, height], "n": len(objects), "objects": objects}
        added += len(objects)
    content["images"] = [known[name] for name in sorted(known)]
    part = path.with_name(FILE + ".part")
    part.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    part.replace(path)
    if as_json:
        print(json.dumps({"file": str(path), "images": len(known), "proposed": added}))
    else:
        stdout().print(f"{added} objects proposed; look them over in {path}")


def read_annotations(path: Path) -> dict[str, Any]:
    """The annotations in a file.

    Raises:
        InputError: It cannot be read or is no such file.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        for entry in content["images"]:
            entry["file"] + ""
            for thing in entry["objects"]:
                thing["class"] + ""
                tuple(float(v) for v in thing["centre_px"])
        content["classes"] = [str(name) for name in content.get("classes", [])]
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror})", "make it with controller annotate DIR") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} holds no annotations ({error})", "mend it, or make it anew") from error
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no annotations", "mend it, or make it anew")
    return content


def _empty() -> dict[str, Any]:
    return {"classes": [str(s) for s in Shape], "units": "pixels; x right, y down; bbox = x,y,w,h", "images": []}


def _object(item: Detection) -> dict[str, Any]:
    thing: dict[str, Any] = {
        "class": item.label or str(item.shape),
        "centre_px": [round(v, 1) for v in item.center_px],
        "bbox_px": [round(v) for v in item.bbox_px],
        "area_px": round(item.area_px, 1),
        "min_rect_px": [round(v, 1) for v in item.size_px],
        "outline_px": [[round(float(x), 1), round(float(y), 1)] for x, y in item.outline_px],
    }
    if item.colour is not None:
        thing["colour"] = item.colour
    return thing | {flag: True for flag in _FLAGS if flag in item.flags}


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("annotate")(annotate)

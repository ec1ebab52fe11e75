"""`controller annotate`: propose what lies in a folder's pictures, for people to correct and machines to learn from."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from controller.cli.classes import ClassesFolder
from controller.cli.detect import picture_files
from controller.cli.looking import Looking
from controller.cli.output import stdout
from controller.domain import Detection, Shape
from controller.errors import InputError
from controller.vision.appearance.look import Names, named
from controller.vision.classes.store import checked_name, load_classes
from controller.vision.classes.taught import Taught
from controller.vision.read import read_image

FILE = "annotations.json"
_CORRECTION = re.compile(r"(.+):(\d+)=(.*)")
_FLAGS = ("hole", "touching", "cut_by_border")


def annotate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of pictures.")],
    recipe: Annotated[str, typer.Option(metavar="precise|FILE", help="How to look.")] = "precise",
    classes: ClassesFolder = None,
    corrections: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="PICTURE:NUMBER=NAME", help="Correct an object; an empty NAME takes it out."),
    ] = None,
    save: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write the pictures with every object's number and name.")
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Propose anew also where annotations exist.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="JSON on stdout, for machines.")] = False,
) -> None:
    """Propose annotations for the pictures of a folder and write them into its annotations.json.

    Examples: controller annotate photos --save look | controller annotate photos --set 'nut_*.png:1=nut' --set
    nut_3.png:2=washer --set nut_4.png:1=

    Look the saved pictures over and correct by number, or edit the file: `class` is the shape, `label` what you call
    it; `train` learns labels, `evaluate --images` compares shapes. Naming a shape drops the label: to say both, name
    the shape first. What stands there is never changed by a second call, only new pictures are added, unless with
    --again. With --classes, taught names become labels.
    """
    files = picture_files([folder])
    path = folder / FILE
    content = read_annotations(path) if path.exists() else _empty()
    known = {entry["file"]: entry for entry in content["images"]}
    taught = Taught(load_classes(classes)) if classes is not None else None
    if taught is not None:
        content["classes"] = list(dict.fromkeys([*content["classes"], *taught.classifier.names]))
    looking = Looking(recipe)
    added = corrected = 0
    if corrections:
        # Nothing new is proposed while the numbers of old proposals are meant.
        corrected = _correct(content["images"], corrections)
        files = []
    for file in files:
        if file.name in known and not again:
            continue
        detections, surfaces, plane = looking.at(file, whole_only=False)
        if taught is not None:
            detections = named(detections, surfaces, Names(), taught.names(detections, surfaces, plane))
        height, width = read_image(file).shape[:2]
        objects = [_object(item) for item in detections]
        known[file.name] = {"file": file.name, "size": [width, height], "n": len(objects), "objects": objects}
        added += len(objects)
    content["images"] = [known[name] for name in sorted(known)]
    if save is not None:
        _save(folder, content["images"], save)
    part = path.with_name(FILE + ".part")
    part.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    part.replace(path)
    if as_json:
        print(json.dumps({"file": str(path), "images": len(known), "proposed": added, "corrected": corrected}))
    elif corrections:
        stdout().print(f"{corrected} corrected in {path}")
    else:
        stdout().print(f"{added} objects proposed; look them over in {path}")


def _correct(entries: list[dict[str, Any]], corrections: list[str]) -> int:
    """Change or take out single objects, all or none, and say how many.

    Raises:
        InputError: A correction names a picture or an object that is not there.
    """
    known = {entry["file"]: entry for entry in entries}
    out: list[tuple[dict[str, Any], dict[str, Any]]] = []
    changed = 0
    for text in corrections:
        found = _CORRECTION.fullmatch(text)
        if not found:
            raise InputError(f"{text!r} is no correction", "write it as picture.png:2=name")
        number, said = int(found[2]), found[3].strip()
        for entry in _meant(found[1], number, known):
            thing = entry["objects"][number - 1]
            changed += 1
            if not said:
                out.append((entry, thing))
            elif said in set(Shape):
                thing["class"] = said
                thing.pop("label", None)
            else:
                thing["label"] = checked_name(said)
    for entry, thing in out:
        entry["objects"] = [other for other in entry["objects"] if other is not thing]
        entry["n"] = len(entry["objects"])
    return changed


def _meant(name: str, number: int, known: Mapping[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """The picture of a name, or all whose names match it as a pattern, that have an object of a number.

    Raises:
        InputError: There is none.
    """
    meant = [known[name]] if name in known else [entry for file, entry in known.items() if fnmatchcase(file, name)]
    if not meant:
        raise InputError(f"no annotated picture {name!r}", f"there are {', '.join(sorted(known)[:5])}, ...")
    having = [entry for entry in meant if 1 <= number <= len(entry["objects"])]
    if not having:
        most = max(len(entry["objects"]) for entry in meant)
        raise InputError(f"{name} has no object {number}, it has {most}", "see --save for the numbers")
    return having


def _save(folder: Path, entries: list[dict[str, Any]], save: Path) -> None:
    """Pictures with every annotated object's box, number and name."""
    save.mkdir(parents=True, exist_ok=True)
    for entry in entries:
        image = read_image(folder / Path(entry["file"]).name)
        grow = max(1, round(900 / image.shape[1]))
        picture = np.asarray(cv2.resize(image, None, fx=grow, fy=grow, interpolation=cv2.INTER_CUBIC), np.uint8)
        for number, thing in enumerate(entry["objects"], 1):
            x, y, w, h = (round(grow * float(v)) for v in thing["bbox_px"])
            cv2.rectangle(picture, (x, y), (x + w, y + h), (0, 159, 230), 2, cv2.LINE_AA)
            text, at = f"{number} {thing.get('label', thing['class'])}", (x, max(16, y - 6))
            cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (30, 30, 30), 4, cv2.LINE_AA)
            cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (250, 250, 250), 1, cv2.LINE_AA)
        if not cv2.imwrite(str(save / f"{Path(entry['file']).stem}.png"), picture):
            raise InputError(f"{save} cannot be written", "name another folder with --save")


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
        "class": str(item.shape),
        "centre_px": [round(v, 1) for v in item.center_px],
        "bbox_px": [round(v) for v in item.bbox_px],
        "area_px": round(item.area_px, 1),
        "min_rect_px": [round(v, 1) for v in item.size_px],
        "outline_px": [[round(float(x), 1), round(float(y), 1)] for x, y in item.outline_px],
    }
    if item.label and item.label != str(item.shape):
        thing["label"] = item.label
    if item.colour is not None:
        thing["colour"] = item.colour
    return thing | {flag: True for flag in _FLAGS if flag in item.flags}


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("annotate")(annotate)

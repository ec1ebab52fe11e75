"""A recipe on annotated photographs: what was named what, missed and made up, and how far centres and boxes are off.

The annotations are files `annotations.json` with a list `images` of `file`, `size` and `objects`; an object has
`class`, `centre_px`, `bbox_px` (x, y, width, height) and flags such as `cut_by_border`.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from controller.domain import Detection, Frame, Shape
from controller.errors import InputError
from controller.insight.charts import histogram, matrix
from controller.insight.evaluation import bounds, confusion
from controller.insight.page import head, table, text
from controller.insight.statistics import spread
from controller.vision.annotate import annotate
from controller.vision.detect import detect
from controller.vision.read import read_image
from controller.vision.recipe import Recipe

Box = tuple[float, float, float, float]

SAME_OBJECT = 0.5
"""Boxes of one object share at least this part of their union.

Source: the PASCAL VOC detection challenge, the usual bound for "found".
"""
MOST_PICTURES = 16
_MISSED_COLOUR, _WRONG_COLOUR = (60, 60, 235), (0, 140, 255)


@dataclass(frozen=True, slots=True)
class Annotated:
    """One object as people have marked it.

    Attributes:
        shape: What it is.
        center: px.
        box: (x, y, width, height), px.
        flags: Those that are true, e.g. `cut_by_border`, `touching`, `hole`.
        note: For people.
    """

    shape: Shape
    center: tuple[float, float]
    box: Box
    flags: frozenset[str]
    note: str


@dataclass(frozen=True, slots=True)
class Match:
    """An annotated object and the detection that shows it; errors in px."""

    true: Annotated
    found: Detection
    center_error: float
    box_error: float


@dataclass(slots=True)
class Picture:
    """One photograph, compared.

    Attributes:
        name: Its path below the folder that was evaluated.
        image: ndarray of shape (H, W, 3), dtype uint8.
        detections: What was found.
        matches: Found objects.
        missed: Annotated objects that were not found, those cut by the border aside.
        false: Detections that are no annotated object, those cut by the border aside.
        excused: Objects and detections cut by the border that have no counterpart.
        time_ms: Detection, ms.
    """

    name: str
    image: NDArray[np.uint8]
    detections: tuple[Detection, ...]
    matches: list[Match] = field(default_factory=list)
    missed: list[Annotated] = field(default_factory=list)
    false: list[Detection] = field(default_factory=list)
    excused: int = 0
    time_ms: float = 0.0

    @property
    def wrong(self) -> list[Match]:
        """Found, but taken for something else."""
        return [match for match in self.matches if match.true.shape is not match.found.shape]

    @property
    def errors(self) -> int:
        """Missed, made up, or taken for something else."""
        return len(self.missed) + len(self.false) + len(self.wrong)


def annotated_pictures(folder: Path) -> Iterator[tuple[Path, list[Annotated]]]:
    """Every annotated picture of a folder and the folders below it.

    Raises:
        InputError: There is none, or an `annotations.json` is not as described above.
    """
    files = sorted(folder.rglob("annotations.json"))
    if not files:
        raise InputError(f"{folder} holds no annotations.json", "name a folder of annotated pictures")
    for path in files:
        try:
            images = json.loads(path.read_text(encoding="utf-8"))["images"]
            entries = [
                (path.parent / image["file"], [_annotated(entry) for entry in image["objects"]]) for image in images
            ]
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            remedy = "see the format in controller/insight/images_evaluation.py"
            raise InputError(f"{path} is not as expected ({type(error).__name__}: {error})", remedy) from error
        yield from entries


def _annotated(entry: Mapping[str, Any]) -> Annotated:
    u, v = entry["centre_px"]
    x, y, width, height = (float(value) for value in entry["bbox_px"])
    if not all(map(math.isfinite, (float(u), float(v), x, y, width, height))):
        raise ValueError("a figure is not finite")
    flags = frozenset(key for key, value in entry.items() if value is True)
    return Annotated(Shape(entry["class"]), (float(u), float(v)), (x, y, width, height), flags, entry.get("note", ""))


def evaluate_images(folder: Path, recipe: Recipe) -> Iterator[Picture]:
    """Look at every annotated picture of a folder and compare.

    Raises:
        InputError: See `annotated_pictures`; a picture cannot be read.
    """
    for number, (path, objects) in enumerate(annotated_pictures(folder), 1):
        image = read_image(path)
        detected = detect(Frame(number, 0.0, image, str(path)), recipe)
        picture = compare(str(path.relative_to(folder)), image, objects, detected.detections)
        picture.time_ms = detected.timing_ms["total"]
        yield picture


def compare(
    name: str, image: NDArray[np.uint8], objects: Sequence[Annotated], detections: tuple[Detection, ...]
) -> Picture:
    """Find for every annotated object the detection that shows it, so that the boxes agree best as a whole."""
    picture = Picture(name, image, detections)
    shared = np.array([[overlap(item.box, found.bbox_px) for found in detections] for item in objects])
    shared = shared.reshape(len(objects), len(detections))
    rows, columns = linear_sum_assignment(np.where(shared >= SAME_OBJECT, shared, 0.0), maximize=True)
    pairs = [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if shared[i, j] >= SAME_OBJECT]
    for i, j in pairs:
        true, found = objects[i], detections[j]
        error = math.dist(true.center, found.center_px)
        picture.matches.append(Match(true, found, error, _box_error(true.box, found.bbox_px)))
    taken, shown = {i for i, _ in pairs}, {j for _, j in pairs}
    for index, item in enumerate(objects):
        if index not in taken:
            if "cut_by_border" in item.flags:
                picture.excused += 1
            else:
                picture.missed.append(item)
    for index, found in enumerate(detections):
        if index not in shown:
            if "cut_by_border" in found.flags:
                picture.excused += 1
            else:
                picture.false.append(found)
    return picture


def overlap(a: Box, b: Box) -> float:
    """Common area of two boxes over the area of their union."""
    width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    common = width * height
    return common / (a[2] * a[3] + b[2] * b[3] - common)


def _box_error(a: Box, b: Box) -> float:
    """How far the farthest side of one box is from the other's, px."""
    corners = ((a[0], b[0]), (a[1], b[1]), (a[0] + a[2], b[0] + b[2]), (a[1] + a[3], b[1] + b[3]))
    return max(abs(p - q) for p, q in corners)


# --- figures ----------------------------------------------------------------------------------------------


def summary(folder: Path, recipe: str, pictures: Sequence[Picture]) -> dict[str, Any]:
    """The figures of an evaluation as JSON; lengths px, times ms."""
    matches = [match for picture in pictures for match in picture.matches]
    missed = [item for picture in pictures for item in picture.missed]
    false = [item for picture in pictures for item in picture.false]
    right = sum(match.true.shape is match.found.shape for match in matches)
    objects = len(matches) + len(missed)
    pairs = [(str(match.true.shape), str(match.found.shape)) for match in matches]
    pairs += [(str(item.shape), "missed") for item in missed]
    pairs += [("nothing", str(item.shape)) for item in false]
    return {
        "mode": "images",
        "folder": str(folder),
        "recipe": recipe,
        "images": len(pictures),
        "objects": objects,
        "found": len(matches),
        "right": right,
        "wrong": len(matches) - right,
        "missed": len(missed),
        "false": len(false),
        "cut_by_border": sum(picture.excused for picture in pictures),
        "rates": {
            "found": bounds(len(matches), objects),
            "found and named rightly": bounds(right, objects),
            "false of detections": bounds(len(false), len(false) + len(matches)),
        },
        "center_error_px": spread([match.center_error for match in matches], ("mean", "median", "p95", "max")),
        "box_error_px": spread([match.box_error for match in matches], ("mean", "median", "p95", "max")),
        "time_ms": spread([picture.time_ms for picture in pictures], ("median", "max")),
        "confusion": confusion(pairs),
        "by_image": [
            {
                "image": picture.name,
                "right": len(picture.matches) - len(picture.wrong),
                "wrong": [f"{m.true.shape} taken for {m.found.shape}" for m in picture.wrong],
                "missed": [str(item.shape) for item in picture.missed],
                "false": [str(item.shape) for item in picture.false],
            }
            for picture in pictures
        ],
    }


_NAMES = {
    "images": "pictures",
    "objects": "annotated objects, those cut by the border and not found aside",
    "found": "of them found",
    "right": "and named rightly",
    "wrong": "found, but taken for something else",
    "missed": "not found",
    "false": "found where nothing is annotated",
    "cut_by_border": "cut by the border, not counted",
    "center_error_px": "centre against the annotation, px (annotated to 1 to 3 px)",
    "box_error_px": "box against the annotation, farthest side, px",
    "time_ms": "time of a picture, ms",
}


def rows(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures as (name, value), in words a person reads."""
    lines = [(name, text(figures[key])) for key, name in _NAMES.items()]
    for name, rate in figures["rates"].items():
        if rate["value"] is not None:
            lines.append((name, f"{100 * rate['value']:.2f} % ({100 * rate['low']:.1f} to {100 * rate['high']:.1f} %)"))
    return lines


# --- the page ---------------------------------------------------------------------------------------------


def page(figures: Mapping[str, Any], pictures: Sequence[Picture]) -> str:
    """A self-contained HTML page with the worst pictures: most errors first, then those whose boxes are off most."""
    title = f"Recipe {figures['recipe']} on annotated pictures"
    lines = [head(title), table(rows(figures))]
    lines.append(matrix(figures["confusion"], "What was seen", "true \\ seen"))
    errors = [match.center_error for picture in pictures for match in picture.matches]
    lines.append(histogram(errors, "Centre against the annotation", "px"))
    lines.append("<h2>The worst pictures</h2><p>Red boxes: not found. Orange boxes: taken for something else.</p>")
    for picture in worst(pictures)[:MOST_PICTURES]:
        told = mistakes(picture) or "all right"
        data = base64.b64encode(_jpeg(marked(picture))).decode()
        name = html.escape(picture.name)
        lines.append(f"<figure><figcaption><b>{name}</b>: {html.escape(told)}</figcaption>")
        lines.append(f'<img alt="{name}" style="max-width:100%" src="data:image/jpeg;base64,{data}"></figure>')
    return "\n".join(lines) + "</html>\n"


def mistakes(picture: Picture) -> str:
    """What is wrong in a picture, most frequent first, e.g. `circle taken for other (3); square missed`."""
    wrong = [f"{match.true.shape} taken for {match.found.shape}" for match in picture.wrong]
    missed = [f"{item.shape} missed{f' ({item.note})' if item.note else ''}" for item in picture.missed]
    made_up = [f"{item.shape} made up" for item in picture.false]
    counted = Counter([*wrong, *missed, *made_up]).most_common()
    return "; ".join(name if times == 1 else f"{name} ({times})" for name, times in counted)


def worst(pictures: Sequence[Picture]) -> list[Picture]:
    """The pictures, most errors first, then by the largest box error."""

    def badness(picture: Picture) -> tuple[int, float]:
        return picture.errors, max((match.box_error for match in picture.matches), default=0.0)

    return sorted(pictures, key=badness, reverse=True)


def marked(picture: Picture) -> NDArray[np.uint8]:
    """The picture with everything found, and boxes around what was missed or taken for something else."""
    canvas = annotate(picture.image, picture.detections)
    grow = canvas.shape[1] / picture.image.shape[1]
    marks = [(item.box, _MISSED_COLOUR, f"missed: {item.shape}") for item in picture.missed]
    marks += [(match.true.box, _WRONG_COLOUR, f"is: {match.true.shape}") for match in picture.wrong]
    for (x, y, width, height), colour, name in marks:
        low = round((x + 0.5) * grow - 0.5), round((y + 0.5) * grow - 0.5)
        high = round((x + width) * grow), round((y + height) * grow)
        cv2.rectangle(canvas, low, high, colour, 2, cv2.LINE_AA)
        cv2.putText(canvas, name, (low[0], high[1] + 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    return canvas


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return data.tobytes()

"""How well twelve colours are named under fifty lamps, with and without a gray card; and on real pictures.

    python tests/benchmarks/colour.py
    python tests/benchmarks/colour.py --shared ../shared/data
    python tests/benchmarks/colour.py --cells 10 --level dynamic

Lamps: black bodies of 2700 to 6500 K, exposure 0.5 to 2 times, a gradient of up to 40 % across the picture. The
exposure at 1x is chosen so that white under the brightest lamp is just not clipped. The camera's own white balance
stands at 6500 K. Every part's dye differs a little from the palette's.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections import Counter
from pathlib import Path
from time import process_time

import cv2
import numpy as np

from controller.domain import Frame
from controller.errors import InputError
from controller.vision.appearance.colour import measure
from controller.vision.appearance.settings import Appearance
from controller.vision.appearance.tiles import tiles
from controller.vision.detect import detect
from controller.vision.read import read_image
from controller.vision.recipe import load_recipe
from tests.benchmarks import surfaces
from tests.benchmarks.cell_vision import look_at_cell
from tests.benchmarks.surfaces import SQUARE, Image, Thing, polygon
from tests.benchmarks.texture import detection_of

# BGR codes in white light: paints of the middle of each name, none of them a place of the palette.
PAINTS: dict[str, tuple[int, int, int]] = {
    "red": (40, 36, 190),
    "orange": (30, 125, 238),
    "yellow": (50, 205, 235),
    "green": (70, 150, 55),
    "cyan": (195, 185, 30),
    "blue": (180, 80, 35),
    "purple": (145, 55, 115),
    "pink": (170, 125, 235),
    "brown": (38, 66, 112),
    "black": (28, 28, 28),
    "gray": (128, 128, 128),
    "white": (240, 240, 240),
}
CARD = (188, 188, 188)  # half of the light
CARD_PX = (20, 20, 48, 48)
SIZE = (480, 400)


def scene(random: np.random.Generator, lamp: int, table: tuple[int, int, int]) -> tuple[Image, list[Thing], list[str]]:
    """The twelve paints on a table with a gray card, under the lamp of that number."""
    kelvin = 2700.0 + 3800.0 * (lamp % 10) / 9.0
    gain = 0.28 * 2.0 ** (2.0 * (lamp // 10) / 4.0 - 1.0) * 2.0
    names = list(PAINTS)
    random.shuffle(names)
    things = [Thing([np.asarray(SQUARE * 30.0)], (CARD, CARD), 43.5, 43.5, 0.0)]
    for k, name in enumerate(names):
        dye = np.clip(np.array(PAINTS[name]) * (1.0 + 0.04 * random.standard_normal(3)), 0, 250)
        code = (int(dye[0]), int(dye[1]), int(dye[2]))
        ring = np.asarray((SQUARE if k % 2 else polygon(48)) * float(random.uniform(18, 30)))
        turn = float(random.uniform(-math.pi, math.pi))
        things.append(Thing([ring], (code, code), 130.0 + 90.0 * (k % 4), 90.0 + 105.0 * (k // 4), turn))
    light = surfaces.field(SIZE, kelvin, gain, float(random.uniform(0.0, 0.4)), float(random.uniform(-3, 3)))
    picture = surfaces.paint(things, SIZE, random, light=light, blur=0.8, noise=2.5, table=table)
    return picture, things[1:], names


def lamps(seed: int, settings: Appearance, table: tuple[int, int, int]) -> tuple[int, int, Counter[str], list[float]]:
    """Right, all, what was mistaken for what, and ms a frame of twelve parts, over fifty lamps."""
    random = np.random.default_rng([seed, 5])
    right, count, mistaken, times = 0, 0, Counter[str](), []
    for lamp in range(50):
        picture, things, names = scene(random, lamp, table)
        frame = Frame(1, 0.0, picture)
        detections = [detection_of(thing, frame) for thing in things]
        began = process_time()
        seen = measure(picture, tiles(picture, detections), settings)
        times.append(1e3 * (process_time() - began))
        for name, colour in zip(names, seen, strict=True):
            count += 1
            right += colour.name == name
            if colour.name != name:
                mistaken[f"{name} -> {colour.name}"] += 1
    return right, count, mistaken, times


def real(folder: Path) -> None:
    """Colours in photographs, against their annotations."""
    recipe = load_recipe("precise")
    total: Counter[str] = Counter()
    for path in sorted(folder.glob("*/annotations.json")):
        for entry in json.loads(path.read_text(encoding="utf-8"))["images"]:
            wanted = [thing for thing in entry["objects"] if "colour" in thing]
            if not wanted:
                continue
            try:
                picture = read_image(path.parent / entry["file"])
            except InputError:
                continue
            found = detect(Frame(1, 0.0, picture), recipe).detections
            parts = tiles(picture, found)
            seen = measure(picture, parts, Appearance())
            right, missed, wrong = 0, 0, Counter[str]()
            for thing in wanted:
                name = thing["colour"].replace("grey", "gray")
                near = [math.dist(item.center_px, thing["centre_px"]) for item in parts.detections]
                if not near or min(near) > 0.4 * max(thing["bbox_px"][2:]):
                    missed += 1
                elif seen[int(np.argmin(near))].name == name:
                    right += 1
                else:
                    wrong[f"{name} -> {seen[int(np.argmin(near))].name}"] += 1
            # What lies beside the annotated objects was counted though nobody asked for it.
            boxes = [thing["bbox_px"] for thing in entry["objects"]]
            more = sum(not any(_holds(box, item.center_px) for box in boxes) for item in found)
            line = {"picture": f"{path.parent.name}/{entry['file']}", "coloured": len(wanted), "right": right}
            print(json.dumps(line | {"not_found": missed, "wrong": dict(wrong), "more": more}), flush=True)
            total.update(coloured=len(wanted), right=right, not_found=missed, wrong=sum(wrong.values()), more=more)
    verdict = "all right" if total["right"] == total["coloured"] and not total["more"] else "not all right"
    print(json.dumps({"all": total, "verdict": verdict}))


def _holds(box: list[float], point: tuple[float, float]) -> bool:
    x, y, w, h = box
    return x <= point[0] <= x + w and y <= point[1] <= y + h


def cells(count: int, level: str) -> None:
    """Colours of the painted parts of simulated cells, as detection names them, against the truth."""
    right, wrong = 0, Counter[str]()
    times = []
    for seed in range(2000, 2000 + count):
        with tempfile.TemporaryDirectory() as folder:
            seen = look_at_cell(seed, 20, level, Path(folder))
        times.append(seen.detected.timing_ms["appearance"])
        for thing in seen.located.objects:
            part = min(seen.truth, key=lambda part: math.dist(part.center, thing.center))
            if math.dist(part.center, thing.center) > 15.0:
                continue
            if thing.detection.colour == part.colour:
                right += 1
            else:
                wrong[f"{part.colour} -> {thing.detection.colour}"] += 1
    figures = {"cells": count, "level": level, "right": right, "wrong": dict(wrong)}
    print(json.dumps(figures | {"appearance_ms": round(float(np.median(times)), 2)}))


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--shared", type=Path, help="folder of annotated photographs")
    parser.add_argument("--cells", type=int, default=0, help="look at so many simulated cells of 20 parts instead")
    parser.add_argument("--level", type=str, default="dynamic")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.cells:
        cells(arguments.cells, arguments.level)
        return
    if arguments.shared:
        real(arguments.shared)
        return
    for title, settings, table in (
        ("gray card", Appearance(reference="patch", patch_px=CARD_PX), surfaces.TABLE),
        ("gray card, brown table", Appearance(reference="patch", patch_px=CARD_PX), (62, 92, 130)),
        ("gray card, black table", Appearance(reference="patch", patch_px=CARD_PX), (30, 30, 30)),
        ("the table is gray", Appearance(reference="table"), surfaces.TABLE),
        ("auto", Appearance(), surfaces.TABLE),
        ("nothing", Appearance(reference="none"), surfaces.TABLE),
    ):
        right, count, mistaken, times = lamps(arguments.seed, settings, table)
        line: dict[str, object] = {"reference": title, "right_percent": round(100 * right / count, 2), "parts": count}
        line |= {"frame_of_12_ms": round(float(np.median(times)), 2)}
        print(json.dumps(line | {"wrong": dict(mistaken.most_common(6))}))


if __name__ == "__main__":
    main()

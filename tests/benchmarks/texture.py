"""How well textures are named: six of them, any rotation, parts of 20 to 60 px, two blurs, noise.

    python tests/benchmarks/texture.py --views 200           # the figures, on views no training saw
    python tests/benchmarks/texture.py --train               # writes the shipped model from other seeds

Prints the confusion matrix, a figure for each width and the time a frame of 20 parts takes.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from time import process_time

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Descriptors, Detection, Frame, Shape
from controller.vision.appearance import naming, texture
from controller.vision.appearance.tiles import tiles
from tests.benchmarks import surfaces
from tests.benchmarks.surfaces import SQUARE, Floats, Image, Pattern, Thing, polygon

NAMES = ("plain", "striped", "checked", "dotted", "rough", "marbled")
_GRID = (5, 4)
_CELL = 96
_SHAPES = ([SQUARE], [polygon(48)], [polygon(6)], [SQUARE * (1.2, 0.8)])


def pattern_of(name: str, width: float, random: np.random.Generator) -> Pattern:
    """A texture for a part of this width, px: at least two and a half periods across, periods of 4.5 px and more."""
    # Two pixels a bar and the blur of a lens is what a camera resolves.
    pitch = float(random.uniform(max(4.5, width / 9.0), max(5.5, width / 3.0)))
    phase = float(random.uniform())
    if name == "plain":
        return surfaces.plain()
    if name == "striped":
        return surfaces.striped(pitch, phase)
    if name == "checked":
        return surfaces.checked(1.3 * pitch, phase)
    if name == "dotted":
        return surfaces.dotted(pitch, phase)
    if name == "rough":
        return surfaces.blotched(random, float(random.uniform(0.5, 0.9)))
    return surfaces.blotched(random, float(random.uniform(0.10, 0.16)) * width, 0.4)


def _code(values: NDArray[np.int64]) -> tuple[int, int, int]:
    return int(values[0]), int(values[1]), int(values[2])


def detection_of(thing: Thing, frame: Frame) -> Detection:
    """What detection would hand on about a part, by its truth."""
    ring = surfaces.outline(thing)
    low, high = ring.min(axis=0), ring.max(axis=0)
    (_, (w, h), _) = cv2.minAreaRect(ring.astype(np.float32))
    area = float(cv2.contourArea(ring.astype(np.float32)))
    middle = ring.mean(axis=0)
    return Detection(
        frame, Shape.OTHER, 1.0, ring, (float(middle[0]), float(middle[1])), (max(w, h), min(w, h)), 0.0, area,
        (float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])), Descriptors(1.0, 1.0, 0.0),
    )  # fmt: skip


def scene(random: np.random.Generator) -> tuple[Image, list[Thing], list[str], list[float]]:
    """A picture of 20 parts, what their textures are, and how wide they are, px."""
    things, names, widths = [], [], []
    for k in range(_GRID[0] * _GRID[1]):
        name = NAMES[int(random.integers(len(NAMES)))]
        width = float(random.uniform(20.0, 60.0))
        rings = [np.asarray(ring * width / 1.6, np.float64) for ring in _SHAPES[int(random.integers(len(_SHAPES)))]]
        dark = random.integers(20, 130, 3)
        light = np.clip(dark + random.integers(50, 110, 3), 0, 250)
        dark_first = random.uniform() < 0.5
        colours = (_code(dark), _code(light)) if dark_first else (_code(light), _code(dark))
        x = (k % _GRID[0] + 0.5) * _CELL + float(random.uniform(-3, 3))
        y = (k // _GRID[0] + 0.5) * _CELL + float(random.uniform(-3, 3))
        turn = float(random.uniform(-math.pi, math.pi))
        things.append(Thing(rings, colours, x, y, turn, pattern_of(name, width, random)))
        names.append(name)
        widths.append(width)
    size = (_GRID[0] * _CELL, _GRID[1] * _CELL)
    light_field = surfaces.field(size, 5500.0, float(random.uniform(0.6, 1.2)), 0.2, float(random.uniform(-3, 3)))
    blur = (0.5, 0.9)[int(random.integers(2))]
    noise = float(random.uniform(1, 4))
    return surfaces.paint(things, size, random, light=light_field, blur=blur, noise=noise), things, names, widths


def dataset(seed: int, scenes: int) -> tuple[NDArray[np.float32], list[str], Floats, float]:
    """Descriptors, names, widths, and ms for a frame of 20 parts."""
    random = np.random.default_rng([seed, 77])
    rows, names, widths, times = [], [], [], []
    for _ in range(scenes):
        picture, things, said, wide = scene(random)
        frame = Frame(1, 0.0, picture)
        found = [detection_of(thing, frame) for thing in things]
        began = process_time()
        rows.append(texture.descriptors(tiles(picture, found)))
        times.append(1e3 * (process_time() - began))
        names += said
        widths += wide
    return np.concatenate(rows), names, np.array(widths), float(np.median(times))


def main() -> None:
    """Run the study, or train."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=200, help="scenes of 20 parts")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--train", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.train:
        values, names, _, _ = dataset(1000, 200)
        naming.fit(values, names, NAMES).save(texture.SHIPPED)
        return
    values, names, widths, time_ms = dataset(arguments.seed, arguments.views)
    said = texture.names_of(values)
    right = np.array([a == b for a, b in zip(names, said, strict=True)])
    share = round(100 * float(right.mean()), 2)
    print(json.dumps({"views": len(names), "right_percent": share, "frame_of_20_ms": round(time_ms, 2)}))
    for low in range(20, 60, 10):
        chosen = (widths >= low) & (widths < low + 10)
        print(json.dumps({"width_px": [low, low + 10], "right_percent": round(100 * float(right[chosen].mean()), 2)}))
    for name in NAMES:
        print(name, dict(Counter(b for a, b in zip(names, said, strict=True) if a == name)))


if __name__ == "__main__":
    main()

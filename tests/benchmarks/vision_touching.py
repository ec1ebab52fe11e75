"""Touching parts: pairs and triples of the five shapes, of one colour or several, drawn, detected, counted.

A part counts as right when something of its shape lies within a tenth of its size of its centre; what is found
elsewhere or under another name of the five is wrong; `other` for the group, or nothing, is refused.

Run: python -m tests.benchmarks.vision_touching [--seed 1] [--each 48] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection, Frame, Shape
from controller.vision.detect import detect
from controller.vision.recipe import load_recipe

Floats = NDArray[np.float64]

SHAPES = (Shape.SQUARE, Shape.RECTANGLE, Shape.CIRCLE, Shape.HEXAGON, Shape.TRIANGLE)
_FINE = 8
_SIZE = (1600, 900)
_GRID = (5, 3)
_MARGIN = 8.0
"""Pixels that stay free inside a cell's border, so that neither the frame nor the next group touches a part."""


def outline(shape: Shape, size: float, turn: float, aspect: float) -> Floats:
    """Corners (N, 2) about the centroid; `size` is the root of the area."""
    if shape is Shape.CIRCLE:
        t = np.arange(120) * math.pi / 60.0
        unit = np.stack([np.cos(t), np.sin(t)], axis=1)
    elif shape in (Shape.SQUARE, Shape.RECTANGLE):
        w = math.sqrt(aspect) if shape is Shape.RECTANGLE else 1.0
        unit = np.array([[-w, -1 / w], [w, -1 / w], [w, 1 / w], [-w, 1 / w]])
    else:
        sides = 6 if shape is Shape.HEXAGON else 3
        t = np.arange(sides) * 2.0 * math.pi / sides
        unit = np.stack([np.cos(t), np.sin(t)], axis=1)
    unit = unit * size / math.sqrt(abs(cv2.contourArea(unit.astype(np.float32))))
    c, s = math.cos(turn), math.sin(turn)
    return np.asarray(unit @ np.array([[c, -s], [s, c]]))


def group(count: int, rng: np.random.Generator) -> list[tuple[Shape, Floats]]:
    """Parts about the origin, one against another, drawn anew until they fit one cell of the picture."""
    room = 0.5 * np.array(_SIZE) / np.array(_GRID) - _MARGIN
    while True:
        parts = _pushed_together(count, rng)
        if (np.abs(np.concatenate([part for _, part in parts])) < room).all():
            return parts


def _pushed_together(count: int, rng: np.random.Generator) -> list[tuple[Shape, Floats]]:
    """Parts about the origin, each pushed against those before it until the gap is below a quarter pixel."""
    out: list[tuple[Shape, Floats]] = []
    for _ in range(count):
        shape = SHAPES[rng.integers(len(SHAPES))]
        part = outline(shape, rng.uniform(38.0, 62.0), rng.uniform(0.0, 2.0 * math.pi), rng.uniform(1.3, 2.2))
        if out:
            target = out[rng.integers(len(out))][1].mean(axis=0)
            way = rng.uniform(0.0, 2.0 * math.pi)
            step = np.array([math.cos(way), math.sin(way)])
            far, near = 220.0, 0.0
            while far - near > 0.2:
                middle = 0.5 * (far + near)
                moved = (part + target + middle * step).astype(np.float32)
                hit = any(_meet(moved, other.astype(np.float32)) for _, other in out)
                near, far = (middle, far) if hit else (near, middle)
            part = part + target + far * step
        out.append((shape, part))
    middle_of_all = np.concatenate([part for _, part in out]).mean(axis=0)
    return [(shape, part - middle_of_all) for shape, part in out]


def _meet(a: NDArray[np.float32], b: NDArray[np.float32]) -> bool:
    common, _ = cv2.intersectConvexConvex(a, b)
    return float(common) > 0.0 or cv2.pointPolygonTest(b, [float(v) for v in a.mean(axis=0)], False) >= 0.0


def draw(groups: list[list[Floats]], one_colour: bool, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Picture of groups on a lightly textured table, supersampled, blurred, with noise."""
    width, height = _SIZE
    table = 190.0 + rng.uniform(-15, 15)
    texture = cv2.resize(rng.standard_normal((height // 8 + 1, width // 8 + 1)).astype(np.float32), _SIZE)
    picture = np.repeat((table + 2.5 * texture / texture.std())[:, :, None], 3, axis=2)
    for parts in groups:
        shared = (table - rng.uniform(70, 140)) * (1.0 + rng.uniform(-0.1, 0.1, 3))
        for part in parts:
            colour = shared if one_colour else rng.uniform(20.0, 160.0, 3)
            low, high = np.floor(part.min(axis=0)).astype(int) - 2, np.ceil(part.max(axis=0)).astype(int) + 3
            w, h = high - low
            fine = np.zeros((h * _FINE, w * _FINE), np.uint8)
            points = np.rint(((part - low + 0.5) * _FINE - 0.5) * 256.0).astype(np.int32)
            cv2.fillPoly(fine, [points[:, None]], (1,), shift=8)
            cover = cv2.resize(fine.astype(np.float32), (int(w), int(h)), interpolation=cv2.INTER_AREA)[:, :, None]
            patch = picture[low[1] : high[1], low[0] : high[0]]
            patch[:] = patch * (1.0 - cover) + colour * cover
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8) + 3.0 * rng.standard_normal(picture.shape)
    return np.asarray(np.clip(np.rint(picture), 0, 255), np.uint8)


def count_group(parts: list[tuple[Shape, Floats]], seen: list[Detection]) -> Counter[str]:
    """What became of one group's parts, see above."""
    out: Counter[str] = Counter()
    free = list(seen)
    for shape, part in parts:
        middle, size = part.mean(axis=0), math.sqrt(abs(cv2.contourArea(part.astype(np.float32))))
        near = [d for d in free if d.shape is shape and math.dist(d.center_px, middle) < 0.1 * size]
        near = [d for d in near if 0.9 < d.area_px / size**2 < 1.1]
        if near:
            free.remove(near[0])
            out["right"] += 1
            out["flagged"] += "touching" in near[0].flags
    out["wrong"] = sum(d.shape is not Shape.OTHER for d in free)
    out["parts"] = len(parts)
    out["refused"] = len(parts) - out["right"]
    return out


def run(seed: int, each: int) -> dict[str, dict[str, int]]:
    """Counts for pairs and triples, of one colour and of several."""
    recipe = load_recipe("precise")
    results: dict[str, dict[str, int]] = {}
    columns, rows = _GRID
    for number, (count, one_colour) in enumerate([(2, False), (2, True), (3, False), (3, True)]):
        rng = np.random.default_rng([seed, 43, number])
        total: Counter[str] = Counter()
        for start in range(0, each, columns * rows):
            groups = [group(count, rng) for _ in range(min(columns * rows, each - start))]
            for cell, parts in enumerate(groups):
                place = (np.array([cell % columns, cell // columns]) + 0.5) * np.array(_SIZE) / np.array(_GRID)
                groups[cell] = [(shape, part + place) for shape, part in parts]
            picture = draw([[part for _, part in parts] for parts in groups], one_colour, rng)
            found = detect(Frame(1, 0.0, picture), recipe).detections
            cell_of = {id(d): _cell(d) for d in found}
            for cell, parts in enumerate(groups):
                total += count_group(parts, [d for d in found if cell_of[id(d)] == cell])
        results[f"{count} parts, {'one colour' if one_colour else 'several colours'}"] = dict(total)
    return results


def _cell(item: Detection) -> int:
    column = min(int(item.center_px[0] / _SIZE[0] * _GRID[0]), _GRID[0] - 1)
    return min(int(item.center_px[1] / _SIZE[1] * _GRID[1]), _GRID[1] - 1) * _GRID[0] + column


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--each", type=int, default=48)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    results = run(args.seed, args.each)
    for name, counts in results.items():
        parts, right = counts["parts"], counts.get("right", 0)
        print(
            f"{name:26s} parts {parts:4d}, separated and right {100.0 * right / parts:5.1f} %, "
            f"refused {100.0 * counts.get('refused', 0) / parts:4.1f} %, wrong {counts.get('wrong', 0)}, "
            f"flagged touching {100.0 * counts.get('flagged', 0) / max(right, 1):5.1f} %"
        )
    if args.json:
        args.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()

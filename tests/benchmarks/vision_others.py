"""Shapes that are none of the known ones, rings and nuts: drawn, detected, counted.

Run: python -m tests.benchmarks.vision_others [--seed 1] [--each 16] [--json FILE]
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

_FINE = 8
_ROUND = np.arange(180) * math.pi / 90.0


def _regular(sides: int, turn: float = 0.0) -> Floats:
    t = turn + np.arange(sides) * 2.0 * math.pi / sides
    return np.stack([np.cos(t), np.sin(t)], axis=1)


def _ellipse(aspect: float) -> Floats:
    return np.stack([np.cos(_ROUND), aspect * np.sin(_ROUND)], axis=1)


def _rounded(share: float) -> Floats:
    """Square of half side 1 whose corners are arcs of radius `share`."""
    quarter = np.linspace(0.0, math.pi / 2.0, 20)
    parts = []
    for k in range(4):
        c, s = math.cos(k * math.pi / 2.0), math.sin(k * math.pi / 2.0)
        corner = np.stack([1.0 - share + share * np.cos(quarter), 1.0 - share + share * np.sin(quarter)], axis=1)
        parts.append(corner @ np.array([[c, s], [-s, c]]))
    return np.concatenate(parts)


def _star() -> Floats:
    t = np.arange(10) * math.pi / 5.0
    r = np.where(np.arange(10) % 2, 0.45, 1.0)
    return np.stack([r * np.cos(t), r * np.sin(t)], axis=1)


def _half_disc() -> Floats:
    t = np.linspace(0.0, math.pi, 60)
    return np.stack([np.cos(t), np.sin(t) - 0.4], axis=1)


def _corners(*points: tuple[float, float]) -> Floats:
    out = np.array(points, float)
    return np.asarray(out - out.mean(axis=0))


OTHERS: dict[str, Floats] = {
    "pentagon": _regular(5),
    "octagon": _regular(8),
    "ellipse 0.94": _ellipse(0.94),
    "ellipse 0.87": _ellipse(0.87),
    "ellipse 0.6": _ellipse(0.6),
    "trapezoid": _corners((-1, -0.7), (1, -0.7), (0.6, 0.7), (-0.6, 0.7)),
    "star": _star(),
    "cross": _corners(
        (-0.35, -1), (0.35, -1), (0.35, -0.35), (1, -0.35), (1, 0.35), (0.35, 0.35), (0.35, 1), (-0.35, 1),
        (-0.35, 0.35), (-1, 0.35), (-1, -0.35), (-0.35, -0.35),
    ),
    "half disc": _half_disc(),
    "L": _corners((-1, -1), (-0.3, -1), (-0.3, 0.4), (0.8, 0.4), (0.8, 1), (-1, 1)),
    "T": _corners((-1, -1), (1, -1), (1, -0.4), (0.3, -0.4), (0.3, 1), (-0.3, 1), (-0.3, -0.4), (-1, -0.4)),
    "rounded 0.6": _rounded(0.6),
    "rounded 0.3": _rounded(0.3),
}  # fmt: skip
HOLED: dict[str, tuple[Floats, Shape]] = {"ring": (_ellipse(1.0), Shape.CIRCLE), "nut": (_regular(6), Shape.HEXAGON)}


def draw(
    outlines: list[tuple[Floats, Floats | None]], rng: np.random.Generator, size: tuple[int, int] = (1280, 720)
) -> NDArray[np.uint8]:
    """Picture of outlines (with an optional hole each), supersampled, on a lightly textured table with noise."""
    width, height = size
    table = 190.0 + rng.uniform(-15, 15)
    texture = cv2.resize(rng.standard_normal((height // 8 + 1, width // 8 + 1)).astype(np.float32), size)
    picture = np.repeat((table + 2.5 * texture / texture.std())[:, :, None], 3, axis=2)
    for outline, hole in outlines:
        low = np.floor(outline.min(axis=0)).astype(int) - 2
        high = np.ceil(outline.max(axis=0)).astype(int) + 3
        w, h = high - low
        fine = np.zeros((h * _FINE, w * _FINE), np.uint8)
        for ring, value in ((outline, 1), (hole, 0)):
            if ring is not None:
                points = np.rint(((ring - low + 0.5) * _FINE - 0.5) * 256.0).astype(np.int32)
                cv2.fillPoly(fine, [points[:, None]], (value,), shift=8)
        cover = cv2.resize(fine.astype(np.float32), (int(w), int(h)), interpolation=cv2.INTER_AREA)[:, :, None]
        colour = (table - rng.uniform(80, 140)) * (1.0 + rng.uniform(-0.08, 0.08, 3))
        patch = picture[low[1] : high[1], low[0] : high[0]]
        patch[:] = patch * (1.0 - cover) + colour * cover
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8)
    picture = picture + 3.0 * rng.standard_normal(picture.shape)
    return np.asarray(np.clip(np.rint(picture), 0, 255), np.uint8)


def placed(unit: Floats, rng: np.random.Generator, cell: int, size: tuple[int, int]) -> Floats:
    """A unit outline turned, scaled and put into one cell of a 5 x 3 grid."""
    width, height = size
    step_x, step_y = width / 5.0, height / 3.0
    scale = rng.uniform(35.0, 75.0)
    turn = rng.uniform(0.0, 2.0 * math.pi)
    c, s = math.cos(turn), math.sin(turn)
    center = np.array([(cell % 5 + 0.5) * step_x, (cell // 5 + 0.5) * step_y]) + rng.uniform(-8, 8, 2)
    return np.asarray(scale * unit @ np.array([[c, s], [-s, c]]) + center)


def near(detections: tuple[Detection, ...], outline: Floats) -> list[Detection]:
    """Detections whose centre lies within an outline's bounding box."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    return [d for d in detections if (low <= d.center_px).all() and (np.asarray(d.center_px) <= high).all()]


def run(seed: int, each: int) -> dict[str, dict[str, int]]:
    """For every kind, how often it was called what."""
    recipe = load_recipe("precise")
    size = (1280, 720)
    out: dict[str, Counter[str]] = {name: Counter() for name in (*OTHERS, *HOLED)}
    jobs = [name for name in out for _ in range(each)]
    rng = np.random.default_rng([seed, 41])
    rng.shuffle(jobs)
    for start in range(0, len(jobs), 15):
        names = jobs[start : start + 15]
        shown: list[tuple[Floats, Floats | None]] = []
        for cell, name in enumerate(names):
            unit = OTHERS[name] if name in OTHERS else HOLED[name][0]
            outline = placed(unit, rng, cell, size)
            hole = None
            if name in HOLED:
                middle = outline.mean(axis=0)
                radius = 0.5 * np.linalg.norm(outline - middle, axis=1).min()
                hole = middle + radius * _ellipse(1.0)
            shown.append((outline, hole))
        detected = detect(Frame(1, 0.0, draw(shown, rng, size)), recipe).detections
        for name, (outline, _) in zip(names, shown, strict=True):
            seen = near(detected, outline)
            verdict = " + ".join(sorted(str(d.shape) + ("*" if "hole" in d.flags else "") for d in seen)) or "missed"
            out[name][verdict] += 1
    return {name: dict(counts) for name, counts in out.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--each", type=int, default=16)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = run(args.seed, args.each)
    wrong = total = 0
    for name, counts in found.items():
        print(f"{name:13s} {', '.join(f'{what} {n}' for what, n in sorted(counts.items(), key=lambda p: -p[1]))}")
        if name in OTHERS:
            total += args.each
            wrong += sum(n for what, n in counts.items() if what not in ("other", "missed"))
    print(f"other shapes taken for a known one: {wrong}/{total} = {100.0 * wrong / total:.1f} %   (* flagged hole)")
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()

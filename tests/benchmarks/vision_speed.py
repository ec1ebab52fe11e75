"""Time of the recipes beside the floor and other ways, one thread, in one run.

Floor: 3 x 3 median and Canny of the gray frame. Contours: blur, Canny, dilation, findContours, approxPolyDP. Where
scikit-image is installed the paper's steps run in it as well. Times are processor time of this thread, the best of
several rounds: ratios hold on a busy machine, absolute figures do not.

Run: python -m tests.benchmarks.vision_speed [--rounds 5] [--json FILE] [--plot FILE.png]
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Frame
from controller.vision.detect import detect
from controller.vision.recipe import load_recipe
from tests.benchmarks.vision_others import _ellipse, _regular, draw

Image = NDArray[np.uint8]
SIZES = ((640, 480), (1280, 720), (1920, 1080))
COUNTS = (12, 50, 200)
_UNITS = (_regular(4, 0.785), _regular(6), _ellipse(1.0), _regular(3), _regular(4, 0.785) * np.array([1.3, 0.7]))


def scene(size: tuple[int, int], count: int, seed: int = 5) -> Image:
    """`count` known shapes on a grid."""
    rng = np.random.default_rng([seed, count])
    width, height = size
    columns = int(np.ceil(np.sqrt(count * width / height)))
    rows = int(np.ceil(count / columns))
    radius = 0.36 * min(width / columns, height / rows)
    outlines: list[tuple[NDArray[np.float64], NDArray[np.float64] | None]] = []
    for k in range(count):
        turn = rng.uniform(0.0, 6.3)
        c, s = np.cos(turn), np.sin(turn)
        unit = _UNITS[k % len(_UNITS)] @ np.array([[c, s], [-s, c]])
        middle = np.array([(k % columns + 0.5) * width / columns, (k // columns + 0.5) * height / rows])
        outlines.append((middle + radius * rng.uniform(0.7, 1.0) * unit, None))
    return draw(outlines, rng, size)


def best(work: Callable[[], object], rounds: int) -> float:
    """Least processor time of this thread for one call, ms."""
    times = []
    for _ in range(rounds):
        start = time.thread_time()
        work()
        times.append(time.thread_time() - start)
    return 1e3 * min(times)


def floor(image: Image) -> object:
    return cv2.Canny(cv2.medianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 3), 50, 150)


def contours(image: Image) -> object:
    """The usual short script."""
    gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (5, 5), 0)
    edges = cv2.dilate(cv2.Canny(gray, 50, 150), np.ones((3, 3), np.uint8))
    found, _ = cv2.findContours(edges, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return [cv2.approxPolyDP(c, 0.04 * cv2.arcLength(c, True), True) for c in found]


def skimage_steps() -> Callable[[Image], object] | None:
    """The paper's steps in scikit-image, or None where it is not installed."""
    if importlib.util.find_spec("skimage") is None:
        return None
    color, feature, filters, measure, morphology, exposure = (
        importlib.import_module(f"skimage.{name}")
        for name in ("color", "feature", "filters", "measure", "morphology", "exposure")
    )
    ndimage = importlib.import_module("scipy.ndimage")

    def steps(image: Image) -> object:
        sharp = filters.unsharp_mask(image[:, :, ::-1], radius=1.0, amount=0.8, channel_axis=2)
        gray = ndimage.median_filter(color.rgb2gray(sharp), size=3)
        low, high = np.percentile(gray, (1, 99))
        edges = feature.canny(exposure.rescale_intensity(gray, in_range=(low, high)), sigma=2**0.5)
        filled = ndimage.binary_fill_holes(edges)
        opened = morphology.opening(morphology.remove_small_objects(filled, 100), morphology.disk(3))
        return [(p.area, p.centroid, p.orientation, p.bbox) for p in measure.regionprops(measure.label(opened))]

    return steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    recipes = {name: load_recipe(name) for name in ("precise", "paper")}
    peer = skimage_steps()
    rows: list[dict[str, Any]] = []
    for size, count in [(size, 12) for size in SIZES] + [((1280, 720), count) for count in COUNTS[1:]]:
        image = scene(size, count)
        frame = Frame(1, 0.0, image)
        times = {work.__name__: best(partial(work, image), args.rounds) for work in (floor, contours)}
        for name, recipe in recipes.items():
            times[name] = best(partial(detect, frame, recipe), args.rounds)
        if peer is not None:
            times["scikit-image"] = best(partial(peer, image), max(1, args.rounds // 3))
        stages = {k: round(v, 2) for k, v in detect(frame, recipes["precise"]).timing_ms.items()}
        rows.append({"size": size, "objects": count, "ms": times, "stages": stages})
        print(f"{size[0]}x{size[1]}, {count} objects")
        for name, value in times.items():
            print(f"  {name:13s} {value:8.2f} ms   {value / times['floor']:7.1f} x floor")
        print("  precise:", ", ".join(f"{k} {v}" for k, v in stages.items()))
    if peer is None:
        print("scikit-image is not installed: left out")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))
    if args.plot:
        cv2.imwrite(str(args.plot), plot(rows))


def plot(rows: list[dict[str, Any]]) -> Image:
    """Bars of every way at every size, on a logarithmic scale."""
    names = list(rows[0]["ms"])
    canvas = np.full((60 + 26 * sum(len(row["ms"]) + 1 for row in rows), 900, 3), 255, np.uint8)
    y = 30
    for row in rows:
        title = f"{row['size'][0]} x {row['size'][1]}, {row['objects']} objects"
        cv2.putText(canvas, title, (12, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        y += 26
        for name, value in row["ms"].items():
            shade = 60 + 150 * names.index(name) // max(1, len(names) - 1)
            end = 150 + int(170 * max(0.0, np.log10(value) + 0.5))
            cv2.rectangle(canvas, (150, y - 12), (end, y + 2), (shade, 120, 230 - shade), -1)
            cv2.putText(canvas, name, (30, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
            label = f"{value:.1f} ms"
            cv2.putText(canvas, label, (end + 8, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
            y += 26
    return canvas


if __name__ == "__main__":
    main()

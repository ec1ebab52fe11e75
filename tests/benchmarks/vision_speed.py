"""Time of the recipes beside the floor and other ways, one thread, in one run.

Floor: 3 x 3 median and Canny of the gray frame. Contours: blur, Canny, dilation, findContours, approxPolyDP. The
paper's steps also run in scikit-image, where that is installed (or --skimage-python names a Python that has it), and
in GNU Octave with its image package. `precise` is timed with and without colour and texture. Times are processor time
of the working thread, the best of several interleaved rounds: ratios hold on a busy machine, absolute figures do not.
The last lines set `precise` against what is asked of it at 1280x720 with 12 objects, and the exit code is 1 when it
falls short.

Run: python -m tests.benchmarks.vision_speed [--rounds 5] [--skimage-python PYTHON] [--json FILE] [--plot FILE.png]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Frame
from controller.vision.appearance.settings import Appearance
from controller.vision.detect import detect
from controller.vision.recipe import Recipe, load_recipe
from tests.benchmarks.vision_others import _ellipse, _regular, draw

Image = NDArray[np.uint8]
SIZES = ((640, 480), (1280, 720), (1920, 1080))
COUNTS = (12, 50, 200)
ASKED_AT = (1280, 720), 12
MOST_FLOORS, LEAST_FASTER = 10.0, 25.0
"""How many floors `precise` may take, and how much faster than the paper's steps in scikit-image it must be."""
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


def floor(image: Image) -> object:
    return cv2.Canny(cv2.medianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 3), 50, 150)


def contours(image: Image) -> object:
    """The usual short script."""
    gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (5, 5), 0)
    edges = cv2.dilate(cv2.Canny(gray, 50, 150), np.ones((3, 3), np.uint8))
    found, _ = cv2.findContours(edges, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return [cv2.approxPolyDP(c, 0.04 * cv2.arcLength(c, True), True) for c in found]


STEPS = """
import sys, time
import numpy as np
from scipy import ndimage
from skimage import color, exposure, feature, filters, measure, morphology

def steps(image):
    sharp = filters.unsharp_mask(image[:, :, ::-1], radius=1.0, amount=0.8, channel_axis=2)
    gray = ndimage.median_filter(color.rgb2gray(sharp), size=3)
    low, high = np.percentile(gray, (1, 99))
    edges = feature.canny(exposure.rescale_intensity(gray, in_range=(low, high)), sigma=2**0.5)
    labels = measure.label(ndimage.binary_fill_holes(edges))
    large = np.bincount(labels.ravel()) >= 100
    large[0] = False
    opened = morphology.opening(large[labels], morphology.disk(3))
    return [(p.area, p.centroid, p.orientation, p.bbox) for p in measure.regionprops(measure.label(opened))]

image, times = np.load(sys.argv[1]), []
for _ in range(int(sys.argv[2])):
    start = time.thread_time()
    found = steps(image)
    times.append(time.thread_time() - start)
print(1e3 * min(times), len(found))
"""
"""The paper's steps in scikit-image, as a program: it may live in an environment of its own."""

OCTAVE = """
pkg load image; image = imread("%s"); best = inf;
for round = 1:%d
  start = cputime(); sharp = imsharpen(image); gray = medfilt2(rgb2gray(sharp));
  edges = edge(imadjust(gray), "canny"); filled = bwareaopen(imfill(edges, "holes"), 100);
  opened = imopen(filled, strel("disk", 3, 0));
  found = regionprops(bwlabel(opened), "Area", "Centroid", "Orientation", "BoundingBox");
  best = min(best, cputime() - start);
end
printf("%%g\\n", 1e3 * best);
"""
"""The same in GNU Octave."""


def elsewhere(command: list[str]) -> float | None:
    """The first number that a program prints, ms; None when it cannot be run."""
    single = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    try:
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=os.environ | single)
    except (OSError, subprocess.CalledProcessError):
        return None
    return float(done.stdout.split()[0])


def in_skimage(python: str, image: Image, rounds: int) -> float | None:
    """The paper's steps in scikit-image, ms; None where `python` has none."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.npy"
        np.save(file, image)
        return elsewhere([python, "-c", STEPS, str(file), str(rounds)])


def in_octave(image: Image, rounds: int) -> float | None:
    """The paper's steps in GNU Octave, ms; None where that or its image package is missing."""
    if shutil.which("octave-cli") is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.png"
        cv2.imwrite(str(file), image)
        return elsewhere(["octave-cli", "--eval", OCTAVE % (file, rounds)])


def best(works: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Least processor time of this thread for one call of each, ms; they take turns."""
    times = dict.fromkeys(works, math.inf)
    for _ in range(rounds):
        for name, work in works.items():
            start = time.thread_time()
            work()
            times[name] = min(times[name], 1e3 * (time.thread_time() - start))
    return times


def stages(frame: Frame, recipe: Recipe, rounds: int) -> dict[str, float]:
    """Least time of each stage, ms of the clock on the wall."""
    runs = [detect(frame, recipe).timing_ms for _ in range(rounds)]
    return {name: round(min(run.get(name, math.inf) for run in runs), 2) for name in runs[0]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--skimage-python", default=sys.executable, help="a Python that has scikit-image")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    precise, paper = load_recipe("precise"), load_recipe("paper")
    outlines = precise.model_copy(update={"appearance": Appearance(colour=False, texture=False)})
    rows: list[dict[str, Any]] = []
    for size, count in [(size, count) for size in SIZES for count in COUNTS]:
        image = scene(size, count)
        frame = Frame(1, 0.0, image)
        works: dict[str, Callable[[], object]] = {"floor": partial(floor, image), "contours": partial(contours, image)}
        for name, recipe in (("outlines only", outlines), ("precise", precise), ("paper", paper)):
            works[name] = partial(detect, frame, recipe)
        found = len(detect(frame, precise).detections)
        times = best(works, args.rounds)
        few = max(2, args.rounds // 3)
        for name, value in (
            ("scikit-image", in_skimage(args.skimage_python, image, few)),
            ("octave", in_octave(image, few)),
        ):
            if value is not None:
                times[name] = value
        parts = stages(frame, precise, args.rounds)
        rows.append({"size": size, "objects": count, "found": found, "ms": times, "stages": parts})
        print(f"{size[0]}x{size[1]}, {count} objects, {found} found")
        for name, value in times.items():
            ratio = f"{times['scikit-image'] / value:9.1f} x scikit-image" if "scikit-image" in times else ""
            print(f"  {name:13s} {value:8.2f} ms   {value / times['floor']:7.1f} x floor {ratio}")
        print("  precise:", ", ".join(f"{k} {v}" for k, v in parts.items()))
    for name in ("scikit-image", "octave"):
        if not any(name in row["ms"] for row in rows):
            print(f"{name} is not installed: left out")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))
    if args.plot:
        cv2.imwrite(str(args.plot), plot(rows))
    sys.exit(0 if verdicts(rows) else 1)


def verdicts(rows: list[dict[str, Any]]) -> bool:
    """Print how `precise` stands to what is asked of it; whether all that could be measured holds."""
    (width, height), count = ASKED_AT
    times: dict[str, float] = next(
        row["ms"] for row in rows if row["size"] == (width, height) and row["objects"] == count
    )
    print(f"asked of precise at {width}x{height} with {count} objects, colour and texture included:")
    ratio = times["precise"] / times["floor"]
    holds = ratio <= MOST_FLOORS
    print(f"  at most {MOST_FLOORS:.0f} x floor: {ratio:.1f} x, {'holds' if holds else 'falls short'}"
          f" (outlines only {times['outlines only'] / times['floor']:.1f} x)")
    if "scikit-image" not in times:
        print(f"  {LEAST_FASTER:.0f} x faster than scikit-image: not measured")
        return holds
    faster = times["scikit-image"] / times["precise"]
    print(f"  at least {LEAST_FASTER:.0f} x faster than the paper's steps in scikit-image: {faster:.1f} x, "
          f"{'holds' if faster >= LEAST_FASTER else 'falls short'}")
    return holds and faster >= LEAST_FASTER


def plot(rows: list[dict[str, Any]]) -> Image:
    """Bars of every way at every size, on a logarithmic scale."""
    names = list(dict.fromkeys(name for row in rows for name in row["ms"]))
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

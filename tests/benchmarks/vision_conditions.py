"""What cameras do to scenes: compression, motion, vignetting; with a calibration, bending lenses and oblique views.

Every line is the same scenes (dark, light, coloured parts and uneven light, 1280x720) seen another way; beside recipe
`precise` the same without any tint (gray parts on a gray table, coloured ones left out) and recipe `paper`.

Run: python -m tests.benchmarks.vision_conditions [--seeds 60,61,62] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Frame
from controller.geometry import CameraModel, PlaneMap, pose_from_rvec
from controller.vision.detect import detect
from controller.vision.recipe import Recipe, load_recipe
from tests.benchmarks.drawn_scenes import Drawn, draw, exposed, neutral, tool

Picture = NDArray[np.float32]
Truth = list[dict[str, Any]]
Shown = tuple[NDArray[np.uint8], tuple[Truth, Truth]]
"""A picture, the objects that lie wholly in it, and those that its border cuts."""

SIZE = (1280, 720)
BASES = ("dark", "light", "colour", "gradient")
_FINE = 2
"""Scenes to be bent are drawn this many times finer."""
_FOCAL, _DISTANCE = 1100.0, 620.0
"""Of the camera over the table, px and mm."""
_MM = _DISTANCE / _FOCAL / _FINE
"""Of the table to a pixel of the fine scene."""
_LENS = (-0.25, 0.06, 0.0005, -0.0004, 0.0)


@dataclass(frozen=True, slots=True)
class View:
    """One way to see the scenes.

    Attributes:
        right: Share, %, to be found and named rightly.
        false: Largest number of made-up objects, % of the true ones.
        spoil: What happens to the picture before the noise.
        compress: JPEG quality, or None.
        bent: Whether the lens distorts.
        tilt: Of the camera, deg; None for the picture as drawn, without a calibration.
    """

    right: float
    false: float
    spoil: Callable[[Picture, np.random.Generator], Picture] | None = None
    compress: int | None = None
    bent: bool = False
    tilt: float | None = None

    @property
    def plane(self) -> PlaneMap | None:
        """The calibration that the recipe is given."""
        return None if self.tilt is None else camera(self.bent, self.tilt)


@dataclass(slots=True)
class Score:
    """Counts of one line."""

    objects: int = 0
    found: int = 0
    right: int = 0
    false: int = 0
    errors: list[float] = field(default_factory=list)

    def figures(self) -> dict[str, float]:
        """As shares in % and px."""
        share = 100.0 / max(self.objects, 1)
        return {
            "objects": self.objects, "right_pct": share * self.right, "found_pct": share * self.found,
            "false_pct": share * self.false, "centre_px": float(np.median(self.errors)) if self.errors else math.nan,
        }  # fmt: skip


def motion(picture: Picture, rng: np.random.Generator, length: float = 6.0) -> Picture:
    """Every point drawn out to a line of that length, px, in one direction."""
    turn = rng.uniform(0.0, math.pi)
    kernel = np.zeros((9, 9))
    for at in np.linspace(-0.5 * length, 0.5 * length, 61):
        x, y = 4.0 + at * math.cos(turn), 4.0 + at * math.sin(turn)
        i, j = int(y), int(x)
        kernel[i : i + 2, j : j + 2] += np.outer([1.0 - (y - i), y - i], [1.0 - (x - j), x - j])
    return np.asarray(cv2.filter2D(picture, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE), np.float32)


def vignette(picture: Picture, rng: np.random.Generator) -> Picture:
    """A tenth of the light lost in the corners, with the square of the distance from the middle."""
    del rng
    height, width = picture.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    far = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / ((width / 2) ** 2 + (height / 2) ** 2)
    return np.asarray(picture * (1.0 - 0.1 * far)[..., None], np.float32)


VIEWS = {
    "as drawn": View(99.0, 0.2),
    "JPEG quality 50": View(94.0, 1.0, compress=50),
    "motion 6 px": View(94.0, 1.0, motion),
    "vignetting 10 %": View(94.0, 1.0, vignette),
    "lens": View(99.0, 1.0, bent=True, tilt=0.0),
    "tilt 15 deg": View(99.0, 1.0, tilt=15.0),
    "tilt 35 deg": View(99.0, 1.0, tilt=35.0),
    "lens, tilt 15 deg": View(99.0, 1.0, bent=True, tilt=15.0),
    "lens, tilt 35 deg": View(99.0, 1.0, bent=True, tilt=35.0),
    "these, motion 3, JPEG": View(94.0, 1.0, partial(motion, length=3.0), 50, bent=True, tilt=35.0),
}


def camera(bent: bool, tilt: float) -> PlaneMap:
    """A camera over the table that looks at its origin, tilted about the picture's long side."""
    matrix = np.array([[_FOCAL, 0.0, (SIZE[0] - 1) / 2], [0.0, _FOCAL, (SIZE[1] - 1) / 2], [0.0, 0.0, 1.0]])
    model = CameraModel(matrix, np.array(_LENS if bent else (0.0,) * 5), SIZE)
    T = pose_from_rvec([math.pi, 0.0, 0.0], [0.0] * 3) @ pose_from_rvec([math.radians(tilt), 0.0, 0.0], [0.0] * 3)
    T[:3, 3] = -T[:3, :3] @ np.array([0.0, 0.0, _DISTANCE])
    return PlaneMap(model, T, 0.0)


def on_table(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (N, 2) on the table, mm, of pixels (N, 2) of the fine scene: its y points down, the table's up."""
    middle = (np.array(SIZE) * _FINE - 1) / 2.0
    return np.asarray((pixels - middle) * np.array([_MM, -_MM]))


@cache
def sources(bent: bool, tilt: float) -> Picture:
    """Which place (x, y) of the fine scene each pixel of a fine picture shows."""
    width, height = SIZE
    y, x = np.mgrid[: height * _FINE, : width * _FINE].reshape(2, -1)
    pixels = (np.stack([x, y], axis=1) + 0.5) / _FINE - 0.5
    places = camera(bent, tilt).to_plane(pixels) / np.array([_MM, -_MM]) + (np.array(SIZE) * _FINE - 1) / 2.0
    return np.asarray(places.reshape(height * _FINE, width * _FINE, 2), np.float32)


def on_camera(picture: Picture, at: Picture) -> Picture:
    """A fine scene as the camera sees it lie on the table, by the `sources` of its pixels."""
    seen = cv2.remap(picture, at, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    small = cv2.resize(seen, SIZE, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 0.5), np.float32)


def seen_truth(scene: Drawn, plane: PlaneMap) -> tuple[Truth, Truth]:
    """The objects that lie wholly in the picture, and the others, with their centre and area in its pixels."""
    scenes = tool("scenes")
    whole: Truth = []
    cut: Truth = []
    for item in scene.objects:
        ring = scenes.polygon(item)
        turn = np.linspace(0.0, 2.0 * math.pi, 180, endpoint=False)
        if ring is None:
            ring = np.array([item["cx"], item["cy"]]) + item["r"] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        outline = plane.to_pixels(on_table(np.asarray(ring, float)))
        (cx, cy), = plane.to_pixels(on_table(np.array([[item["cx"], item["cy"]]])))
        covered = abs(float(cv2.contourArea(outline.astype(np.float32))))
        inside = (outline > 2.0).all() and (outline < np.array(SIZE) - 3.0).all()
        (whole if inside else cut).append({**item, "cx": cx, "cy": cy, "area": covered})
    return whole, cut


def tally(
    score: Score, picture: NDArray[np.uint8], truth: tuple[Truth, Truth], recipe: Recipe, plane: PlaneMap | None
) -> None:
    """Detect, match, count; what the picture's border cuts is counted neither way."""
    found = [
        {"center_px": d.center_px, "area_px": d.area_px, "shape": str(d.shape), "cut": "cut_by_border" in d.flags}
        for d in detect(Frame(1, 0.0, picture), recipe, plane=plane).detections
    ]
    whole, cut = truth
    pairs = tool("score_scenes").match([*whole, *cut], found)
    matched = {j for _, j, _ in pairs}
    score.objects += len(whole)
    score.false += sum(j not in matched and not item["cut"] for j, item in enumerate(found))
    for i, j, error in pairs:
        if i < len(whole):
            score.found += 1
            score.right += found[j]["shape"] == whole[i]["shape"]
            score.errors.append(error)


def shown(scenes: Mapping[int, Drawn], view: View, tint: bool, seed: Sequence[int]) -> Shown:
    """A scene, drawn plain and fine, as one view shows it, and what it shows."""
    rng = np.random.default_rng(seed)
    scene = scenes[1 if view.plane is None else _FINE]
    picture = scene.picture if tint else neutral(scene.picture)
    truth: tuple[Truth, Truth] = (scene.objects, [])
    if view.plane is not None and view.tilt is not None:
        picture, truth = on_camera(picture, sources(view.bent, view.tilt)), seen_truth(scene, view.plane)
    if view.spoil is not None:
        picture = view.spoil(picture, rng)
    taken = exposed(picture, scene.noise, rng)
    if view.compress is not None:
        _, data = cv2.imencode(".jpg", taken, [cv2.IMWRITE_JPEG_QUALITY, view.compress])
        taken = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    return taken, truth


def run(seeds: list[int], each: int, views: Mapping[str, View]) -> dict[str, dict[str, dict[str, float]]]:
    """The figures of every line: tinted, untinted, and of recipe `paper`."""
    precise, paper = load_recipe("precise"), load_recipe("paper")
    scores = {name: {"precise": Score(), "untinted": Score(), "paper": Score()} for name in views}
    for seed, number, k in product(seeds, range(len(BASES)), range(each)):
        key = [seed, 47, number, k]
        scenes = {
            fine: draw(BASES[number], (SIZE[0] * fine, SIZE[1] * fine), np.random.default_rng(key))
            for fine in (1, _FINE)
        }
        for name, view in views.items():
            picture, truth = shown(scenes, view, True, key)
            tally(scores[name]["precise"], picture, truth, precise, view.plane)
            tally(scores[name]["paper"], picture, truth, paper, None)
            if BASES[number] != "colour":
                picture, truth = shown(scenes, view, False, key)
                tally(scores[name]["untinted"], picture, truth, precise, view.plane)
    return {name: {key: score.figures() for key, score in row.items()} for name, row in scores.items()}


def line(name: str, view: View, figures: dict[str, dict[str, float]]) -> str:
    """One row of the table, with its verdict."""
    a, b, c = figures["precise"], figures["untinted"], figures["paper"]
    met = a["right_pct"] >= view.right and a["false_pct"] <= view.false
    return (
        f"{name:21s} {a['objects']:5.0f} {a['right_pct']:7.2f} {a['false_pct']:6.2f} {a['centre_px']:7.3f}   "
        f"{b['right_pct']:7.2f} {b['false_pct']:6.2f} {b['centre_px']:7.3f}   "
        f"{c['right_pct']:7.2f} {c['false_pct']:7.2f}   "
        f"{'met' if met else 'MISSED'} (right >= {view.right:g} %, false <= {view.false:g} %)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="60,61,62")
    parser.add_argument("--scenes", type=int, default=2, help="of each of the four kinds, to a seed")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{'':21s} {'':5s} {'precise':>22s}   {'untinted':>22s}   {'paper':>15s}")
    print(f"{'view':21s} parts " + "   ".join(["right %  false  ctr px"] * 2) + "   right %  false %   verdict")
    results = run([int(seed) for seed in args.seeds.split(",")], args.scenes, VIEWS)
    for name, figures in results.items():
        print(line(name, VIEWS[name], figures))
    if args.json:
        args.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()

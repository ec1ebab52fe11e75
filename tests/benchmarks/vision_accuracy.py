"""Accuracy of a recipe on generated scenes with exact truth: 13 conditions, three resolutions, any seeds.

Needs the scene generator and the scorer of the shared folder beside the checkout.

With `--untinted` the parts and the table are gray and nothing else; what is there by its colour alone is left out.

Run: python -m tests.benchmarks.vision_accuracy [--seeds 21,22,23] [--recipe precise] [--untinted] [--json F]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from controller.domain import Frame
from controller.vision.detect import detect
from controller.vision.read import read_image
from controller.vision.recipe import load_recipe
from controller.vision.report import detection_json
from tests.benchmarks.drawn_scenes import TOOLS, draw, exposed, neutral, tool


def gray_scenes(folder: Path, seed: int, resolutions: str) -> None:
    """The generator's scenes of one seed without any tint, written as it writes them."""
    index = []
    conditions = list(tool("scenes").COND)
    for part in resolutions.split(","):
        size, each = part.split(":")
        width, height = (int(v) for v in size.split("x"))
        for number, condition in enumerate(conditions):
            for k in range(int(each) if condition not in ("colour", "mixed") else 0):
                rng = np.random.default_rng([seed, width, number, k])
                scene = draw(condition, (width, height), rng)
                name = f"{height}_{condition}_{k}"
                picture = exposed(neutral(scene.picture), scene.noise, rng, 0.01 if condition == "impulse1" else 0.0)
                cv2.imwrite(str(folder / f"{name}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
                entry = {"name": name, "W": width, "H": height, "cond": condition, "objects": scene.objects}
                index.append({**entry, "noise": scene.noise, "blur": scene.blur})
    (folder / "gt.json").write_text(json.dumps(index))
    (folder / "list.txt").write_text("\n".join(str(entry["name"]) for entry in index))


def run(seed: int, recipe_name: str, resolutions: str, untinted: bool) -> dict[str, Any]:
    """The scorer's figures for the scenes of one seed."""
    recipe = load_recipe(recipe_name)
    with tempfile.TemporaryDirectory() as folder:
        scenes = Path(folder)
        if untinted:
            gray_scenes(scenes, seed, resolutions)
        else:
            make = [sys.executable, str(TOOLS / "scenes.py"), folder, "--seed", str(seed), "--res", resolutions]
            subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
        lines = []
        for number, name in enumerate((scenes / "list.txt").read_text().split(), start=1):
            frame = Frame(number, 0.0, read_image(scenes / f"{name}.png"), name)
            lines.append(json.dumps(detection_json(f"{name}.png", frame, recipe.name, detect(frame, recipe))))
        found = scenes / "found.jsonl"
        found.write_text("\n".join(lines))
        score = [sys.executable, str(TOOLS / "score_scenes.py"), folder, str(found), "--json"]
        out = subprocess.run(score, check=True, stdout=subprocess.PIPE, text=True).stdout
    return dict(json.loads(out))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="21,22,23")
    parser.add_argument("--recipe", default="precise")
    parser.add_argument("--res", default="640x480:3,1280x720:2,1920x1080:1")
    parser.add_argument("--untinted", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if not TOOLS.is_dir():
        sys.exit(f"{TOOLS} is missing: the scene generator lies there")
    cv2.setNumThreads(1)
    seeds = [int(seed) for seed in args.seeds.split(",")]
    results = {seed: run(seed, args.recipe, args.res, args.untinted) for seed in seeds}
    print(f"recipe {args.recipe}, seeds {args.seeds}{', untinted' * args.untinted}, mean over the seeds")
    head = {"right %": 8, "worst": 7, "false %": 8, "centre px": 10, "x bound": 8, "angle deg": 10}
    print(f"{'condition':10s} " + " ".join(f"{name:>{width}s}" for name, width in head.items()))
    for condition in results[seeds[0]]:
        if condition == "ms":
            continue
        rows = [results[seed][condition] for seed in seeds]

        def mean(key: str, rows: list[dict[str, Any]] = rows) -> float:
            values = [row[key] for row in rows if row[key] is not None]
            return sum(values) / len(values) if values else float("nan")

        right, worst = mean("found_and_right_pct"), min(row["found_and_right_pct"] for row in rows)
        print(
            f"{condition:10s} {right:8.2f} {worst:7.2f} {mean('false_pct'):8.2f} {mean('centre_median_px'):10.4f} "
            f"{mean('centre_to_bound'):8.2f} {mean('angle_median_deg'):10.4f}"
        )
    if args.json:
        args.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()

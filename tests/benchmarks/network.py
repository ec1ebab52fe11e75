"""How well the shipped network names shapes beside the geometric recipe, on scenes with exact truth; ms a part.

    python -m tests.benchmarks.network [--seeds 41,42] [--res 640x480:2,1280x720:1]

Both name the same detections of recipe `precise`; none of the scenes' objects was seen in training. Needs the scene
generator and the scorer of the shared folder beside the checkout.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from time import process_time
from typing import Any

import cv2
import numpy as np

from controller.domain import Frame
from controller.vision.detect import detect
from controller.vision.models import painted
from controller.vision.models.cnn import MARGIN, SIDE
from controller.vision.models.network import Network, network
from controller.vision.read import read_image
from controller.vision.recipe import load_recipe
from controller.vision.report import detection_json
from tests.benchmarks.drawn_scenes import TOOLS


def on_crops(net: Network, count: int, seed: int) -> dict[str, Any]:
    """Share of new painted crops named rightly, and what was mistaken for what."""
    images, labels = painted.crops_of_shapes(count, seed, SIDE, MARGIN)
    began = process_time()
    said = net.scores(images).argmax(axis=1)
    each_ms = 1e3 * (process_time() - began) / count
    names = painted.SHAPES
    wrong = Counter(f"{names[a]} -> {names[b]}" for a, b in zip(labels, said, strict=True) if a != b)
    right = round(100.0 * float(np.mean(said == labels)), 2)
    return {"new_crops": count, "seed": seed, "right_percent": right, "part_ms": round(each_ms, 3), "wrong": wrong}


def on_scenes(seed: int, resolutions: str) -> dict[str, Mapping[str, Any]]:
    """The scorer's figures with the shapes as geometry names them, and as the network does."""
    recipe = load_recipe("learned")
    with tempfile.TemporaryDirectory() as folder:
        scenes = Path(folder)
        make = [sys.executable, str(TOOLS / "scenes.py"), folder, "--seed", str(seed), "--res", resolutions]
        subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
        lines: dict[str, list[str]] = {"geometry": [], "network": []}
        for number, name in enumerate((scenes / "list.txt").read_text().split(), start=1):
            frame = Frame(number, 0.0, read_image(scenes / f"{name}.png"), name)
            found = detection_json(f"{name}.png", frame, recipe.name, detect(frame, recipe))
            lines["geometry"].append(json.dumps(found))
            for item in found["objects"]:
                item["shape"] = item["label"]
            lines["network"].append(json.dumps(found))
        figures = {}
        for way, text in lines.items():
            path = scenes / f"{way}.jsonl"
            path.write_text("\n".join(text))
            score = [sys.executable, str(TOOLS / "score_scenes.py"), folder, str(path), "--json"]
            out = subprocess.run(score, check=True, stdout=subprocess.PIPE, text=True).stdout
            figures[way] = json.loads(out)
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="41,42")
    parser.add_argument("--res", default="640x480:2,1280x720:1")
    parser.add_argument("--crops", type=int, default=3000)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    model = load_recipe("learned").model
    assert model is not None
    print(json.dumps(on_crops(network(model), arguments.crops, 900)), flush=True)
    if not TOOLS.is_dir():
        return
    for seed in (int(seed) for seed in arguments.seeds.split(",")):
        for way, figures in on_scenes(seed, arguments.res).items():
            line = {name: round(row["found_and_right_pct"], 1) for name, row in figures.items()}
            print(json.dumps({"seed": seed, "way": way, "right_percent": line}), flush=True)


if __name__ == "__main__":
    main()

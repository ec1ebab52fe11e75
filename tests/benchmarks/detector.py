"""A detector of one's own from end to end: learnt in PyTorch, written as ONNX, run by a recipe in both runtimes.

    pip install -e '.[train,onnx]'; python -m tests.benchmarks.detector

A network of three layers learns washers and squares on painted pictures, one answer for every patch of 8 x 8 px. The
recipe that names it is then used on new pictures by OpenCV and by onnxruntime; the same file with a wrong checksum, a
wrong shape, and cut off has to be refused. Exit code 1 when fewer than 95 % of the parts are named rightly, anything
else is named, or a bad model is let in.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import math
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from controller.domain import Frame
from controller.errors import ConfigError
from controller.vision.detect import detect
from controller.vision.models.network import network
from controller.vision.models.settings import Model
from controller.vision.recipe import load_recipe
from tests.benchmarks import surfaces
from tests.benchmarks.surfaces import SQUARE, Image, Thing, polygon

NAMES = ("plate", "washer")
WIDE, HIGH, PATCH = 160, 120, 8
RINGS = ([SQUARE * 0.9], [polygon(48), polygon(48, 0.45)])
WANTED = 0.95


def scene(random: np.random.Generator) -> tuple[Image, list[Thing], list[int]]:
    """A picture of 320 x 240 with up to six parts, and their kinds."""
    things, kinds = [], []
    for place in random.permutation(6)[: int(random.integers(2, 7))].tolist():
        kind = int(random.integers(2))
        radius = float(random.uniform(18.0, 26.0))
        shade = tuple(int(v) for v in random.integers(20, 120, 3))
        x, y = 55.0 + 105.0 * (place % 3), 62.0 + 115.0 * (place // 3)
        x, y = (float(v + random.uniform(-18, 18)) for v in (x, y))
        code = (shade[0], shade[1], shade[2])
        turn = float(random.uniform(-math.pi, math.pi))
        things.append(Thing([np.asarray(r * radius) for r in RINGS[kind]], (code, code), x, y, turn))
        kinds.append(kind)
    light = surfaces.field((320, 240), 5500.0, float(random.uniform(0.6, 1.0)), 0.2, float(random.uniform(-3, 3)))
    return surfaces.paint(things, (320, 240), random, light=light), things, kinds


def wanted_of(things: list[Thing], kinds: list[int]) -> NDArray[np.float32]:
    """(4 + classes, patches): box and class of the part whose middle lies in each patch, in px of the input."""
    out = np.zeros((4 + len(NAMES), HIGH // PATCH, WIDE // PATCH), np.float32)
    for thing, kind in zip(things, kinds, strict=True):
        ring = surfaces.outline(thing)
        low, high = ring.min(axis=0) / 2.0, ring.max(axis=0) / 2.0
        x, y = (low + high) / 2.0
        column, row = min(int(x / PATCH), WIDE // PATCH - 1), min(int(y / PATCH), HIGH // PATCH - 1)
        out[:4, row, column] = x, y, *(high - low)
        out[4 + kind, row, column] = 1.0
    return out.reshape(len(out), -1)


class Boxes(torch.nn.Module):  # type: ignore[misc]  # PyTorch is no dependency of development: mypy does not see it
    """Three layers that each halve the picture, one that looks around, and one that answers for each patch."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[Any] = []
        for before, after, stride in ((3, 12, 2), (12, 24, 2), (24, 32, 2), (32, 32, 1), (32, 32, 1)):
            layers += [torch.nn.Conv2d(before, after, 3, stride, 1, bias=False), torch.nn.BatchNorm2d(after)]
            layers += [torch.nn.ReLU()]
        self.body = torch.nn.Sequential(*layers, torch.nn.Conv2d(32, 4 + len(NAMES), 1))
        v, u = torch.meshgrid(torch.arange(HIGH // PATCH), torch.arange(WIDE // PATCH), indexing="ij")
        self.register_buffer("middles", (torch.stack([u, v]).reshape(1, 2, -1).float() + 0.5) * PATCH)

    def raw(self, pictures: Any) -> tuple[Any, Any]:
        """Boxes (n, 4, patches) in px, and how much each patch looks like each class (n, classes, patches)."""
        out = self.body(pictures).flatten(2)
        boxes = torch.cat([self.middles + PATCH * out[:, :2], 24.0 * torch.exp(out[:, 2:4])], 1)
        return boxes, out[:, 4:]

    def forward(self, pictures: Any) -> Any:
        """(n, 4 + classes, patches): the layout `centres`."""
        boxes, likeness = self.raw(pictures)
        return torch.cat([boxes, torch.sigmoid(likeness)], 1)


def learnt(pictures: int, steps: int, seed: int) -> bytes:
    """The ONNX file of a detector."""
    random = np.random.default_rng([seed, 1])
    images, answers = [], []
    for _ in range(pictures):
        image, things, kinds = scene(random)
        images.append(cv2.resize(image, (WIDE, HIGH), interpolation=cv2.INTER_AREA)[..., ::-1])
        answers.append(wanted_of(things, kinds))
    values = torch.from_numpy(np.stack(images).transpose(0, 3, 1, 2).astype(np.float32) / 255.0)
    wanted = torch.from_numpy(np.stack(answers))
    torch.manual_seed(seed)
    net = Boxes()
    optimiser = torch.optim.AdamW(net.parameters(), lr=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 0.01, total_steps=steps)
    for _ in range(steps):
        some = torch.from_numpy(random.integers(0, pictures, 16))
        boxes, likeness = net.raw(values[some])
        target = wanted[some]
        there = target[:, 4:].sum(dim=1) > 0.0
        weight = torch.where(target[:, 4:] > 0.0, 8.0, 1.0)
        loss = torch.nn.functional.binary_cross_entropy_with_logits(likeness, target[:, 4:], weight=weight)
        loss = loss + 0.02 * (boxes - target[:, :4]).abs().sum(dim=1)[there].mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    net.eval()
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # The exporter by tracing writes operators that OpenCV knows; that it is no longer the default is known.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            net, (torch.zeros(1, 3, HIGH, WIDE),), buffer, input_names=["picture"], output_names=["boxes"],
            opset_version=13, dynamo=False,
        )  # fmt: skip
    return buffer.getvalue()


def refused(model: Model) -> str | None:
    """Why a model is not let in, or None."""
    try:
        network(model)
    except ConfigError as error:
        return str(error)
    return None


def main() -> int:
    """Learn, use, and try to let bad ones in."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=int, default=500, help="to learn from")
    parser.add_argument("--steps", type=int, default=900)
    parser.add_argument("--new", type=int, default=40, help="new pictures")
    parser.add_argument("--seed", type=int, default=3)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    good = True
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "boxes.onnx"
        data = learnt(asked.pictures, asked.steps, asked.seed)
        file.write_bytes(data)
        patches = (HIGH // PATCH) * (WIDE // PATCH)
        model = Model(
            file=str(file), sha256=hashlib.sha256(data).hexdigest(), task="detect", layout="centres",
            input=(1, 3, HIGH, WIDE), output=(1, 4 + len(NAMES), patches), labels=NAMES,
        )  # fmt: skip
        print(json.dumps({"bytes": len(data), "learnt_from": asked.pictures}), flush=True)
        for runtime in ("opencv", "onnxruntime"):
            recipe = load_recipe("precise").model_copy(update={"model": model.model_copy(update={"runtime": runtime})})
            random = np.random.default_rng([asked.seed, 2])
            said: Counter[str] = Counter()
            for _ in range(asked.new):
                picture, things, kinds = scene(random)
                found = [i for i in detect(Frame(1, 0.0, picture), recipe).detections if i.label in NAMES]
                said["more"] += max(0, len(found) - len(things))
                for thing, kind in zip(things, kinds, strict=True):
                    near = [i for i in found if math.dist(i.center_px, (thing.x, thing.y)) < 12.0]
                    label = near[0].label if near else "nothing"
                    said["right" if label == NAMES[kind] else f"{NAMES[kind]} -> {label}"] += 1
            share = said["right"] / max(sum(said.values()) - said["more"], 1)
            good &= share >= WANTED and said["more"] == 0
            print(json.dumps({"runtime": runtime, "right_percent": round(100.0 * share, 2), "said": said}), flush=True)
        cut = Path(folder) / "cut.onnx"
        cut.write_bytes(data[: len(data) // 2])
        bad: dict[str, dict[str, Any]] = {
            "checksum": {"sha256": "0" * 64},
            "shape": {"output": (1, 4 + len(NAMES), patches + 1)},
            "input": {"input": (1, 1, HIGH, WIDE)},
            "cut off": {"file": str(cut), "sha256": hashlib.sha256(cut.read_bytes()).hexdigest()},
        }
        for title, change in bad.items():
            why = refused(model.model_copy(update=change))
            good &= why is not None
            print(json.dumps({"bad": title, "refused": why}), flush=True)
    print("reached" if good else "missed")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())

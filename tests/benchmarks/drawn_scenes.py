"""Scenes of the shared generator before the camera's noise: to be bent, blurred, bleached or compressed by a benchmark.

The generator and the scorer lie in the shared folder beside the checkout.
"""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

TOOLS = Path(__file__).resolve().parents[3] / "shared" / "tools"
_STEM = "noise-free "


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """One scene before its noise.

    Attributes:
        picture: ndarray of shape (H, W, 3), dtype float32, levels.
        objects: What the generator says of each object.
        noise: Standard deviation that the condition asks for, levels.
        blur: Of the edges, px.
    """

    picture: NDArray[np.float32]
    objects: list[dict[str, Any]]
    noise: float
    blur: float


@cache
def tool(name: str) -> Any:
    """A module of the shared folder, `scenes` or `score_scenes`; the program ends when it is not there."""
    path = TOOLS / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    if not path.is_file() or spec is None or spec.loader is None:
        sys.exit(f"{path} is missing: the scene generator lies there")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def draw(condition: str, size: tuple[int, int], rng: np.random.Generator, count: int = 12) -> Drawn:
    """A scene of a condition without noise and impulses.

    Args:
        condition: A name of the generator's.
        size: (width, height), px.
        rng: Where chance comes from.
        count: Number of objects.
    """
    scenes = tool("scenes")
    wanted = {**scenes.DEF, **scenes.COND[condition]}
    scenes.COND[_STEM + condition] = {**scenes.COND[condition], "noise": 0.0, "impulse": 0.0}
    picture, objects, _, _ = scenes.scene(*size, _STEM + condition, rng, count)
    # The generator widens the blur with the picture in these two, by their names.
    grown = size[1] / 480.0 if condition in ("blur", "mixed") else 1.0
    blur = float(wanted["blur"]) * grown
    picture = np.asarray(picture, np.float32)
    if grown > 1.0:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), np.sqrt(blur**2 - wanted["blur"] ** 2)), np.float32)
    return Drawn(picture, objects, float(wanted["noise"]), blur)


def neutral(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """A picture without any tint: the mean of its channels in all of them."""
    return np.repeat(picture.mean(axis=2, keepdims=True), 3, axis=2)


def exposed(
    picture: NDArray[np.float32], noise: float, rng: np.random.Generator, impulse: float = 0.0
) -> NDArray[np.uint8]:
    """A picture with the generator's noise: 0.8 of it in every channel by itself, 0.6 in all alike."""
    own = rng.standard_normal(picture.shape).astype(np.float32) * (0.8 * noise)
    common = rng.standard_normal((*picture.shape[:2], 1)).astype(np.float32) * (0.6 * noise)
    out = np.asarray(np.clip(np.rint(picture + own + common), 0.0, 255.0), np.uint8)
    if impulse:
        chance = rng.random(out.shape[:2])
        out[chance < impulse / 2.0] = 0
        out[chance > 1.0 - impulse / 2.0] = 255
    return out

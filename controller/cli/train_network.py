"""`controller train --model`: a small network learnt from crops of parts, and a recipe that uses it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from controller.cli.annotate import FILE, read_annotations
from controller.cli.looking import Looking
from controller.errors import InputError
from controller.vision.models import painted
from controller.vision.models.cnn import MARGIN, SIDE, learnt, settings_for
from controller.vision.models.crops import crops
from controller.vision.models.network import network
from controller.vision.models.settings import Model

_NEAR = 0.3
"""An object found this share of its size from an annotated centre is the annotated one."""
_HELD_OUT = 5
"""Every fifth picture is not learnt from but tried on."""


@dataclass(frozen=True, slots=True, eq=False)
class Crops:
    """What a network learns from, or is tried on.

    Attributes:
        images: ndarray of shape (n, SIDE, SIDE, 3), dtype uint8, BGR.
        labels: ndarray of shape (n,): indices into the names.
    """

    images: NDArray[np.uint8]
    labels: NDArray[np.int64]


def learn_painted(count: int, seed: int) -> tuple[tuple[str, ...], Crops, Crops]:
    """Names, crops to learn from, and others to try it on, all painted."""
    new = max(count // 8, 60)
    return (
        painted.SHAPES,
        Crops(*painted.crops_of_shapes(count, seed, SIDE, MARGIN)),
        Crops(*painted.crops_of_shapes(new, seed + 1, SIDE, MARGIN)),
    )


def learn_folder(folder: Path, recipe: str) -> tuple[tuple[str, ...], Crops, Crops]:
    """Names, crops to learn from, and others from pictures left out, of annotated pictures.

    Raises:
        InputError: There are no annotations, or too few.
    """
    looking = Looking(recipe)
    images: list[list[NDArray[np.uint8]]] = [[], []]
    said: list[list[str]] = [[], []]
    for number, entry in enumerate(read_annotations(folder / FILE)["images"]):
        detections, surfaces, _ = looking.at(folder / Path(entry["file"]).name, whole_only=False)
        cut = crops(surfaces.image, detections, MARGIN, (SIDE, SIDE))
        new = int(number % _HELD_OUT == _HELD_OUT - 1)
        for thing in entry["objects"]:
            near = [math.dist(item.center_px, thing["centre_px"]) / max(item.size_px) for item in detections]
            if near and min(near) <= _NEAR:
                images[new].append(cut[int(np.argmin(near))])
                said[new].append(str(thing.get("label", thing["class"])))
    names = tuple(sorted(set(said[0])))
    if len(names) < 2 or not images[1]:
        raise InputError(
            f"{folder}: {len(names)} classes in {len(images[0])} objects are too few for a network",
            "annotate five pictures and more with two classes and more",
        )
    index = {name: k for k, name in enumerate(names)}
    kept = [k for k, name in enumerate(said[1]) if name in index]
    return (
        names,
        Crops(np.stack(images[0]), np.array([index[name] for name in said[0]])),
        Crops(
            np.stack([images[1][k] for k in kept]) if kept else np.zeros((0, SIDE, SIDE, 3), np.uint8),
            np.array([index[said[1][k]] for k in kept], np.int64),
        ),
    )


def learn_network(
    file: Path,
    names: Sequence[str],
    seen: Crops,
    new: Crops,
    *,
    epochs: int,
    seed: int,
    say: Callable[[str], None],
) -> tuple[Model, Path, float]:
    """Learn, write the ONNX file and a recipe beside it, and try it on new crops.

    Returns:
        What a recipe says of the model; the recipe's file; the share of new crops named rightly.

    Raises:
        InputError: PyTorch is missing, or the files cannot be written.
        ConfigError: The network that was written does not do what it should.
    """
    data = learnt(seen.images, seen.labels, names, epochs=epochs, seed=seed, say=say)
    settings = settings_for(str(file), data, names)
    recipe = file.with_suffix(".toml")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_name(file.name + ".part")
        part.write_bytes(data)
        part.replace(file)
        recipe.write_text(recipe_text(file.stem, settings), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{file} cannot be written ({error.strerror})", "name another with --model") from error
    best = network(settings).scores(new.images).argmax(axis=1)
    return settings, recipe, float(np.mean(best == new.labels)) if len(new.labels) else 0.0


def recipe_text(name: str, model: Model) -> str:
    """A recipe in TOML that finds as `precise` does and names by a model."""
    said = model.model_dump(mode="json", exclude_defaults=True)
    lines = [f"{key} = {json.dumps(value)}" for key, value in said.items()]
    head = f'schema_version = 1\nname = {json.dumps(name[:60])}\nmethod = "precise"\n\n[model]\n'
    return head + "\n".join(lines) + "\n"

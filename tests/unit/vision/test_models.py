"""Trained models: what is declared is checked before anything is named; what they say lands on the right part."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.config.files import shipped
from controller.config.loader import validate
from controller.domain import Frame
from controller.errors import ConfigError
from controller.vision.detect import detect
from controller.vision.models import network as network_module
from controller.vision.models import painted
from controller.vision.models.cnn import MARGIN, SIDE
from controller.vision.models.crops import square
from controller.vision.models.naming import named
from controller.vision.models.network import Floats32, Network, network
from controller.vision.models.settings import Model
from controller.vision.recipe import load_recipe
from tests.benchmarks import surfaces
from tests.benchmarks.surfaces import SQUARE, Image, Thing, polygon

DETECTOR: dict[str, Any] = {
    "file": "boxes.onnx",
    "sha256": "0" * 64,
    "task": "detect",
    "input": [1, 3, 120, 160],
    "output": [1, 0, 6],
    "labels": ["bolt", "nut"],
}


def _picture() -> Image:
    red = ((40, 36, 190), (40, 36, 190))
    things = [Thing([SQUARE * 26.0], red, 80.0, 80.0, 0.4), Thing([polygon(6, 26.0)], red, 230.0, 130.0, 0.2)]
    return surfaces.paint(things, (320, 240), np.random.default_rng(2))


def _shipped() -> dict[str, Any]:
    model = load_recipe("learned").model
    assert model is not None
    return model.model_dump(mode="json")


def _model(changes: dict[str, Any]) -> Model:
    return validate(_shipped() | changes, Model, "recipe")


def test_the_shipped_network_names_parts_of_a_picture() -> None:
    found = detect(Frame(1, 0.0, _picture()), load_recipe("learned")).detections
    assert [item.label for item in found] == ["square", "hexagon"]


def test_the_shipped_network_knows_new_crops() -> None:
    images, labels = painted.crops_of_shapes(120, 77, SIDE, MARGIN)
    said = network(_model({})).scores(images).argmax(axis=1)
    # 97 % of 3000 by the benchmark: 120 crops of which 8 are wrong would be three standard deviations off.
    assert np.mean(said == labels) > 0.93


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"sha256": "0" * 64}, "its sha256 is"),
        ({"file": "missing.onnx"}, "no such file"),
        ({"output": [1, 4], "labels": ["a", "b", "c", "d"]}, r"gives \[1, 6\], the recipe says \[1, 4\]"),
        ({"input": [1, 1, 48, 48]}, "cannot take"),
        ({"input": [1, 3, 64, 40]}, "learned|cannot take|gives"),
    ],
)
def test_a_model_that_is_not_what_the_recipe_says_is_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        network(_model(changes))


@pytest.mark.parametrize(
    "changes",
    [
        {"labels": ["one", "two"]},
        {"labels": ["a", "a", "c", "d", "e", "f"]},
        {"input": [1, 2, 48, 48]},
        {"input": [100, 3, 4000, 4000]},
        {"output": [100_000_000, 6]},
    ],
)
def test_a_declaration_that_makes_no_sense_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        _model(changes)


def test_a_damaged_or_huge_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = shipped("models/shapes.onnx").read_bytes()
    path = tmp_path / "cut.onnx"
    path.write_bytes(data[: len(data) // 2])
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    with pytest.raises(ConfigError, match=r"no network that OpenCV can read|cannot take"):
        network(_model({"file": str(path), "sha256": digest}))
    monkeypatch.setattr(network_module, "MOST_BYTES", 1000)
    with pytest.raises(ConfigError, match="larger than"):
        network(_model({"file": str(path), "sha256": "1" * 64}))


def _says(rows: list[list[float]], **changes: Any) -> Network:
    """A detector that always says the same."""
    settings = validate(DETECTOR | changes, Model, "recipe")

    def run(batch: Floats32) -> Floats32:
        assert batch.shape == (1, 3, 120, 160)
        values = np.array([rows], np.float32)
        return values if settings.layout == "corners" else np.ascontiguousarray(values.transpose(0, 2, 1))

    return Network(settings, run)


def test_boxes_of_a_detector_name_what_they_cover_and_add_what_nobody_saw() -> None:
    picture = _picture()
    frame = Frame(1, 0.0, picture)
    found = detect(frame, load_recipe("precise")).detections
    # The frame is twice as large as the input: the square lies about (40, 40) there.
    rows = [[26, 26, 54, 54, 0.9, 0], [27, 27, 53, 54, 0.8, 1], [130, 10, 150, 30, 0.7, 1], [0, 0, 9, 9, 0.2, 1]]
    out = named(frame, found, _says([[float(v) for v in row] for row in rows]))
    assert [item.label for item in out] == ["bolt", "hexagon", "nut"]
    assert "box" in out[2].flags
    assert out[2].center_px == pytest.approx((280.5, 40.5))
    centres = [[(a + c) / 2, (b + d) / 2, c - a, d - b, s * (k == 0), s * (k == 1)] for a, b, c, d, s, k in rows]
    columns = _says([[float(v) for v in row] for row in centres], layout="centres", output=[1, 6, 0])
    assert [item.label for item in named(frame, found, columns)] == ["bolt", "hexagon", "nut"]


def test_values_that_are_no_numbers_are_refused() -> None:
    broken = _says([[float("nan")] * 6])
    with pytest.raises(ConfigError, match="no numbers"):
        named(Frame(1, 0.0, _picture()), [], broken)


def test_a_square_beyond_the_rim_repeats_it() -> None:
    image = np.full((20, 20, 3), 7, np.uint8)
    assert (square(image, (0.0, 0.0), 16.0, (8, 8)) == 7).all()
    assert (square(image, (-90.0, 0.0), 16.0, (8, 8)) == 0).all()

from __future__ import annotations

import math

import numpy as np

from controller.domain import Frame
from controller.vision.appearance import naming, texture
from controller.vision.appearance.tiles import tiles
from tests.benchmarks import surfaces
from tests.benchmarks.surfaces import SQUARE, Thing
from tests.benchmarks.texture import dataset, detection_of, scene


def test_six_textures_are_named_at_any_turn_size_blur_and_noise() -> None:
    values, names, _, _ = dataset(5, 15)
    right = np.mean([a == b for a, b in zip(names, texture.names_of(values), strict=True)])
    # The issue asks for 97 %; of these 300 views none of the training's, 99 % leaves three.
    assert right >= 0.98


def test_a_descriptor_hardly_changes_with_the_turn() -> None:
    turns = [0.0, 0.4, math.pi / 4, 1.2]
    colours = ((40, 60, 90), (160, 170, 180))
    things = [
        Thing([SQUARE * 30.0], colours, 60.0 + 100.0 * k, 60.0, turn, surfaces.striped(9.0, 0.2))
        for k, turn in enumerate(turns)
    ]
    picture = surfaces.paint(things, (420, 120), np.random.default_rng(0), blur=0.7, noise=2.0)
    found = [detection_of(thing, Frame(1, 0.0, picture)) for thing in things]
    values = texture.descriptors(tiles(picture, found))
    coherence = values[:, 7]
    assert coherence.min() > 0.8  # stripes share one axis whatever their turn
    assert texture.names_of(values) == ["striped"] * 4


def test_parts_of_no_contrast_are_called_as_their_descriptors_say() -> None:
    picture, things, _, _ = scene(np.random.default_rng(8))
    surface = tiles(picture, [detection_of(thing, Frame(1, 0.0, picture)) for thing in things])
    assert texture.names(surface) == texture.names_of(texture.descriptors(surface))


def test_no_parts_have_no_textures() -> None:
    assert texture.descriptors(tiles(np.zeros((40, 40, 3), np.uint8), [])).shape == (0, texture.LENGTH)
    assert texture.names_of(np.empty((0, texture.LENGTH), np.float32)) == []
    assert texture.names(tiles(np.zeros((40, 40, 3), np.uint8), [])) == []


def test_a_namer_learns_what_products_of_two_figures_can_tell() -> None:
    random = np.random.default_rng(0)
    values = random.standard_normal((200, 3)).astype(np.float32)
    labels = ["in" if np.hypot(v[0], v[1]) < 1.0 else "out" for v in values]
    namer = naming.fit(values, labels, ["in", "out"])
    said = [namer.names[k] for k in namer.scores(values).argmax(axis=1)]
    # A circle is within reach of products of two figures.
    assert np.mean([a == b for a, b in zip(labels, said, strict=True)]) > 0.85

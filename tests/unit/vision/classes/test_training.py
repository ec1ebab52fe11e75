from __future__ import annotations

import numpy as np

from controller.vision.classes.features import LENGTH
from controller.vision.classes.training import Examples, by_class, cross_validated


def test_what_is_tested_was_not_learnt_from() -> None:
    """Classes that differ only by picture: who learns from the tested picture is right, an honest test is not."""
    random = np.random.default_rng(0)
    pictures = tuple(f"{k}.png" for k in range(10) for _ in range(4))
    # Each picture has a place of its own in the features, and one label at random.
    places = np.repeat(random.standard_normal((10, LENGTH)) * 5.0, 4, axis=0)
    values = (places + 0.01 * random.standard_normal(places.shape)).astype(np.float32)
    labels = tuple("ab"[k % 2] for k in range(10) for _ in range(4))
    said = cross_validated(Examples(labels, pictures, values[:, :3], values))
    assert by_class(labels, said["nearest_views"]) == {"a": {"unknown": 20}, "b": {"unknown": 20}}


def test_classes_that_differ_are_learnt_by_all_ways() -> None:
    random = np.random.default_rng(1)
    labels = tuple("ab"[k % 2] for k in range(40))
    pictures = tuple(f"{k // 2}.png" for k in range(40))
    center = np.array([[0.0], [1.0]])[[k % 2 for k in range(40)]]
    values = (center + 0.002 * random.standard_normal((40, LENGTH))).astype(np.float32)
    said = cross_validated(Examples(labels, pictures, values[:, :3], values))
    assert all(tuple(names) == labels for names in said.values())

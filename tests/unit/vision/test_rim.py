"""What reaches over the table is told from parts, shadows and changing light."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from controller.vision.rim import Rim, coarse

Image = NDArray[np.uint8]


def table(seed: int = 0) -> Image:
    """A light table with grain."""
    noise = np.random.default_rng(seed).normal(0.0, 5.0, (360, 640, 3))
    return np.asarray(np.clip(185.0 + noise, 0, 255), np.uint8)


@pytest.fixture
def rim() -> Rim:
    inside = np.zeros((360, 640), np.uint8)
    inside[120:, 120:520] = 255
    strip = np.where(inside > 0, 0, 255).astype(np.uint8)
    return Rim(coarse(table()), strip, inside)


def forearm(colour: tuple[int, int, int], length: int = 200, width: int = 60) -> Image:
    """Something that reaches in from the top."""
    image = table(1)
    image[:length, 300 : 300 + width] = colour
    return image


@pytest.mark.parametrize("colour", [(118, 148, 205), (40, 60, 90), (30, 30, 30), (60, 140, 60)])
def test_a_hand_of_any_skin_or_glove_is_seen(rim: Rim, colour: tuple[int, int, int]) -> None:
    assert rim.crossed(coarse(forearm(colour)))


def test_an_empty_table_and_another_brightness_are_nothing(rim: Rim) -> None:
    assert not rim.crossed(coarse(table(2)))
    assert not rim.crossed(coarse(np.asarray(table(2) * 0.8, np.uint8)))


def test_a_shadow_across_the_strip_is_no_hand(rim: Rim) -> None:
    image = table(3)
    image[:200, 300:380] = np.asarray(image[:200, 300:380] * 0.65, np.uint8)
    assert not rim.crossed(coarse(image))


def test_a_part_that_lies_in_the_strip_is_no_hand(rim: Rim) -> None:
    image = table(4)
    image[40:90, 300:350] = (40, 40, 190)
    assert not rim.crossed(coarse(image))
    image = table(4)
    image[200:250, 300:350] = (40, 40, 190)
    assert not rim.crossed(coarse(image))


def test_fingers_that_do_not_reach_the_work_area_yet_are_not_over_it(rim: Rim) -> None:
    assert not rim.crossed(coarse(forearm((118, 148, 205), length=60)))

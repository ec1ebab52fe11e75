"""The soft shadow of an arm that stands beside an empty table is no part, nor does it make others of what is near."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.domain import Frame
from controller.geometry import PlaneMap
from controller.service.manual import by_ruler
from controller.vision.detect import detect
from controller.vision.leftover import leftovers
from controller.vision.recipe import load_recipe
from tests.unit.vision.test_leftover import gray, square, table

ABOVE = by_ruler(load_cell(shipped("sim.toml"))).plane(12.0)
"""Half way up a part: its sides show."""


def arm_shadow(seed: int, soft: float, depth: float) -> NDArray[np.uint8]:
    """An empty table of brushed metal on which links that reach in from below cast a shadow, soft by so many px."""
    rng = np.random.default_rng(seed)
    shade = np.zeros((720, 1280), np.float32)
    x, y = 640.0 + rng.uniform(-200.0, 200.0), 760.0
    for _ in range(6):
        end = x + rng.uniform(-160.0, 160.0), y - rng.uniform(20.0, 110.0)
        cv2.line(shade, (int(x), int(y)), (int(end[0]), int(end[1])), (1.0,), int(rng.uniform(30.0, 90.0)))
        x, y = end
    light = 1.0 - depth * np.asarray(cv2.GaussianBlur(shade, (0, 0), soft))[..., None]
    grain = np.asarray(cv2.GaussianBlur(rng.normal(0.0, 4.0, (1, 1280)), (0, 0), 0.8)).reshape(1, 1280, 1)
    picture = np.array([170.0, 178.0, 182.0]) * light + grain + rng.normal(0.0, 2.0, (720, 1280, 3))
    return np.asarray(np.clip(picture, 0, 255), np.uint8)


@pytest.mark.parametrize("plane", [None, ABOVE])
@pytest.mark.parametrize(("seed", "soft", "depth"), [(0, 8.0, 0.15), (1, 14.0, 0.35), (4, 4.0, 0.35), (4, 14.0, 0.35)])
def test_an_empty_table_in_an_arms_shadow_is_empty(
    seed: int, soft: float, depth: float, plane: PlaneMap | None
) -> None:
    picture = arm_shadow(seed, soft, depth)
    assert detect(Frame(1, 0.0, picture), load_recipe("precise"), plane=plane).detections == ()


def test_what_may_be_a_shadow_does_not_tell_how_clearly_objects_stand_out() -> None:
    faint = square(220.5, 100.5, 40.0)
    strength = table((100, 40, 21, 21, 10.0))
    assert len(leftovers(strength, [faint], [faint], 2, None, 6.0, gray)) == 1
    assert leftovers(strength, [faint], [], 2, None, 6.0, gray) == []

"""Upright parts whose sides lean into view, in the colour of their tops: the top face is what has a shape."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.domain import Frame, Shape
from controller.service.manual import by_ruler
from controller.vision.detect import detect
from controller.vision.recipe import load_recipe
from tests.unit.vision.pictures import corners, paint

PLANE = by_ruler(load_cell(shipped("sim.toml"))).plane(12.0)
TABLE, GREEN = (170.0, 178.0, 182.0), (60.0, 140.0, 40.0)
SIDE = 160


@pytest.mark.parametrize("shape", [Shape.CIRCLE, Shape.SQUARE, Shape.RECTANGLE, Shape.HEXAGON, Shape.TRIANGLE])
@pytest.mark.parametrize("share", [0.6, 1.0])
def test_a_part_is_named_though_its_sides_are_hardly_darker_than_its_top(shape: Shape, share: float) -> None:
    """Where they are as light, the edge between them is not to be seen at all."""
    mm = corners(shape, 40.0, 0.3) + (70.0, 110.0)
    top, foot = (PLANE.at(height).to_pixels(mm) for height in (24.0, 0.0))
    whole = cv2.convexHull(np.concatenate([top, foot]).astype(np.float32))[:, 0].astype(np.float64)
    x, y = np.floor(top.mean(axis=0) - SIDE / 2).astype(int)
    dark = (share * GREEN[0], share * GREEN[1], share * GREEN[2])
    picture = np.asarray(TABLE + np.random.default_rng(0).normal(0.0, 2.0, (720, 1280, 3)), np.uint8)
    picture[y : y + SIDE, x : x + SIDE] = paint([(whole - (x, y), dark), (top - (x, y), GREEN)], (SIDE, SIDE), TABLE)
    (one,) = detect(Frame(1, 0.0, picture), load_recipe("precise"), plane=PLANE).detections
    assert one.shape is shape

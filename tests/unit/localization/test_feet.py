"""A foot expected one strip too far out is brought back to where the picture has it."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.domain import CellCalibration, Frame, Shape
from controller.localization.feet import corrected, support
from controller.localization.locate import locate
from controller.localization.prism import footprint
from tests.unit.localization.prisms import cell, detection

Array = NDArray[np.float64]
PLACE, YAW, HEIGHT = (110.0, 70.0), 0.25, 20.0


def corners(shape: Shape, sides: tuple[float, ...], calibration: CellCalibration) -> tuple[Array, Array]:
    feet = footprint(shape, PLACE, YAW, sides)
    return calibration.plane(0.0).to_pixels(feet), calibration.plane(HEIGHT).to_pixels(feet)


def hull(foot: Array, top: Array) -> Array:
    return np.asarray(cv2.convexHull(np.vstack([foot, top]).astype(np.float32))[:, 0], np.float64)


def picture(foot: Array, top: Array) -> NDArray[np.uint8]:
    """A part with dark sides on a light table, drawn four times too large."""
    fine = np.full((720 * 4, 1280 * 4, 3), 180, np.uint8)
    for polygon, colour in ((hull(foot, top), (40, 60, 30)), (top, (60, 170, 90))):
        cv2.fillConvexPoly(fine, np.rint((polygon + 0.5) * 4 - 0.5).astype(np.int32), colour)
    small = cv2.resize(fine, (1280, 720), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 0.7), np.uint8)


def dense(polygon: Array) -> Array:
    ends = np.roll(polygon, -1, axis=0)
    shares = np.linspace(0.0, 1.0, 24, endpoint=False)[:, None]
    return np.vstack([a + shares * (b - a) for a, b in zip(polygon, ends, strict=True)])


@pytest.mark.parametrize(("shape", "sides"), [(Shape.SQUARE, (42.0,)), (Shape.RECTANGLE, (56.0, 40.0))])
def test_a_side_taken_for_top_face_is_given_back(shape: Shape, sides: tuple[float, ...]) -> None:
    calibration = cell()
    foot, top = corners(shape, sides, calibration)
    image = picture(foot, top)
    # What vision hands over when it takes the dark side along one long edge for top face: the face reaches
    # down to that foot, and the foot is expected once more as far out.
    strips = [(foot[k] + foot[k - 3] - top[k] - top[k - 3]) / 2 for k in range(4)]
    normals = [np.array([e[1], -e[0]]) / np.linalg.norm(e) for e in (foot[k - 3] - foot[k] for k in range(4))]
    middle = top.mean(axis=0)
    outward = [n * np.sign(n @ ((foot[k] + foot[k - 3]) / 2 - middle)) for k, n in enumerate(normals)]
    widths = [float(n @ s) for n, s in zip(outward, strips, strict=True)]
    side = int(np.argmax(widths))
    assert widths[side] > 3.0
    false_foot, false_top = foot.copy(), top.copy()
    for corner in (side, side - 3):
        false_foot[corner] += widths[side] * outward[side]
        false_top[corner] += widths[side] * outward[side]
    outline = dense(hull(false_foot, false_top))
    moved = corrected(image, outline, false_foot, false_top)
    assert moved is not None
    assert support(image, foot, top) > support(image, false_foot, false_top)
    seen = dataclasses.replace(detection(shape, outline, None), frame=Frame(1, 0.0, image))
    seen = dataclasses.replace(seen, angle=-math.atan2(*(top[1] - top[0])[::-1]))
    (thing,) = locate([seen], calibration, lambda _: HEIGHT).objects
    # Corners of the moved side are rounded by the move; without it the part is 2 mm off.
    assert math.dist(thing.center, PLACE) < 0.3
    assert thing.size[0] == pytest.approx(sides[0], abs=0.5)


def test_a_true_foot_stays() -> None:
    calibration = cell()
    foot, top = corners(Shape.SQUARE, (42.0,), calibration)
    assert corrected(picture(foot, top), dense(hull(foot, top)), foot, top) is None


def test_an_empty_picture_bears_out_nothing() -> None:
    foot, top = corners(Shape.SQUARE, (42.0,), cell())
    empty = np.full((720, 1280, 3), 120, np.uint8)
    assert support(empty, foot, top) == 0.0
    assert corrected(empty, dense(hull(foot, top)), foot, top) is None

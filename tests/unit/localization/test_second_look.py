"""Where an outline runs beside the part, the picture itself tells where the prism of the stated height is."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.domain import CellCalibration, Detection, Frame, Shape
from controller.geometry import angle_difference
from controller.localization.locate import locate
from controller.localization.prism import Noise, footprint
from controller.localization.prism_fit import Start, fit_prisms
from controller.localization.remeasure import misfits, remeasured
from controller.localization.second_look import second_looks
from tests.unit.localization.prisms import cell, detection

Array = NDArray[np.float64]
PLACE, YAW, HEIGHT = (110.0, 70.0), 0.25, 20.0
SIDES: dict[Shape, tuple[float, ...]] = {
    Shape.SQUARE: (42.0,),
    Shape.RECTANGLE: (56.0, 40.0),
    Shape.HEXAGON: (24.0,),
    Shape.TRIANGLE: (46.0,),
    Shape.CIRCLE: (40.0,),
}


def corners(shape: Shape, calibration: CellCalibration, height: float = HEIGHT) -> tuple[Array, Array]:
    feet = footprint(shape, PLACE, YAW, SIDES[shape])
    return calibration.plane(0.0).to_pixels(feet), calibration.plane(height).to_pixels(feet)


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


def seen(shape: Shape, outline: Array, image: NDArray[np.uint8]) -> Detection:
    found = detection(shape, outline, None if shape is Shape.CIRCLE else -YAW + 1.5)
    return dataclasses.replace(found, frame=Frame(1, 0.0, image))


@pytest.mark.parametrize("shape", SIDES)
@pytest.mark.parametrize("believed", [12.0, 29.0])
def test_an_outline_of_another_height_is_set_right_by_the_picture(shape: Shape, believed: float) -> None:
    """Vision expects every part to be of one height; this one is 20 mm tall, as its class says."""
    calibration = cell()
    image = picture(*corners(shape, calibration))
    handed_over = dense(hull(*corners(shape, calibration, believed)))
    if shape is Shape.CIRCLE:
        handed_over = handed_over[::24]
    (thing,) = locate([seen(shape, handed_over, image)], calibration, lambda _: HEIGHT).objects
    # Drawn to a quarter of a pixel (0.15 mm); taken as it is, the outline is 1.5 mm and more off.
    assert math.dist(thing.center, PLACE) < 0.25
    assert thing.height == pytest.approx(HEIGHT, abs=0.6)
    if thing.yaw is not None and shape.period is not None:
        assert abs(angle_difference(thing.yaw, YAW, shape.period)) < math.radians(0.5)


@pytest.mark.parametrize("strips", [1.0, -1.0])
@pytest.mark.parametrize("shape", [Shape.SQUARE, Shape.RECTANGLE])
def test_a_foot_one_strip_off_is_given_back(shape: Shape, strips: float) -> None:
    """A dark side taken for top face puts the foot once more as far out; the face's border taken for the foot, in."""
    calibration = cell()
    foot, top = corners(shape, calibration)
    ends = [(foot[k] + foot[k - 3] - top[k] - top[k - 3]) / 2 for k in range(4)]
    normals = [np.array([e[1], -e[0]]) / np.linalg.norm(e) for e in (foot[k - 3] - foot[k] for k in range(4))]
    middle = top.mean(axis=0)
    outward = [n * np.sign(n @ ((foot[k] + foot[k - 3]) / 2 - middle)) for k, n in enumerate(normals)]
    widths = [float(n @ s) for n, s in zip(outward, ends, strict=True)]
    side = int(np.argmax(widths))
    assert widths[side] > 3.0
    false_foot, false_top = foot.copy(), top.copy()
    for corner in (side, side - 3):
        false_foot[corner] += strips * widths[side] * outward[side]
        false_top[corner] += strips * widths[side] * outward[side]
    wrong = seen(shape, dense(hull(false_foot, false_top)), picture(foot, top))
    (thing,) = locate([wrong], calibration, lambda _: HEIGHT).objects
    assert math.dist(thing.center, PLACE) < 0.25
    assert thing.size[0] == pytest.approx(SIDES[shape][0], abs=0.3)


def test_a_good_outline_is_left_alone_and_an_empty_picture_says_nothing() -> None:
    calibration = cell()
    foot, top = corners(Shape.SQUARE, calibration)
    good = picture(foot, top)
    assert misfits(good, [(foot, top)]) < 0.2
    empty = np.full((720, 1280, 3), 120, np.uint8)
    assert misfits(empty, [(foot, top)]) == 3.0
    assert [len(outline) for outline in remeasured(empty, [(foot, top)], 6.0)] == [0]
    (thing,) = locate([seen(Shape.SQUARE, dense(hull(foot, top)), empty)], calibration, lambda _: HEIGHT).objects
    assert math.dist(thing.center, PLACE) < 0.05


def test_a_strained_height_is_looked_at_even_where_the_edges_are_near() -> None:
    """Almost three deviations of the height off, and its edges within noise and blur of those in the picture."""
    calibration, shape = cell(), Shape.TRIANGLE
    foot, top = corners(shape, calibration)
    image, outline = picture(foot, top), dense(hull(foot, top))
    (thing,) = locate([seen(shape, outline, image)], calibration, lambda _: HEIGHT).objects
    start = Start(outline, shape, (*PLACE, YAW), SIDES[shape], HEIGHT)
    (fit,) = fit_prisms([start], calibration.camera, calibration.T_table_camera, Noise())
    strained = dataclasses.replace(fit, height=HEIGHT + 2.7 * Noise().height)
    thing = dataclasses.replace(thing, height=HEIGHT)
    above = calibration.plane(strained.height).to_pixels(footprint(shape, fit.center, fit.yaw, fit.dimensions))
    beside = float(misfits(image, [(foot, above)])[0])
    assert 0.1 < beside < 0.2  # px
    (found,) = second_looks([(thing, strained)], calibration, Noise(), lambda _: None)
    # The picture is drawn to a quarter of a pixel, 0.7 mm of height there.
    assert found.height != strained.height
    assert found.height == pytest.approx(HEIGHT, abs=0.3)


def test_a_disputed_height_is_told_by_the_deviation() -> None:
    """No picture to ask, and an outline that says 26 mm where 20 are stated: placed, and not trusted."""
    calibration = cell()
    empty = np.full((720, 1280, 3), 120, np.uint8)
    wrong = seen(Shape.SQUARE, dense(hull(*corners(Shape.SQUARE, calibration, 26.0))), empty)
    found = locate([wrong], calibration, lambda _: HEIGHT).objects
    for thing in found:
        assert math.dist(thing.center, PLACE) < 3.0 * thing.sigma

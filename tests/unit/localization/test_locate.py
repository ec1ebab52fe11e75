"""Exact silhouettes of prisms lead back to the prisms; what is no such prism is refused."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from controller.domain import CellCalibration, Detection, Shape
from controller.geometry import angle_difference
from controller.localization.locate import locate
from controller.localization.prism import footprint, unit_footprint
from controller.localization.prism_fit import Start, silhouettes
from tests.unit.localization.prisms import cell, detection, outline, polygon


def stating(height: float) -> Callable[[Detection], float]:
    return lambda detection: height


SHAPES = [Shape.SQUARE, Shape.RECTANGLE, Shape.CIRCLE, Shape.HEXAGON, Shape.TRIANGLE]
#: Direction of `polygon`'s side or long axis is 0 for all shapes.
LONG = {Shape.SQUARE: 1.0, Shape.RECTANGLE: 1.5, Shape.CIRCLE: 1.0, Shape.HEXAGON: 2 / math.sqrt(3)}


def placed(
    shape: Shape,
    size: float,
    x: float,
    y: float,
    yaw: float,
    height: float,
    calibration: CellCalibration,
    shift: float = 0.0,
    random: np.random.Generator | None = None,
) -> Detection:
    """An outline with every edge moved by its own error (px, standard deviation), and what vision says."""
    c, s = math.cos(yaw), math.sin(yaw)
    feet = polygon(shape, size) @ np.array([[c, s], [-s, c]]) + [x, y]
    pixels, names = outline(feet, height, calibration)
    edges = names.astype(int)
    if random is not None:
        if shape is Shape.CIRCLE:
            edges = np.arange(len(pixels)) * 6 // len(pixels)
        around = np.roll(pixels, -1, axis=0) - np.roll(pixels, 1, axis=0)
        normal = np.column_stack([around[:, 1], -around[:, 0]]) / np.linalg.norm(around, axis=1)[:, None]
        pixels = pixels + normal * random.normal(0.0, shift, edges.max() + 1)[edges][:, None]
    if shape is Shape.CIRCLE:
        return detection(shape, pixels, None)
    a, b = calibration.plane(0.0).to_pixels([[x, y], [x + 20 * c, y + 20 * s]])
    return detection(shape, pixels, math.atan2(-(b - a)[1], (b - a)[0]) + 0.05)


Draw = tuple[np.random.Generator, CellCalibration, float, float, float, float, float]


def draws(count: int, seed: int = 0) -> Iterator[Draw]:
    random = np.random.default_rng(seed)
    for _ in range(count):
        yield (
            random,
            cell(random.uniform(0.0, 0.35), random.uniform(0.0, 2 * math.pi)),
            random.uniform(30.0, 50.0),
            random.uniform(-110.0, 110.0),
            random.uniform(-110.0, 110.0),
            random.uniform(0.0, 2 * math.pi),
            float(random.choice([10.0, 20.0, 30.0])),
        )


@pytest.mark.parametrize("shape", SHAPES)
def test_an_exact_silhouette_gives_the_prism_back(shape: Shape) -> None:
    for _, calibration, size, x, y, yaw, height in draws(25):
        found = locate([placed(shape, size, x, y, yaw, height, calibration)], calibration, stating(height))
        assert not found.refused
        (thing,) = found.objects
        # A circle is a polygon of 96 corners in the fit and of 2000 in the test: 0.01 mm; others are exact.
        limit = 0.01 if shape is Shape.CIRCLE else 1e-3
        assert math.dist(thing.center, (x, y)) < limit
        assert thing.height == pytest.approx(height, abs=0.05)
        assert min(thing.size) == pytest.approx(size * 1.0, abs=0.02)
        if shape in LONG:
            assert max(thing.size) == pytest.approx(size * LONG[shape], abs=0.02)
        period = shape.period
        if period is None:
            assert thing.yaw is None
        else:
            assert thing.yaw is not None
            assert abs(angle_difference(thing.yaw, yaw, period)) < 1e-4
            assert 0.0 <= thing.yaw < period
        assert thing.calibration_id == "cell-test"


@pytest.mark.parametrize("shape", SHAPES)
def test_shared_edge_errors_give_the_published_accuracy(shape: Shape) -> None:
    """Edges shifted by 0.1 px each, heights off by 0.5 mm: position 0.2 mm and size 0.3 mm at the 95th percentile."""
    errors: list[float] = []
    sizes: list[float] = []
    sigmas: list[float] = []
    for random, calibration, size, x, y, yaw, height in draws(60, seed=1):
        seen = placed(shape, size, x, y, yaw, height, calibration, 0.1, random)
        stated = height + random.normal(0.0, 0.5)
        (thing,) = locate([seen], calibration, stating(stated)).objects
        errors.append(math.dist(thing.center, (x, y)))
        sizes.append(abs(min(thing.size) - size))
        sigmas.append(thing.sigma)
    assert np.mean(errors) < 0.12
    assert np.percentile(errors, 95) < 0.2
    assert np.percentile(sizes, 95) < 0.3
    # Distance in a plane of a deviation sigma along each axis: 1.25 sigma in the mean; sigma is the larger one.
    assert 0.4 < np.mean(errors) / np.mean(sigmas) < 1.6


@pytest.mark.parametrize("shape", SHAPES)
def test_refinement_beats_the_plane_at_half_height(shape: Shape) -> None:
    rough: list[float] = []
    fine: list[float] = []
    for random, calibration, size, x, y, yaw, height in draws(25, seed=2):
        seen = placed(shape, size, x, y, yaw, height, calibration, 0.1, random)
        for out, refine in ((rough, False), (fine, True)):
            (thing,) = locate([seen], calibration, stating(height), refine=refine).objects
            out.append(math.dist(thing.center, (x, y)))
    assert np.mean(fine) < 0.4 * np.mean(rough)
    # h/2 itself is a sound start: within 5 % of the height, the worst of the five shapes.
    assert np.mean(rough) < 1.0


def test_a_prism_of_another_shape_is_refused() -> None:
    calibration = cell(0.1)
    for true, said in (
        (Shape.HEXAGON, Shape.CIRCLE),
        (Shape.CIRCLE, Shape.HEXAGON),
        (Shape.RECTANGLE, Shape.SQUARE),
        (Shape.TRIANGLE, Shape.SQUARE),
        (Shape.SQUARE, Shape.TRIANGLE),
    ):
        seen = placed(true, 40.0, 60.0, -30.0, 0.4, 20.0, calibration)
        wrong = detection(said, seen.outline_px, seen.angle)
        found = locate([wrong], calibration, stating(20.0))
        assert not found.objects, (true, said)
        assert found.refused[0][0] is wrong
        assert found.refused[0][1]


def test_a_shadow_on_one_side_is_refused_or_harmless() -> None:
    """A strip of shadow 3 px wide taken for the part, along one whole side."""
    calibration = cell(0.0)
    seen = placed(Shape.SQUARE, 40.0, 50.0, 40.0, 0.3, 20.0, calibration)
    pixels = seen.outline_px.copy()
    plane = calibration.plane(10.0)
    flat = plane.to_plane(pixels)
    local = (flat - [50.0, 40.0]) @ np.array([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]])
    side = (local[:, 0] > 18.0) & (np.abs(local[:, 1]) < 12.0)
    flat[side] += 1.8 * np.array([math.cos(0.3), math.sin(0.3)])
    found = locate([detection(Shape.SQUARE, plane.to_pixels(flat), seen.angle)], calibration, stating(20.0))
    assert not found.objects or math.dist(found.objects[0].center, (50.0, 40.0)) < 0.5


def test_a_wrong_direction_is_recovered() -> None:
    calibration = cell(0.2)
    for wrong in (0.35, -0.5, 0.78):
        seen = placed(Shape.SQUARE, 40.0, -60.0, 30.0, 0.4, 20.0, calibration)
        turned = detection(Shape.SQUARE, seen.outline_px, (seen.angle or 0.0) + wrong)
        (thing,) = locate([turned], calibration, stating(20.0)).objects
        assert math.dist(thing.center, (-60.0, 30.0)) < 0.01


def test_what_is_no_known_shape_is_placed_at_half_height() -> None:
    calibration = cell(0.1)
    seen = placed(Shape.RECTANGLE, 30.0, 40.0, 20.0, 1.0, 20.0, calibration)
    other = detection(Shape.OTHER, seen.outline_px, seen.angle)
    (thing,) = locate([other], calibration, stating(20.0)).objects
    assert math.dist(thing.center, (40.0, 20.0)) < 1.0
    assert thing.sigma >= 0.05 * 20.0
    assert abs(angle_difference(thing.yaw or 0.0, 1.0, math.pi)) < 0.15


@pytest.mark.safety("SR-34")
def test_what_cannot_be_located_is_named() -> None:
    calibration = cell()
    seen = placed(Shape.SQUARE, 40.0, 0.0, 0.0, 0.0, 20.0, calibration)
    cut = detection(Shape.SQUARE, seen.outline_px, 0.0, frozenset({"cut_by_border"}))
    few = detection(Shape.SQUARE, seen.outline_px[::20], 0.0)
    found = locate([cut, seen, few], calibration, stating(20.0))
    assert [thing.detection for thing in found.objects] == [seen]
    reasons = [reason for _, reason in found.refused]
    assert "border" in reasons[0]
    assert "outline points" in reasons[1]


@pytest.mark.parametrize("shape", SHAPES)
def test_footprints_are_counter_clockwise_about_their_centroid(shape: Shape) -> None:
    units = unit_footprint(shape)
    dimensions = (40.0, 30.0)[: units.shape[2]]
    polygon_ = footprint(shape, (5.0, -7.0), 0.3, dimensions)
    x, y = polygon_[:, 0], polygon_[:, 1]
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    assert cross.sum() > 0
    centroid = [((c + np.roll(c, -1)) * cross).sum() / (3 * cross.sum()) for c in (x, y)]
    assert np.allclose(centroid, [5.0, -7.0])


@pytest.mark.parametrize("shape", SHAPES)
def test_derivatives_of_the_silhouette_agree_with_differences(shape: Shape) -> None:
    calibration = cell(0.2, 1.0)
    seen = placed(shape, 40.0, 80.0, -50.0, 0.5, 20.0, calibration)
    sides = (40.0, 28.0) if shape is Shape.RECTANGLE else (27.0,)
    start = Start(seen.outline_px, shape, (79.0, -50.5, 0.52), sides, 19.0)
    model = silhouettes([start], calibration.camera, calibration.T_table_camera)
    at = np.array([[*start.place, *(*sides, 1.0)[:2], 19.0]])
    _, slopes = model.corners(at)
    for index in range(at.shape[1]):
        if shape is Shape.CIRCLE and index == 2:
            assert not slopes[..., index].any()  # a circle has no yaw
            continue
        step = np.zeros(at.shape)
        step[0, index] = 1e-4
        difference = (model.corners(at + step)[0] - model.corners(at - step)[0]) / 2e-4
        # Central differences of a smooth function in double precision.
        assert np.allclose(difference, slopes[..., index].transpose(0, 2, 1), atol=1e-5)


def test_parts_located_together_lie_where_each_lies_alone() -> None:
    """One batch holds outlines of different lengths and shapes of different numbers of corners."""
    calibration = cell(0.2, 1.0)
    places = [(-120.0, -60.0), (-60.0, 40.0), (0.0, -50.0), (60.0, 60.0), (120.0, -20.0)]
    seen = [
        placed(shape, 24.0 + 4.0 * k, *places[k], 0.3 * k, 12.0 + 3.0 * k, calibration)
        for k, shape in enumerate(SHAPES)
    ]
    stated = {id(item): 12.0 + 3.0 * k for k, item in enumerate(seen)}
    together = locate(seen, calibration, lambda item: stated[id(item)]).objects
    assert [thing.detection for thing in together] == seen
    for thing in together:
        (alone,) = locate([thing.detection], calibration, lambda item: stated[id(item)]).objects
        # The same arithmetic in another order: rounding only.
        assert math.dist(thing.center, alone.center) < 1e-6
        assert thing.size == pytest.approx(alone.size, abs=1e-6)

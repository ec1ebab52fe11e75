"""Parts and the hand that scatters them."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.domain import Shape
from sim_backends.cell_spec import HEIGHTS
from sim_backends.imperfections import draw
from sim_backends.parts import SHAPES, WorkArea, area, gap, outline, placed, scatter, size


@pytest.mark.parametrize("shape", SHAPES)
def test_size_is_the_minimum_area_rectangle(shape: Shape) -> None:
    _, sides, _ = cv2.minAreaRect(outline(shape, 40.0).astype(np.float32))
    # A circle is a polygon of 72 sides and equal area: its corners stand out 0.03 mm.
    assert sorted(size(shape, 40.0)) == pytest.approx(sorted(sides), abs=0.06)


@pytest.mark.parametrize("shape", SHAPES)
def test_outlines_turn_counter_clockwise_about_their_centroid(shape: Shape) -> None:
    ring = outline(shape, 40.0)
    x, y = ring.T
    cross = x * np.roll(y, -1) - y * np.roll(x, -1)
    assert cross.min() > 0.0
    assert ((ring + np.roll(ring, -1, axis=0)) * cross[:, None]).sum(axis=0) == pytest.approx([0.0, 0.0], abs=1e-6)


def test_a_round_outline_has_the_area_of_its_circle() -> None:
    assert area(outline(Shape.CIRCLE, 40.0)) == pytest.approx(math.pi * 400.0)


@settings(deadline=None)  # a busy machine is no defect of the geometry
@given(
    st.sampled_from(SHAPES), st.sampled_from(SHAPES), st.floats(-60, 60), st.floats(-60, 60), st.floats(-3.2, 3.2)
)
def test_gap_is_the_distance_of_the_outlines(a: Shape, b: Shape, x: float, y: float, yaw: float) -> None:
    first, second = outline(a, 40.0), placed(outline(b, 30.0), x, y, yaw)
    found = gap(first, second)
    contour = first.astype(np.float32).reshape(-1, 1, 2)
    share = np.arange(200)[:, None, None] / 200.0
    rim = (second * (1.0 - share) + np.roll(second, -1, axis=0) * share).reshape(-1, 2)
    nearest = -max(cv2.pointPolygonTest(contour, tuple(map(float, p)), True) for p in rim)
    if found > 0.0:
        # The rim is sampled every 0.3 mm at most.
        assert found == pytest.approx(nearest, abs=0.1)
    else:
        inner = second.astype(np.float32).reshape(-1, 1, 2)
        inside = max(cv2.pointPolygonTest(inner, tuple(map(float, p)), True) for p in first)
        assert max(-nearest, inside) > -0.3 or cv2.intersectConvexConvex(contour, inner)[0] > 0.0


@pytest.mark.parametrize("seed", range(12))
def test_scattered_parts_keep_their_distance_within_the_work_area(seed: int) -> None:
    parts = scatter(8, seed, draw("static", seed), HEIGHTS, (36.0, 43.0, 50.0), WorkArea())
    rings = [placed(p.outline, p.x, p.y, p.yaw) for p in parts]
    for i, ring in enumerate(rings):
        assert all(gap(ring, other) >= 10.0 for other in rings[:i])
    for p in parts:
        assert 150.0 <= math.hypot(p.x, p.y) <= 260.0
        assert abs(math.degrees(math.atan2(p.y, p.x))) <= 50.0
    assert {p.shape for p in parts} == set(SHAPES)


@pytest.mark.parametrize("count", [14, 20])
def test_a_crowd_fits_without_overlap(count: int) -> None:
    parts = scatter(count, 4, draw("dynamic", 4), HEIGHTS, (36.0, 43.0, 50.0), WorkArea())
    rings = [placed(p.outline, p.x, p.y, p.yaw) for p in parts]
    assert all(gap(a, b) > 0.0 for i, a in enumerate(rings) for b in rings[:i])


def test_the_same_seed_scatters_the_same_parts() -> None:
    def table(seed: int) -> object:
        return scatter(8, seed, draw("static", seed), HEIGHTS, (36.0, 43.0, 50.0), WorkArea())

    assert table(3) == table(3)
    assert table(3) != table(4)

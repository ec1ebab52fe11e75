from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.domain import Shape
from controller.errors import NoClearGrasp
from controller.geometry import angle_difference
from controller.motion import grasps, holds
from tests.unit.motion.scene import PARTS, RX150, at, bins, jaw_sweeps, part, polygon_gap, scatter

NOTHING = np.empty((0, 2))
JAW = RX150.gripper.jaw_size[1]


@pytest.mark.parametrize("shape", [Shape.SQUARE, Shape.HEXAGON, Shape.RECTANGLE])
@pytest.mark.parametrize("yaw_deg", [0.0, 17.0, 63.0, 149.0])
def test_parallel_flats_come_first_and_the_width_is_theirs(shape: Shape, yaw_deg: float) -> None:
    thing = part(shape, 36.0, (0.0, 0.0), math.radians(yaw_deg))
    best = grasps.choose(thing, holds.sides(thing), RX150.gripper, NOTHING)[0].grasp
    assert best.width == pytest.approx(36.0, abs=1e-4)
    assert best.center == pytest.approx((0.0, 0.0), abs=1e-4)
    # 5 mm a side and the localisation's sigma twice.
    assert best.opening == pytest.approx(36.0 + 2 * 5.0 + 2 * 0.3, abs=1e-4)


def test_a_triangle_is_held_by_a_side_and_its_corner_touching_together() -> None:
    thing = part(Shape.TRIANGLE, 40.0, (10.0, 20.0), 0.3)
    for choice in grasps.choose(thing, holds.sides(thing), RX150.gripper, NOTHING):
        grasp = choice.grasp
        axis = np.array([math.cos(grasp.direction), math.sin(grasp.direction)])
        along = (thing.footprint - np.array(grasp.center)) @ axis
        assert along.max() == pytest.approx(-along.min(), abs=1e-3)
        flat = np.isclose(np.abs(along), along.max(), atol=1e-3)
        assert flat.sum() == 3  # two corners of the side, one opposite


def test_what_does_not_fit_the_jaws_is_refused() -> None:
    wide, narrow = part(Shape.CIRCLE, 72.0, (0.0, 0.0)), part(Shape.CIRCLE, 24.0, (0.0, 0.0))
    for thing in (wide, narrow):
        with pytest.raises(NoClearGrasp, match="does not suit jaws"):
            grasps.choose(thing, holds.sides(thing), RX150.gripper, NOTHING)


def test_a_long_rectangle_is_taken_across() -> None:
    thing = part(Shape.RECTANGLE, 40.0, (0.0, 0.0), 0.5)
    choices = grasps.choose(thing, holds.sides(thing), RX150.gripper, NOTHING)
    assert choices[0].grasp.direction == pytest.approx(0.5 + math.pi / 2)


def test_a_neighbour_turns_the_grasp() -> None:
    thing = part(Shape.SQUARE, 36.0, (0.0, 0.0))
    beside = part(Shape.SQUARE, 36.0, (42.0, 0.0))
    blocked = grasps.obstacles([beside], (), thing.center, 100.0)
    best = grasps.choose(thing, holds.sides(thing), RX150.gripper, blocked)[0].grasp
    assert best.direction == pytest.approx(math.pi / 2)


def test_a_part_boxed_in_has_no_grasp() -> None:
    thing = part(Shape.SQUARE, 36.0, (0.0, 0.0))
    around = [part(Shape.SQUARE, 36.0, place) for place in ((42.0, 0.0), (-42.0, 0.0), (0.0, 42.0), (0.0, -42.0))]
    blocked = grasps.obstacles(around, (), thing.center, 100.0)
    with pytest.raises(NoClearGrasp, match="no room"):
        grasps.choose(thing, holds.sides(thing), RX150.gripper, blocked)


def test_a_tight_place_is_entered_less_wide_open() -> None:
    thing = part(Shape.SQUARE, 36.0, (0.0, 0.0))
    # 14 mm from the part's sides: 8 mm of jaw and 2.5 mm of margin fit, 5 mm do not.
    walls = [part(Shape.SQUARE, 30.0, place) for place in ((46.5, 0.0), (-46.5, 0.0), (0.0, 46.5), (0.0, -46.5))]
    blocked = grasps.obstacles(walls, (), thing.center, 100.0)
    best = grasps.choose(thing, holds.sides(thing), RX150.gripper, blocked)[0].grasp
    assert best.opening == pytest.approx(36.0 + 2 * 2.5 + 2 * 0.3, abs=1e-4)


@given(seed=st.integers(0, 10_000), count=st.integers(2, 8))
@settings(max_examples=60, deadline=None)
def test_the_swept_jaws_touch_nothing(seed: int, count: int) -> None:
    """Checked with exact polygons, not with the points the planner uses."""
    things = scatter(np.random.default_rng(seed), count)
    target, others = things[0], things[1:]
    blocked = grasps.obstacles(others, bins(), target.center, 200.0)
    try:
        choices = grasps.choose(target, holds.sides(target), RX150.gripper, blocked)
    except NoClearGrasp:
        return
    for choice in choices:
        grasp = choice.grasp
        for sweep in jaw_sweeps(grasp.center, grasp.direction, grasp.width, grasp.opening):
            for other in others:
                gap = polygon_gap(sweep, other.footprint)
                # Outlines are points every 2 mm: a corner between two of them may be nearer by 1 mm at most.
                assert gap > grasps.MIN_CLEARANCE - 1.0
                # Without a point within 200 mm it is infinite: the jaws reach 100 mm from there, at most.
                assert gap > min(grasp.clearance, 100.0) - 1.0


def test_no_jaw_comes_down_within_the_outline_of_a_large_neighbour() -> None:
    # Taken askew, a jaw would stand 3 mm within the neighbour's outline, on top of it.
    thing = part(Shape.RECTANGLE, 50.0, (-76.9, -13.4), math.radians(6.1))
    neighbour = part(Shape.RECTANGLE, 42.1, (-52.1, -58.4), math.radians(7.4))
    blocked = grasps.obstacles([neighbour], (), thing.center, 200.0)
    with pytest.raises(NoClearGrasp, match="no room"):
        grasps.ways_to_take(thing, RX150.gripper, blocked, None)


def test_where_the_jaws_came_down_on_something_they_do_so_once() -> None:
    """What is not seen whole reaches further than it looks; once nothing lies near, the best grasp is it again."""
    thing = part(Shape.SQUARE, 36.0, (0.0, 0.0))
    beside = [part(Shape.SQUARE, 36.0, place) for place in ((54.0, 0.0), (0.0, 54.0))]
    near = grasps.obstacles(beside, (), thing.center, 100.0)
    met = [choice.grasp for choice in grasps.ways_to_take(thing, RX150.gripper, near, None)]
    assert all(grasp.clearance < grasps.ENOUGH_CLEARANCE for grasp in met)
    for choice in grasps.ways_to_take(thing, RX150.gripper, near, None, avoid=met):
        turns = [abs(angle_difference(choice.grasp.direction, grasp.direction, math.pi)) for grasp in met]
        apart = [math.dist(choice.grasp.center, grasp.center) for grasp in met]
        assert all(turn > 0.1 or gap > 3.0 for turn, gap in zip(turns, apart, strict=True))
    free = grasps.ways_to_take(thing, RX150.gripper, NOTHING, None, avoid=met)
    assert free[0].grasp.direction == pytest.approx(met[0].direction)


def test_the_jaws_stay_over_the_table_and_around_the_part() -> None:
    for height in (3.0, 10.0, 25.0):
        thing = part(Shape.SQUARE, 40.0, (0.0, 0.0), height=height)
        grasp = grasps.choose(thing, holds.sides(thing), RX150.gripper, NOTHING)[0].grasp
        tips = grasp.height - RX150.gripper.jaw_depth
        assert 0.0 < tips <= min(4.0, height / 2)


def test_four_joints_take_what_lies_favourably() -> None:
    tangential = math.pi / 2
    for shape in PARTS:
        assert holds.fixed_side(part(shape, 40.0, at(200.0, 0.0), 0.0), tangential, JAW) is not None
    straight = holds.fixed_side(part(Shape.SQUARE, 40.0, at(200.0, 0.0), 0.0), tangential, JAW)
    oblique = holds.fixed_side(part(Shape.SQUARE, 40.0, at(200.0, 0.0), 0.4), tangential, JAW)
    assert straight is not None
    assert oblique is not None
    assert oblique.quality < straight.quality
    cornered = part(Shape.SQUARE, 40.0, at(200.0, 0.0), 0.7)
    assert holds.fixed_side(cornered, tangential, JAW) is None
    assert holds.fixed_side(cornered, tangential, JAW, corners=True) is not None


@given(
    st.sampled_from([Shape.TRIANGLE, Shape.HEXAGON]),
    st.floats(-math.pi, math.pi),
    st.floats(math.radians(6.0), math.radians(54.0)),
    st.sampled_from([34.0, 43.0, 50.0]),
)
def test_no_corner_of_what_lies_askew_comes_near_the_edge_of_a_jaw(
    shape: Shape, yaw: float, turn: float, across: float
) -> None:
    thing = part(shape, across, (10.0, 20.0), yaw)
    straight = holds.fixed_side(thing, yaw + math.pi / 2 + turn, JAW)
    assert straight is not None
    for side in (straight, *holds.shifted_sides([straight], thing, JAW)):
        axis = np.array([math.cos(side.direction), math.sin(side.direction)])
        away = thing.footprint - np.array(thing.center) - side.shift * np.array([-axis[1], axis[0]])
        along, beside = away @ axis, np.abs(away @ np.array([-axis[1], axis[0]]))
        foremost = beside[[along.argmin(), along.argmax()]]
        # In physics corners within 2.5 mm of the edge slip off it, and those outside it within 1 mm.
        assert not ((foremost > JAW / 2 - 2.5) & (foremost < JAW / 2 + 1.0)).any()
        if shape is Shape.TRIANGLE:
            assert foremost.min() < JAW / 2

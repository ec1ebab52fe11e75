from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.config.arm import load_arm
from controller.domain import Array, LocatedObject, NudgePlan, Point, Shape
from controller.errors import NoClearGrasp, PlanError
from controller.geometry import invert, transform
from controller.motion import grasps, kinematics, nudges, pushing
from controller.motion.planner import Planner
from controller.motion.shoves import PUSH_SPEED
from tests.unit.motion.scene import PARTS, RX150, at, bins, calibration, part, polygon_gap

OMX = load_arm("open_manipulator_x")
T_TABLE_BASE = invert(calibration().T_base_table)
PLANNERS = {arm.name: Planner(arm, calibration(), bins(200.0)[::3]) for arm in (RX150, OMX)}


def sector(inner: float, outer: float) -> Array:
    a = np.radians(np.arange(-50.0, 50.1, 2.5))
    ring = np.column_stack([np.cos(a), np.sin(a)])
    return np.vstack([outer * ring, inner * ring[::-1]]) - [230.0, 0.0]


AREA = sector(125.0, 285.0)


def stuck_pair(gap: float = 4.0) -> tuple[LocatedObject, LocatedObject]:
    """Two squares side by side about the waist: an arm without wrist roll has no room between them."""
    first = part(Shape.SQUARE, 38.0, at(200.0, 0.0))
    x, y = first.center
    return first, part(Shape.SQUARE, 38.0, (x, y + 38.0 + gap))


def boxes(plan: NudgePlan, planner: Planner) -> Array:
    """Corners (N, 4, 2) of the closed gripper along the push, in `table`, mm."""
    gripper = planner.arm.gripper
    along, across = plan.opening / 2.0 + gripper.jaw_size[0], gripper.jaw_size[1] / 2.0
    corners = np.array([[gripper.jaw_depth, a, b] for a, b in ((-along, -across), (along, -across), (along, across))])
    corners = np.vstack([corners, [[gripper.jaw_depth, -along, across]]])
    poses = kinematics.forward(planner.arm, plan.push.positions)
    return np.array([transform(T_TABLE_BASE @ pose, corners)[:, :2] for pose in poses])


def _gap(first: LocatedObject, second: LocatedObject) -> float:
    return polygon_gap(first.footprint, second.footprint)


def counter_clockwise(corners: Array) -> Array:
    x, y = corners.T
    return corners if float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) > 0.0 else corners[::-1]


def test_a_part_beside_another_is_freed_by_a_push() -> None:
    planner = PLANNERS[OMX.name]
    ready = np.array(OMX.ready)
    target, other = stuck_pair()
    with pytest.raises(NoClearGrasp):
        planner.plan_pick(target, [other], planner.bins[0], planner.bins[0].center, ready)
    plan = planner.plan_nudge(target, [other], AREA, ready)
    assert plan.moved in (target, other)
    for end in plan.ends:
        first, rest = (end, [other]) if plan.moved is target else (target, [end])
        planner.plan_pick(first, rest, planner.bins[0], planner.bins[0].center, ready)


@given(seed=st.integers(0, 100_000), arm=st.sampled_from([RX150.name, OMX.name]), unsure=st.booleans())
@settings(max_examples=10, deadline=None)
def test_a_push_is_straight_low_slow_and_touches_only_what_it_moves(seed: int, arm: str, unsure: bool) -> None:
    rng = np.random.default_rng(seed)
    planner = PLANNERS[arm]
    things: list[LocatedObject] = []
    for _ in range(60):
        place = at(rng.uniform(160.0, 230.0), rng.uniform(-25.0, 25.0))
        thing = part((Shape.SQUARE, Shape.HEXAGON)[seed % 2], rng.uniform(34.0, 44.0), place, rng.uniform(0.0, 6.3))
        clear = (math.dist(place, other.center) > 65.0 or _gap(thing, other) > 1.0 for other in things)
        if all(clear):
            things.append(thing)
    target, others = things[0], things[1:]
    start = np.array(planner.arm.ready)
    try:
        plan = planner.plan_nudge(target, others, AREA, start, unsure=unsure)
    except PlanError:
        return
    where = start
    for trajectory in plan.trajectories:
        assert np.abs(trajectory.positions[0] - where).max() < 1e-6
        where = trajectory.positions[-1]
    assert where == pytest.approx(planner.arm.ready)
    way = transform(T_TABLE_BASE, kinematics.points(planner.arm, plan.push.positions)[:, 3])
    assert np.ptp(way[:, 2]) < 0.05
    ahead = np.array(plan.by) / math.hypot(*plan.by)
    assert np.abs((way[:, :2] - way[0, :2]) @ np.array([-ahead[1], ahead[0]])).max() < 0.05
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() / plan.push.period < 1.001 * PUSH_SPEED
    # What loosens a heap may push others along; it comes down free like any other.
    loosens = math.hypot(*plan.by) == pytest.approx(nudges.SHOVE)
    for corners in boxes(plan, planner)[: 1 if loosens else None : 8]:
        for other in things:
            if other is not plan.moved:
                # Outlines are points every 2 mm, so 1 mm may be missed.
                assert polygon_gap(counter_clockwise(corners), other.footprint) > grasps.MIN_CLEARANCE - 1.0
    assert polygon_gap(counter_clockwise(boxes(plan, planner)[0]), plan.moved.footprint) > 1.0


def test_a_square_that_would_be_held_by_two_corners_is_turned() -> None:
    planner = PLANNERS[OMX.name]
    target = part(Shape.SQUARE, 40.0, at(200.0, 0.0), math.radians(45.0))
    with pytest.raises(NoClearGrasp, match="not hold"):
        planner.plan_pick(target, (), planner.bins[0], planner.bins[0].center, np.array(OMX.ready))
    plan = planner.plan_nudge(target, (), AREA, np.array(OMX.ready))
    assert plan.moved is target


def test_a_push_that_did_not_help_is_neither_repeated_nor_undone() -> None:
    planner = PLANNERS[OMX.name]
    target = part(Shape.RECTANGLE, 50.0, at(200.0, 0.0), math.radians(40.0))
    start = np.array(OMX.ready)
    first = planner.plan_nudge(target, (), AREA, start)
    tried = [(target.center, first.by)]
    again = planner.plan_nudge(target, (), AREA, start, tried=tried)
    assert np.dot(again.by, first.by) < 0.9 * math.hypot(*again.by) * math.hypot(*first.by)
    there = pushing.shifted(target, (*first.by, 0.0))
    back = planner.plan_nudge(there, (), AREA, start, tried=tried)
    assert math.dist(np.add(there.center, back.by), target.center) > 10.0


def test_a_rectangle_too_wide_as_it_lies_is_turned() -> None:
    """70 x 50 mm, its diagonal between the jaws: it fits them along either side only."""
    planner = PLANNERS[OMX.name]
    target = part(Shape.RECTANGLE, 50.0, at(200.0, 0.0), math.radians(40.0))
    with pytest.raises(NoClearGrasp, match="not hold"):
        planner.plan_pick(target, (), planner.bins[0], planner.bins[0].center, np.array(OMX.ready))
    plan = planner.plan_nudge(target, (), AREA, np.array(OMX.ready))
    for end in plan.ends:
        planner.plan_pick(end, (), planner.bins[0], planner.bins[0].center, np.array(OMX.ready))


@pytest.mark.parametrize("friction", [0, 1], ids=["least", "most"])
def test_a_rectangle_as_long_as_the_jaws_open_is_turned_to_its_short_side(friction: int) -> None:
    """70 mm between jaws of 75 is only free when nothing is out by a degree: no push is foreseen so well."""
    planner = PLANNERS[OMX.name]
    start, bin_ = np.array(OMX.ready), planner.bins[0]
    lying = part(Shape.RECTANGLE, 50.0, at(200.0, 0.0), math.radians(86.0))
    tried: list[tuple[Point, Point]] = []
    for _ in range(4):
        with pytest.raises(NoClearGrasp):
            planner.plan_pick(lying, (), bin_, bin_.center, start)
        plan = planner.plan_nudge(lying, (), AREA, start, tried=tried)
        tried.append((lying.center, plan.by))
        lying = plan.ends[friction]
        with suppress(NoClearGrasp):
            assert planner.plan_pick(lying, (), bin_, bin_.center, start).grasp.width < 66.0
            return
    pytest.fail("four pushes do not turn it")


@given(seed=st.integers(0, 100_000), arm=st.sampled_from([RX150.name, OMX.name]))
@settings(max_examples=8, deadline=None)
def test_fingers_go_as_far_into_a_part_as_it_is_pushed(seed: int, arm: str) -> None:
    """Between closed fingers a corner or a round side goes in before anything is pushed."""
    rng = np.random.default_rng(seed)
    planner = PLANNERS[arm]
    x, y = place = at(200.0, rng.uniform(-20.0, 20.0))
    target = part(PARTS[seed % 5], rng.uniform(34.0, 44.0), place, rng.uniform(0.0, 6.3))
    other = part(Shape.SQUARE, 38.0, (x + rng.uniform(-10, 10), y + 48.0))
    try:
        plan = planner.plan_nudge(target, [other], AREA, np.array(planner.arm.ready))
    except PlanError:
        return
    gripper = planner.arm.gripper
    half, across = plan.opening / 2.0, gripper.jaw_size[1] / 2.0
    end = kinematics.forward(planner.arm, plan.push.positions[-1:])[0]
    ahead = np.array(plan.by) / math.hypot(*plan.by)
    outline = counter_clockwise(plan.moved.footprint)
    deepest = 0.0
    for side in (1.0, -1.0):
        ends = (side * half, side * (half + gripper.jaw_size[0]))
        corners = [[gripper.jaw_depth, a, b] for a, b in zip(ends * 2, (-across, -across, across, across), strict=True)]
        finger = counter_clockwise(transform(T_TABLE_BASE @ end, np.array(corners)[[0, 1, 3, 2]])[:, :2])
        for back in np.arange(0.0, math.hypot(*plan.by) + 6.0, 1.0):
            if polygon_gap(finger - back * ahead, outline) > 0.0:
                break
            deepest = max(deepest, back)
    # Steps of 1 mm, 2 between the points of a side; without a wrist roll the fingers turn with the waist on the way.
    turned = (half + gripper.jaw_size[0]) * math.hypot(*plan.by) / 180.0 if arm == OMX.name else 0.0
    assert deepest == pytest.approx(math.hypot(*plan.by), abs=3.0 + turned)


def test_nothing_is_pushed_out_of_the_area() -> None:
    planner = PLANNERS[OMX.name]
    target, other = stuck_pair()
    tight = np.array([[-60.0, -25.0], [0.0, -25.0], [0.0, 68.0], [-60.0, 68.0]])
    plan = planner.plan_nudge(target, [other], tight, np.array(OMX.ready))
    x, y = np.array(plan.moved.center) + plan.by
    assert -60.0 < x < 0.0
    assert -25.0 < y < 68.0


def test_a_part_walled_in_has_no_push() -> None:
    planner = PLANNERS[RX150.name]
    target = part(Shape.SQUARE, 36.0, at(200.0, 0.0))
    x, y = target.center
    ring = [(x + 41.0 * i, y + 41.0 * j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) != (0, 0)]
    around = [part(Shape.SQUARE, 36.0, place) for place in ring]
    for unsure in (False, True):
        with pytest.raises(NoClearGrasp, match="no push"):
            planner.plan_nudge(target, around, AREA, np.array(RX150.ready), unsure=unsure)


def test_a_heap_is_not_loosened_towards_the_rim_of_the_reach() -> None:
    """Nothing pushes back what lies at the rim."""
    lying = [
        (Shape.HEXAGON, 43.0, 36.0, 49.0, 6.0), (Shape.RECTANGLE, 43.0, 35.0, -4.0, 177.0),
        (Shape.CIRCLE, 36.0, 26.0, -54.0, 0.0), (Shape.SQUARE, 36.0, 24.0, -94.0, 87.0),
        (Shape.TRIANGLE, 43.0, -14.0, 38.0, 87.0), (Shape.HEXAGON, 50.0, -24.0, -56.0, 25.0),
        (Shape.TRIANGLE, 36.0, -31.0, -5.0, 67.0),
    ]  # fmt: skip
    heap = [part(shape, width, (x, y), math.radians(turned)) for shape, width, x, y, turned in lying]
    base = T_TABLE_BASE[:2, 3]
    tangent = PLANNERS[OMX.name]._postures.tangent
    for target in heap:
        others = [other for other in heap if other is not target]
        best = nudges.pushes(target, others, (), AREA, OMX.gripper, tangent, unsure=True)[0]
        assert math.dist(best.ends[0].center, base) < math.dist(best.moved.center, base)

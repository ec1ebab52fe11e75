from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.config.arm import load_arm
from controller.domain import Array, Bin, LocatedObject, PickPlan, Shape
from controller.errors import LimitViolation, NoClearGrasp, PlanError, Unreachable
from controller.geometry import invert, transform
from controller.motion import kinematics
from controller.motion.gate import WALL_MARGIN
from controller.motion.planner import Planner
from controller.motion.view import hides
from tests.unit.motion.scene import ARMS, RX150, at, bins, calibration, part, polygon_gap, scatter

BINS = bins()
NEAR_BINS = bins(190.0)
OMX = load_arm("open_manipulator_x")
PLANNER = Planner(RX150, calibration(), BINS)
READY = np.array(RX150.ready)
T_TABLE_BASE = invert(calibration().T_base_table)


def tool_way(plan: PickPlan, which: int) -> Array:
    """The grasp point along one of the moves, in `table`, mm."""
    way = kinematics.points(RX150, plan.trajectories[which].positions)[:, 3]
    return transform(T_TABLE_BASE, way)


def let_go(planner: Planner, plan: PickPlan) -> tuple[Array, Array]:
    """Centre (2,) and outline (N, 2) of the part as the tool, which carries it rigidly, lets it go; `table`, mm."""
    before, after = (kinematics.forward(planner.arm, plan.carry.positions[k]) for k in (0, -1))
    flat = np.vstack([plan.target.center, plan.target.footprint])
    lying = np.column_stack([flat, np.full(len(flat), plan.grasp.height)])
    landed = transform(T_TABLE_BASE @ after @ invert(before) @ calibration().T_base_table, lying)[:, :2]
    return landed[0], landed[1:]


@given(seed=st.integers(0, 10_000), count=st.integers(1, 6), where=st.integers(0, 5))
@settings(max_examples=40, deadline=None)
def test_a_plan_takes_the_part_and_brings_it_to_its_bin(seed: int, count: int, where: int) -> None:
    rng = np.random.default_rng(seed)
    things = scatter(rng, count)
    box = BINS[where]
    drop = (box.center[0] + float(rng.uniform(-20, 20)), box.center[1] + float(rng.uniform(-20, 20)))
    try:
        plan = PLANNER.plan_pick(things[0], things[1:], box, drop, READY)
    except NoClearGrasp:
        return
    grasp, q = plan.grasp, plan.approach.positions
    # one move ends where the next begins
    assert np.abs(q[0] - READY).max() < 1e-9
    assert np.abs(q[-1] - plan.carry.positions[0]).max() < 1e-6
    assert np.abs(plan.carry.positions[-1] - plan.retreat.positions[0]).max() < 1e-6
    assert np.abs(plan.retreat.positions[-1] - READY).max() < 1e-9
    # at the part
    foot = tool_way(plan, 0)[-1]
    assert foot == pytest.approx([*grasp.center, grasp.height], abs=1e-3)
    turn = (kinematics.closing_direction(q[-1]) - grasp.direction) % math.pi
    assert min(turn, math.pi - turn) < 1e-6
    # between the parts the tool moves exactly vertically: 5 mm over the tallest one's height
    tall = max(thing.height for thing in things)
    for way, end in ((tool_way(plan, 0), -1), (tool_way(plan, 1), 0)):
        low = way[:, 2] - RX150.gripper.jaw_depth < tall + 4.0
        inside = np.hypot(*(way[:, :2] - grasp.center).T) < 150.0
        assert np.abs(way[low & inside][:, :2] - way[end, :2]).max() < 0.05
    # the part comes down over the drop, or as near to it as it falls on no wall
    landed, outline = let_go(PLANNER, plan)
    beyond = np.abs(outline - landed + drop - box.center).max(axis=0) - np.array(box.size) / 2.0 + WALL_MARGIN
    assert np.abs(landed - drop) == pytest.approx(np.maximum(beyond, 0.0), abs=0.05)


@pytest.mark.parametrize("corner", [(-20.0, -20.0), (20.0, 20.0), (20.0, -20.0), (-20.0, 20.0)])
@pytest.mark.parametrize("box", NEAR_BINS, ids=lambda box: box.name)
def test_an_arm_that_cannot_turn_a_part_lets_none_fall_on_a_wall(box: Bin, corner: tuple[float, float]) -> None:
    planner = Planner(OMX, calibration(), NEAR_BINS)
    thing = part(Shape.RECTANGLE, 43.0, at(200.0, 10.0), math.radians(10.0))
    drop = (box.center[0] + corner[0], box.center[1] + corner[1])
    _, outline = let_go(planner, planner.plan_pick(thing, (), box, drop, np.array(OMX.ready)))
    # the part turns with the waist while its place is sought: to half a millimetre
    assert np.abs(outline - box.center).max() < box.size[0] / 2.0 - WALL_MARGIN + 0.5


def test_joint_offsets_are_taken_out_of_the_start_and_put_into_the_goals() -> None:
    offsets = {"shoulder": 0.03, "elbow": -0.02}
    planner = Planner(RX150, calibration(offsets), BINS)
    shift = np.array([0.0, 0.03, -0.02, 0.0, 0.0])
    thing = part(Shape.SQUARE, 36.0, at(200.0, 10.0))
    plain = PLANNER.plan_pick(thing, (), BINS[0], BINS[0].center, READY)
    moved = planner.plan_pick(thing, (), BINS[0], BINS[0].center, READY + shift)
    assert moved.approach.positions == pytest.approx(plain.approach.positions)
    for difference in moved.approach.goals - plain.approach.goals:
        assert difference == pytest.approx(shift)


def test_a_turned_table_is_followed() -> None:
    turned = calibration(yaw=0.2)
    planner = Planner(RX150, turned, BINS)
    thing = part(Shape.RECTANGLE, 36.0, (-30.0, 20.0), 0.7)
    plan = planner.plan_pick(thing, (), BINS[3], BINS[3].center, READY)
    q = plan.approach.positions[-1]
    place = transform(turned.T_base_table, [-30.0, 20.0, 19.0])
    assert kinematics.points(RX150, q)[3] == pytest.approx(place, abs=1e-3)
    turn = (kinematics.closing_direction(q) - (plan.grasp.direction + 0.2)) % math.pi
    assert min(turn, math.pi - turn) < 1e-6


def test_the_known_pile_decides_how_deep_a_part_is_let_go() -> None:
    thing = part(Shape.SQUARE, 36.0, at(200.0, 10.0))
    box = BINS[1]
    piles: tuple[dict[str, float], ...] = ({box.name: 0.0}, {box.name: 30.0}, {})
    plans = [PLANNER.filled(known).plan_pick(thing, (), box, box.center, READY) for known in piles]
    heights = [tool_way(plan, 1)[-1, 2] for plan in plans]
    assert heights[0] < heights[1] <= heights[2]
    # empty bin: the part, 4 mm below the tips, falls 8 mm
    assert heights[0] == pytest.approx(15.0 + 4.0 + 8.0, abs=1e-3)
    # unknown: the jaws stay over the walls
    assert heights[2] - RX150.gripper.jaw_depth > box.height
    # beside a wall the opened jaws would not fit: over the walls, though the bin is empty
    edge = (box.center[0] + 30.0, box.center[1] + 30.0)
    plan = PLANNER.filled({box.name: 0.0}).plan_pick(thing, (), box, edge, READY)
    assert tool_way(plan, 1)[-1, 2] - 15.0 > box.height


def test_a_part_is_let_go_anywhere_in_a_bin_as_deep_as_the_open_jaws_fit() -> None:
    box, planner = BINS[1], PLANNER.filled({BINS[1].name: 0.0})
    thing = part(Shape.TRIANGLE, 36.0, at(200.0, 10.0))
    heights = []
    # In steps of half of what the jaws open less over a bin than they may: from places where they fit to where not.
    for beside in range(6, 22):
        plan = planner.plan_pick(thing, (), box, (box.center[0] + beside, box.center[1] + beside), READY)
        heights.append(tool_way(plan, 1)[-1, 2])
    assert heights[0] == pytest.approx(15.0 + 4.0 + 8.0, abs=1e-3)
    assert heights[-1] - 15.0 > box.height


@pytest.mark.parametrize("radius", [160.0, 200.0, 250.0])
def test_jaws_and_what_they_hold_pass_over_what_stands_out_of_a_bin_on_the_way(radius: float) -> None:
    thing = part(Shape.SQUARE, 36.0, at(radius, 10.0))
    near, far = BINS[0], BINS[2]
    reach = max(near.size) / 2.0 + RX150.gripper.opening[1] / 2.0 + RX150.gripper.jaw_size[0]
    low = {}
    for pile in (near.height, 80.0):
        planner = PLANNER.filled({near.name: pile, far.name: 0.0})
        plan = planner.plan_pick(thing, (), far, far.center, READY)
        back = planner.plan_pick(thing, (), far, far.center, plan.carry.positions[-1], climb=36.0)
        for name, way in (("carry", tool_way(plan, 1)), ("approach", tool_way(back, 0))):
            over = (np.abs(way[:, :2] - near.center) < reach).all(axis=1)
            low[name] = float(way[over, 2].min()) - RX150.gripper.jaw_depth
            # the part hangs 4 mm below the tips
            assert low[name] - 4.0 > pile
    assert low["carry"] < 80.0 + 30.0  # and no higher than need be


def test_a_part_beyond_the_top_down_reach_is_taken_leaning_out() -> None:
    plan = PLANNER.plan_pick(part(Shape.SQUARE, 36.0, at(285.0, 0.0)), (), BINS[0], BINS[0].center, READY)
    pitch = float(plan.approach.positions[-1][1:4].sum())
    assert math.radians(64.0) < pitch < math.radians(89.0)


@pytest.mark.safety("SR-10")
def test_out_of_reach_and_crowded_have_their_own_errors() -> None:
    with pytest.raises(Unreachable):
        PLANNER.plan_pick(part(Shape.SQUARE, 36.0, at(420.0, 0.0)), (), BINS[0], BINS[0].center, READY)
    with pytest.raises(Unreachable, match="outside bin"):
        PLANNER.plan_pick(part(Shape.SQUARE, 36.0, at(200.0, 0.0)), (), BINS[0], BINS[1].center, READY)
    target = part(Shape.SQUARE, 36.0, at(200.0, 0.0))
    x, y = target.center
    around = [part(Shape.SQUARE, 36.0, (x + dx, y + dy)) for dx, dy in ((41, 0), (-41, 0), (0, 41), (0, -41))]
    with pytest.raises(NoClearGrasp):
        PLANNER.plan_pick(target, around, BINS[0], BINS[0].center, READY)


def test_a_part_with_no_flat_free_is_taken_a_little_askew() -> None:
    target = part(Shape.SQUARE, 34.0, at(200.0, 0.0))
    x, y = target.center
    # Small posts before the middle of every side: the jaws pass beside them only when turned.
    posts = [part(Shape.CIRCLE, 6.0, (x + dx, y + dy)) for dx, dy in ((28, 9), (-28, -9), (9, -28), (-9, 28))]
    plan = PLANNER.plan_pick(target, posts, BINS[0], BINS[0].center, READY)
    assert math.degrees(plan.grasp.direction) % 90.0 == pytest.approx(75.0)


@pytest.mark.safety("SR-10")
def test_a_start_outside_the_joint_limits_is_refused() -> None:
    start = READY.copy()
    start[1] = -2.2
    with pytest.raises(LimitViolation, match="shoulder stands at -126"):
        PLANNER.home(start)


@pytest.mark.parametrize("name", ["reactorx_150", "widowx_200", "widowx_250", "open_manipulator_x"])
@pytest.mark.safety("SR-21")
def test_wherever_a_plan_is_stopped_the_arm_gets_home_and_parks(name: str) -> None:
    arm = load_arm(name)
    planner = Planner(arm, calibration(), BINS)
    rng = np.random.default_rng(4)
    stops = 0
    while stops < 12:
        things = scatter(rng, 3)
        box = BINS[int(rng.integers(6))]
        try:
            over = planner.filled({box.name: 0.0})
            plan = over.plan_pick(things[0], things[1:], box, box.center, np.array(arm.ready))
        except NoClearGrasp:
            continue
        for trajectory in plan.trajectories:
            q = trajectory.positions[int(rng.integers(len(trajectory.positions)))]
            q = q + rng.normal(0.0, 0.005, len(arm.joints))
            height = kinematics.points(arm, q)[3, 2]
            for back in (planner.home(q), planner.park(q)):
                way = kinematics.points(arm, back.positions)[:, 3]
                # It leaves a low place upwards before it goes anywhere else.
                low = way[:, 2] < min(60.0, height + 20.0)
                first = int(np.argmin(low)) if not low.all() else len(low)
                assert np.linalg.norm(way[:first, :2] - way[0, :2], axis=1).max(initial=0.0) < 40.0
            stops += 1


@given(seed=st.integers(0, 10_000), where=st.integers(0, 5), share=st.floats(0.0, 1.0))
@settings(max_examples=25, deadline=None)
@pytest.mark.parametrize("name", ["reactorx_150", "open_manipulator_x"])
def test_a_carry_that_was_stopped_goes_on_along_the_same_way(name: str, seed: int, where: int, share: float) -> None:
    arm = load_arm(name)
    planner = Planner(arm, calibration(), BINS)
    rng = np.random.default_rng(seed)
    try:
        plan = planner.plan_pick(scatter(rng, 1)[0], [], BINS[where], BINS[where].center, np.array(arm.ready))
    except PlanError:
        return
    whole = plan.carry.positions
    stands = whole[round(share * (len(whole) - 1))]
    rest = planner.plan_rest(plan, stands + rng.normal(0.0, 0.003, len(stands)))
    way = rest.carry.positions
    # Where it stands is known to 0.2 deg only, and the arm is led from the way to the way.
    assert np.abs(way[0] - stands).max() < 0.03
    assert np.abs(way[-1] - whole[-1]).max() < 1e-6
    off = np.abs(way[:, None] - whole[None]).max(axis=2).min(axis=1)
    # Between two of its poses, 10 ms apart, the whole way is not known any better.
    assert off.max() < 0.5 * np.abs(np.diff(whole, axis=0)).max() + 1e-6
    assert rest.retreat is plan.retreat


def test_a_carry_does_not_go_on_from_beside_its_way() -> None:
    plan = PLANNER.plan_pick(part(Shape.SQUARE, 35.0, at(230.0, 0.0)), [], BINS[0], BINS[0].center, READY)
    with pytest.raises(LimitViolation, match="away from the start"):
        PLANNER.plan_rest(plan, plan.carry.positions[0] + np.array([0.0, 0.0, 0.2, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("name", "pose"),
    [
        # beside a bin's wall, turned so that straight up is out of reach
        ("reactorx_150", (138.1, 34.9, -22.2, 99.3, -38.6)),
        # hand drawn in under the forearm: every straight way presses it into the column
        ("reactorx_150", (40.5, 23.9, 62.8, 86.7, 24.8)),
        ("reactorx_150", (-4.2, -27.8, 63.1, 111.7, 13.6)),
    ],
)
@pytest.mark.safety("SR-21")
def test_an_arm_that_has_sunk_limp_gets_home(name: str, pose: tuple[float, ...]) -> None:
    walls = tuple(replace(box, height=50.0) for box in BINS)
    planner = Planner(load_arm(name), calibration(), walls)
    for back, goal in ((planner.home, planner.arm.ready), (planner.park, planner.arm.rest)):
        assert back(np.radians(pose)).positions[-1] == pytest.approx(goal)


def test_a_way_with_a_cusp_is_given_up_and_not_timed_for_ever() -> None:
    planner = Planner(load_arm("open_manipulator_x"), calibration(), BINS)
    try:
        way = planner.home(np.radians([-1.3354348, -39.8239838, 63.1653504, 103.3515563]))
    except LimitViolation:
        return
    assert way.duration < 10.0


@pytest.mark.parametrize("name", ARMS)
def test_rest_and_ready_lead_to_each_other(name: str) -> None:
    arm = load_arm(name)
    planner = Planner(arm, calibration(), ())
    down = planner.park(np.array(arm.ready))
    up = planner.home(np.array(arm.rest))
    assert down.positions[-1] == pytest.approx(arm.rest)
    assert up.positions[-1] == pytest.approx(arm.ready)


def sector(inner: float, outer: float) -> Array:
    a = np.radians(np.arange(-50.0, 50.1, 2.5))
    ring = np.column_stack([np.cos(a), np.sin(a)])
    return np.vstack([outer * ring, inner * ring[::-1]]) - [230.0, 0.0]


def test_ready_hides_nothing_of_the_work_area() -> None:
    area = sector(125.0, 285.0) + np.array([230.0, 0.0])
    eye = np.array([230.0, 0.0, 600.0])
    assert not hides(RX150, READY, eye, area)
    assert hides(RX150, kinematics.inverse(RX150, (200.0, 0.0, 80.0))[0], eye, area)


def test_a_retreat_stays_over_the_bin_when_the_camera_sees_the_parts() -> None:
    thing = part(Shape.SQUARE, 36.0, at(200.0, 10.0))
    seen = PLANNER.plan_pick(thing, (), BINS[1], BINS[1].center, READY, view=sector(125.0, 285.0))
    home = PLANNER.plan_pick(thing, (), BINS[1], BINS[1].center, READY)
    assert seen.retreat.duration < 0.6 * home.retreat.duration
    assert np.hypot(*(tool_way(seen, 2)[-1, :2] - BINS[1].center)) < 1e-3
    everything = np.array([[-400.0, -400.0], [400.0, -400.0], [400.0, 400.0], [-400.0, 400.0]])
    hidden = PLANNER.plan_pick(thing, (), BINS[1], BINS[1].center, READY, view=everything)
    assert hidden.retreat.positions[-1] == pytest.approx(READY)


@pytest.mark.safety("SR-04")
def test_bins_are_judged_before_work_begins() -> None:
    assert all(PLANNER.bin_error(box) is None for box in BINS)
    far = Bin("far", at(450.0, 90.0), (90.0, 90.0), 35.0, 6)
    assert "too far" in str(PLANNER.bin_error(far))


def test_slower_means_longer_by_as_much() -> None:
    thing = part(Shape.SQUARE, 36.0, at(200.0, 10.0))
    half = Planner(RX150, calibration(), BINS, speed=0.5).plan_pick(thing, (), BINS[0], BINS[0].center, READY)
    full = PLANNER.plan_pick(thing, (), BINS[0], BINS[0].center, READY)
    assert half.carry.duration == pytest.approx(2.0 * full.carry.duration, rel=0.05)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
@pytest.mark.safety("SR-12")
def test_open_jaws_clear_every_neighbour_all_the_way_down(seed: int) -> None:
    """The open jaws of the sampled approach, wherever they are lower than a neighbour, are beside it."""
    things: list[LocatedObject] = scatter(np.random.default_rng(seed), 7)
    try:
        plan = PLANNER.plan_pick(things[0], things[1:], BINS[0], BINS[0].center, READY)
    except PlanError:
        return
    thickness, across = RX150.gripper.jaw_size
    near, far = plan.grasp.opening / 2.0, plan.grasp.opening / 2.0 + thickness
    for q in plan.approach.positions:
        tool = kinematics.forward(RX150, q)
        for sign in (1.0, -1.0):
            around = ((near, -1), (far, -1), (far, 1), (near, 1))
            corners = np.array([[15.0, sign * a, b * across / 2] for a, b in around])
            tips = transform(T_TABLE_BASE @ tool, corners)
            for other in things[1:]:
                if tips[:, 2].min() < other.height + 1.0:
                    flat = tips[:, :2] if sign > 0 else tips[::-1, :2]
                    assert polygon_gap(flat, other.footprint) > 1.0

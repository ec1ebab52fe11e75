"""The mechanical world: shafts, gravity, grasps, collisions, and the memory of where parts were."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.config.arm import load_arm
from controller.domain import Shape
from sim_backends.imperfections import draw
from sim_backends.mechanics import MM, coupling, half_opening, horn_range, servo_angle
from sim_backends.parts import SHAPES
from sim_backends.plant import Drive
from sim_backends.solids import Array
from sim_backends.truth import can_reach, true_parts
from sim_backends.world import World
from sim_backends.world_model import STEP
from tests.unit.sim_backends.rig import ARM, BINS, GRASP_HEIGHT, GRIP_TORQUE, TABLE, Rig, down, part, world


def turn(axis: str, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array(
        {
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
            "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
        }[axis]
    )


def tool_by_hand(angles: Array) -> Array:
    """The grasp point by the chain of the description alone."""
    place, rotation = np.zeros(3), np.eye(3)
    for joint, angle in zip(ARM.joints, angles, strict=True):
        place = place + rotation @ joint.offset
        rotation = rotation @ turn(joint.axis, angle)
    return np.asarray(place + rotation @ ARM.tool)


# --- the gripper's crank ---------------------------------------------------------------------------------


@given(st.floats(30.0, 74.0))
def test_crank_angle_and_opening_are_inverse(opening: float) -> None:
    assert 2.0 * half_opening(ARM.gripper, servo_angle(ARM.gripper, opening)) == pytest.approx(opening)


def test_the_coupling_follows_the_crank() -> None:
    low, high = horn_range(ARM.gripper)
    coefficients = coupling(ARM.gripper)
    worst = max(
        abs(np.polynomial.polynomial.polyval(a, coefficients) / MM - half_opening(ARM.gripper, float(a)))
        for a in np.linspace(low, high, 200)
    )
    assert worst < 0.04  # mm; far below what a width tells about a grasp


@pytest.mark.parametrize("opening", [32.0, 50.0, 72.0])
def test_the_jaws_open_as_far_as_the_servo_turns(opening: float) -> None:
    free = world()
    free.drive(ARM.gripper.servo_id, Drive(servo_angle(ARM.gripper, opening), 5.5, 0.235, 0.0, 1.5))
    free.advance(1.5)
    # 0.05 Nm of friction against 5.5 Nm/rad leave up to 0.01 rad, 0.26 mm.
    assert free.opening() == pytest.approx(opening, abs=0.35)
    shaft = free.shaft(ARM.gripper.servo_id)
    assert 2.0 * half_opening(ARM.gripper, shaft.angle) == pytest.approx(free.opening(), abs=0.1)


def test_the_crank_turns_torque_into_force_on_the_part() -> None:
    held = world(part(Shape.SQUARE, 200.0, 0.0))
    rig = Rig(held)
    rig.grip(60.0)
    rig.to(200.0, 0.0, GRASP_HEIGHT, math.pi / 2.0)
    rig.grip(30.0, seconds=1.0)
    shaft = held.shaft(ARM.gripper.servo_id)
    assert held.held == {0}
    assert held.opening() == pytest.approx(40.0, abs=1.0)  # soft pads yield 0.4 mm each
    # The servo stands against the part with all it may use, closing.
    assert shaft.torque == pytest.approx(-GRIP_TORQUE, abs=0.02)


# --- shafts --------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=5, max_size=5))
def test_bodies_stand_where_the_description_says(shares: list[float]) -> None:
    still = world()
    limits = np.array([joint.limits for joint in ARM.joints])
    angles = limits.mean(axis=1) + np.array(shares) * 0.4 * np.diff(limits, axis=1)[:, 0]
    pose_directly(still, angles)
    assert still.tool_pose()[:3, 3] == pytest.approx(tool_by_hand(angles), abs=1e-6)


def pose_directly(world_: World, angles: Array) -> None:
    for joint, angle in zip(ARM.joints, angles, strict=True):
        world_._data.qpos[world_._model.joint(joint.name).qposadr[0]] = angle


def test_shafts_turn_as_the_servos_are_mounted() -> None:
    askew = world(imperfections=replace(draw("ideal", 0), joint_offsets=(0.02,) * 8))
    for joint, angle in zip(ARM.joints, ARM.rest, strict=True):
        expected = -(angle + 0.02) if joint.reverse else angle + 0.02
        assert askew.shaft(joint.servo_id).angle == pytest.approx(expected)


def test_a_servo_askew_reads_its_target_while_the_link_stands_beside_it() -> None:
    askew = world(imperfections=replace(draw("ideal", 0), joint_offsets=(0.02,) * 8))
    wanted = down(200.0, 0.0, 120.0, 0.0)
    Rig(askew).move(wanted, 0.8)
    askew.advance(0.5)
    for joint, angle in zip(ARM.joints, wanted, strict=True):
        sign = -1.0 if joint.reverse else 1.0
        # 400 Nm/rad leave some thousandths of a radian to gravity.
        assert askew.shaft(joint.servo_id).angle == pytest.approx(sign * angle, abs=0.005)
    assert askew.joint_angles() == pytest.approx(wanted - 0.02, abs=0.005)


def test_a_driven_shaft_reaches_its_target_and_an_idle_one_falls() -> None:
    free = world()
    rig = Rig(free)
    rig.to(200.0, 0.0, 120.0, 0.0)
    before = free.tool_pose()[2, 3]
    assert before == pytest.approx(120.0, abs=1.0)
    for joint in ARM.joints:
        free.drive(joint.servo_id, Drive())
    free.advance(0.3)
    assert free.tool_pose()[2, 3] < before - 20.0


def test_a_servo_at_its_stock_gain_sags() -> None:
    free = world()
    Rig(free).to(200.0, 0.0, 100.0, 0.0)
    for joint in ARM.joints:
        shaft = free.shaft(joint.servo_id)
        free.drive(joint.servo_id, Drive(shaft.angle, 18.9 if "XM" in joint.model else 5.5, 0.85, 0.0, 4.0))
    lifted = free.tool_pose()[2, 3]
    free.advance(1.5)
    # Gravity over the P gain, by hand for this pose: 0.9 Nm / 18.9 Nm/rad at 0.2 m alone are 10 mm.
    assert 5.0 < lifted - free.tool_pose()[2, 3] < 20.0


def test_the_rest_pose_holds_without_torque() -> None:
    limp = world()
    limp.advance(3.0)
    assert limp.joint_angles() == pytest.approx(np.array(ARM.rest), abs=math.radians(3.0))
    assert limp.collisions == []


def test_backlash_parts_the_encoder_from_the_link_by_the_side_of_the_load() -> None:
    loose = world(imperfections=replace(draw("ideal", 0), backlash=(math.radians(0.3),) * 8))
    rig = Rig(loose)
    rig.to(220.0, 0.0, 100.0, 0.0)
    loose.advance(0.5)
    shoulder = ARM.joints[1]
    encoder = -loose.shaft(shoulder.servo_id).angle
    # Gravity pulls the shoulder forward and down; the motor holds against it from the other flank.
    assert encoder - loose.joint_angles()[1] == pytest.approx(-math.radians(0.15), abs=math.radians(0.01))


def test_time_passes_in_whole_steps_and_nothing_is_lost() -> None:
    idle = world()
    steps: list[float] = []
    idle.on_step(steps.append)
    for _ in range(10):
        idle.advance(0.0007)
    assert idle.now() == pytest.approx(0.006)
    assert steps == [STEP] * 3


# --- grasps --------------------------------------------------------------------------------------------


def carry(shape: Shape, friction: float, torque: float = GRIP_TORQUE) -> tuple[str, World]:
    """Pick a part at (180, 90) and let it fall into a bin; where it ended."""
    seeded = np.random.default_rng([SHAPES.index(shape), round(friction * 10)])
    yaw = float(seeded.uniform(-3.0, 3.0))
    world_ = world(part(shape, 180.0, 90.0, yaw, grip=44.0, friction=friction))
    x, y, closing = 180.0, 90.0, yaw + math.pi / 2.0
    if shape is Shape.TRIANGLE:
        # The middle of the altitude lies a sixth of it beyond the centroid.
        x, y = x - math.sin(yaw) * 44.0 / 6.0, y + math.cos(yaw) * 44.0 / 6.0
    rig = Rig(world_)
    rig.grip(56.0, 1.0, 0.3)
    rig.to(x, y, 80.0, closing)
    rig.to(x, y, GRASP_HEIGHT, closing, 0.5)
    rig.grip(30.0, torque)
    rig.to(x, y, 90.0, closing, 0.5)
    azimuth = math.radians(110.0)
    rig.to(230.0 * math.cos(azimuth), 230.0 * math.sin(azimuth), 90.0, azimuth + math.pi / 2.0, 0.9)
    rig.grip(58.0, 1.0, 0.6)
    truth = true_parts(world_.parts, world_.loose.poses(), world_.held, BINS, TABLE, TABLE, [True])
    return truth[0].place, world_


@pytest.mark.parametrize("friction", [0.3, 0.8])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_gripped_part_is_carried_into_a_bin(shape: Shape, friction: float) -> None:
    place, world_ = carry(shape, friction)
    assert place == "bin110"
    assert world_.collisions == []


def test_jaws_that_hardly_press_lose_the_part() -> None:
    place, _ = carry(Shape.CIRCLE, 0.3, torque=0.045)  # less than the gear's own friction
    assert place == "table"


# --- collisions ------------------------------------------------------------------------------------------


def test_a_jaw_that_comes_down_on_a_neighbour_is_a_collision() -> None:
    crowded = world(part(Shape.SQUARE, 200.0, 0.0), part(Shape.SQUARE, 200.0, 44.0))
    rig = Rig(crowded)
    rig.grip(60.0)
    rig.to(200.0, 0.0, 80.0, math.pi / 2.0)
    assert crowded.collisions == []
    crowded.loose.shove(1, (0.0, 0.0), 0.0)
    shoved = crowded.now()
    rig.to(200.0, 0.0, 25.0, math.pi / 2.0, 0.5)
    assert {c.other for c in crowded.collisions} == {"part1"}
    assert crowded.collisions[0].at > 1.0
    assert crowded.collisions[0].disturbed == pytest.approx(shoved)


def test_the_table_and_a_bin_are_collisions_and_a_long_touch_is_one() -> None:
    bare = world()
    rig = Rig(bare)
    rig.to(200.0, 0.0, 60.0, 0.0)
    rig.to(200.0, 0.0, 13.0, 0.0, 0.5)
    bare.advance(1.0)
    assert {(c.other, c.disturbed) for c in bare.collisions} == {("table", None)}
    assert len(bare.collisions) <= 2  # one for each jaw
    azimuth = math.radians(80.0)
    x, y = BINS[0].center[0] + 230.0 - 46.0, BINS[0].center[1]
    rig.to(200.0, 0.0, 90.0, 0.0)
    rig.to(x, y, 90.0, azimuth)
    rig.to(x, y, 40.0, azimuth, 0.5)
    assert "bin80" in {c.other for c in bare.collisions}


# --- parts and their past ------------------------------------------------------------------------------------


def test_parts_taken_aside_come_back_where_they_were() -> None:
    table = world(part(Shape.HEXAGON, 180.0, 60.0, 0.4), part(Shape.CIRCLE, 220.0, -60.0))
    table.advance(0.5)
    before = table.loose.poses()
    table.loose.set_aside()
    table.advance(1.0)
    assert (table.loose.poses()[:, 2] < -500.0).all()
    assert table.loose.aside
    table.loose.put_back()
    table.advance(1.0)
    assert table.loose.poses() == pytest.approx(before, abs=0.02)
    assert not table.loose.aside


def test_the_past_is_remembered() -> None:
    moved = world(part(Shape.SQUARE, 200.0, 0.0))
    rig = Rig(moved)
    rig.grip(60.0)
    rig.to(200.0, 0.0, GRASP_HEIGHT, math.pi / 2.0)
    on_table = moved.now()
    moved.remember()
    rig.grip(30.0)
    rig.to(200.0, 0.0, 100.0, math.pi / 2.0)
    poses, held = moved.past(on_table)
    assert poses[0, 2] == pytest.approx(10.0, abs=0.1)
    assert held == frozenset()
    poses, held = moved.past(moved.now())
    assert poses[0, 2] > 80.0
    assert held == {0}


def test_the_same_moves_end_bit_for_bit_the_same() -> None:
    first, second = (carry(Shape.TRIANGLE, 0.3)[1].loose.poses() for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_reach_agrees_with_the_work_area() -> None:
    for radius in (150.0, 200.0, 260.0):
        for azimuth in (-50.0, 0.0, 50.0, 110.0):
            a = math.radians(azimuth)
            assert can_reach(ARM, radius * math.cos(a), radius * math.sin(a))
    assert not can_reach(ARM, 320.0, 0.0)


@pytest.mark.parametrize("name", ["open_manipulator_x", "pincherx_100", "reactorx_150", "widowx_200", "widowx_250"])
def test_every_described_arm_can_be_built_and_rests_on_itself(name: str) -> None:
    arm = load_arm(name)
    limp = World(arm, BINS, TABLE, [], draw("static", 1))
    limp.advance(2.0)
    assert limp.joint_angles() == pytest.approx(np.array(arm.rest), abs=math.radians(4.0))
    assert limp.collisions == []
    shadows = [j for j in arm.joints if j.shadow_id is not None]
    for joint in shadows:
        assert joint.shadow_id is not None
        assert limp.shaft(joint.shadow_id).angle == pytest.approx(-limp.shaft(joint.servo_id).angle)


def test_what_is_over_a_bin_is_told_in_base_from_bins_given_in_table() -> None:
    laid = world(part(Shape.SQUARE, 200.0, 0.0))
    for bin_ in BINS:
        x, y = bin_.center[0] + TABLE[0, 3], bin_.center[1]
        assert laid.over_bin(np.array([x, y, 150.0]))
        assert laid.over_bin(np.array([x + 44.0, y - 44.0, 150.0]))
    assert not laid.over_bin(np.array([200.0, 0.0, 150.0]))
    assert not laid.over_bin(np.array([0.0, 0.0, 150.0]))

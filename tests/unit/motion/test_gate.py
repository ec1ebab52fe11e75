from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from controller.domain import Array, Trajectory
from controller.errors import LimitViolation
from controller.motion import kinematics
from controller.motion.gate import Gate, workspace
from controller.motion.path import join, line, stroke
from controller.motion.trajectory import generate
from tests.unit.motion.scene import RX150, at, bins, calibration

CELL = calibration()
EYE = np.array([230.0, 0.0, 600.0])
GATE = Gate(RX150, CELL.T_base_table, bins(), workspace(bins(), CELL.T_base_table, RX150), EYE)
READY = np.array(RX150.ready)


def move(start: Array, end: Array) -> Trajectory:
    return generate(RX150, join(RX150, [line(RX150, start, end)], []), "test")


def above(radius: float, azimuth_deg: float, height: float, roll: float = 0.0, pitch: float = math.pi / 2) -> Array:
    x, y = at(radius, azimuth_deg)
    return np.asarray(kinematics.inverse(RX150, (x + 230.0, y, height), pitch, roll)[0])


@pytest.mark.safety("SR-10")
def test_an_honest_move_passes() -> None:
    GATE.check(move(READY, above(200.0, 20.0, 80.0)), READY)


@pytest.mark.safety("SR-11")
def test_a_number_that_is_none_is_refused() -> None:
    good = move(READY, above(200.0, 20.0, 80.0))
    broken = np.array(good.positions)
    broken[5, 2] = math.nan
    for bad in (replace(good, positions=broken), replace(good, goals=broken)):
        with pytest.raises(LimitViolation, match="finite"):
            GATE.check(bad, READY)


def test_a_move_of_another_arm_is_refused() -> None:
    good = move(READY, above(200.0, 20.0, 80.0))
    with pytest.raises(LimitViolation, match="do not suit"):
        GATE.check(replace(good, positions=good.positions[:, :4], goals=good.goals[:, :4]), READY)


@pytest.mark.safety("SR-11")
def test_a_joint_beyond_its_limit_is_named() -> None:
    end = READY.copy()
    end[3] = RX150.joints[3].limits[1] + 0.02
    with pytest.raises(LimitViolation, match=r"wrist_angle 124\.1 deg, limit 123\.0 deg"):
        GATE.check(move(READY, end), READY)


@pytest.mark.safety("SR-11")
def test_too_fast_is_refused() -> None:
    hasty = replace(RX150, joints=tuple(replace(j, speed_limit=1.1 * j.speed_limit) for j in RX150.joints))
    end = READY + np.array([1.5, 0.0, 0.0, 0.0, 0.0])
    quick = generate(hasty, join(hasty, [line(hasty, READY, end)], []), "test")
    with pytest.raises(LimitViolation, match=r"waist speed 2\.7 rad/s, limit 2\.5 rad/s"):
        GATE.check(quick, READY)


@pytest.mark.safety("SR-11")
def test_a_jump_is_refused_for_its_acceleration() -> None:
    good = move(READY, above(200.0, 20.0, 80.0))
    q = np.array(good.positions)
    q[len(q) // 2 :, 0] += 0.01
    with pytest.raises(LimitViolation, match="waist acceleration"):
        GATE.check(replace(good, positions=q, goals=good.goals + 0.01), READY)


@pytest.mark.safety("SR-11")
def test_a_goal_far_ahead_of_its_position_is_refused() -> None:
    good = move(READY, above(200.0, 20.0, 80.0))
    with pytest.raises(LimitViolation, match="waist goal ahead"):
        GATE.check(replace(good, goals=good.goals + np.eye(5)[0] * 0.5), READY)


@pytest.mark.safety("SR-13")
def test_a_move_must_start_where_the_arm_stands() -> None:
    elsewhere = READY + np.eye(5)[0] * 0.2
    with pytest.raises(LimitViolation, match="waist away from the start by 11"):
        GATE.check(move(READY, above(200.0, 20.0, 80.0)), elsewhere)


@pytest.mark.safety("SR-12")
def test_the_table_is_solid() -> None:
    top = above(200.0, 20.0, 80.0)
    # Jaw tips 15 mm below the grasp point: 1 mm into the table.
    down = generate(RX150, join(RX150, [stroke(RX150, top, -66.0)], []), "dive")
    with pytest.raises(LimitViolation, match=r"dive: height of the jaw tips over the table -1\.0 mm"):
        GATE.check(down, top)


@pytest.mark.safety("SR-12")
def test_bin_walls_are_solid() -> None:
    side = above(230.0, 80.0, 90.0)
    low = stroke(RX150, side, -50.0)
    GATE.check(generate(RX150, join(RX150, [low], []), "into"), side, opening=40.0)
    # 45 mm to the side of the middle is the wall itself.
    on_wall = above(190.0, 80.0, 90.0)
    down = generate(RX150, join(RX150, [stroke(RX150, on_wall, -50.0)], []), "into")
    with pytest.raises(LimitViolation, match="wall of bin bin0"):
        GATE.check(down, on_wall, opening=40.0)


def test_leaving_a_bin_sideways_is_refused_upwards_is_not() -> None:
    deep = above(230.0, 80.0, 40.0)
    GATE.check(generate(RX150, join(RX150, [stroke(RX150, deep, 60.0)], []), "out"), deep, opening=40.0)
    with pytest.raises(LimitViolation, match="wall of bin bin0"):
        GATE.check(move(deep, above(230.0, 40.0, 40.0)), deep, opening=40.0)


@pytest.mark.safety("SR-12")
def test_the_arm_does_not_hit_its_own_column() -> None:
    start = above(160.0, 0.0, 110.0)
    end = above(30.0, 0.0, 70.0, pitch=2.2)
    with pytest.raises(LimitViolation, match="own column"):
        GATE.check(move(start, end), start)


@pytest.mark.safety("SR-12")
def test_the_camera_is_kept_clear() -> None:
    start, up = READY, np.array([0.0, -0.2, -1.2, 0.2, 0.0])
    near = replace(GATE, eye=kinematics.points(RX150, up)[3] + [30.0, 0.0, 0.0], radius=1000.0)
    with pytest.raises(LimitViolation, match="camera"):
        near.check(move(start, up), start)


@pytest.mark.safety("SR-12")
def test_the_tool_stays_near_its_work() -> None:
    start, out = above(250.0, 0.0, 120.0), np.array([0.0, 1.0, -0.6, 0.0, 0.0])
    with pytest.raises(LimitViolation, match="distance of the tool"):
        GATE.check(move(start, out), start)
    # Found outside, it may come back.
    GATE.check(move(out, start), out)

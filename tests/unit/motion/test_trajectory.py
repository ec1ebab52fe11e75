from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.config.arm import load_arm
from controller.domain import ArmDescription, Array
from controller.motion import dynamics, kinematics
from controller.motion.path import Path, join, line, speed_limits, stroke
from controller.motion.trajectory import PERIOD, acceleration_limits, fastest, generate
from tests.unit.motion.scene import ARMS, RX150


def descent(arm: ArmDescription, start: Array, radius: float, azimuth: float, roll: float) -> Path:
    place = (radius * math.cos(azimuth), radius * math.sin(azimuth), 20.0)
    low = kinematics.inverse(arm, place, roll=roll)[0]
    down = stroke(arm, low, 60.0).reversed()
    return join(arm, [line(arm, start, down.start), down], [(100.0, 30.0)])


@given(
    radius=st.floats(150.0, 250.0),
    azimuth=st.floats(-0.9, 0.9),
    roll=st.floats(-1.5, 1.5),
    waist=st.floats(-2.5, 2.5),
    speed=st.sampled_from([0.1, 0.5, 1.0]),
)
@settings(max_examples=60, deadline=None)
@pytest.mark.safety("SR-11")
def test_moves_keep_the_limits_and_end_straight(
    radius: float, azimuth: float, roll: float, waist: float, speed: float
) -> None:
    start = np.array(RX150.ready)
    start[0] = waist
    path = descent(RX150, start, radius, azimuth, roll)
    move = generate(RX150, path, "test", speed=speed)
    q = move.positions
    qd = np.diff(q, axis=0) / PERIOD
    qdd = np.diff(np.vstack([0.0 * qd[:1], qd, 0.0 * qd[:1]]), axis=0) / PERIOD
    jerk = np.diff(qdd, axis=0) / PERIOD
    # 1 % is the stated slack of the samples; accelerations go with the square.
    assert (np.abs(qd) <= speed * speed_limits(RX150) * 1.011).all()
    assert (np.abs(qdd) <= speed**2 * acceleration_limits(RX150) * 1.03).all()
    # The moving average of 40 ms bounds the jerk by the change of acceleration within it, 2 a / 40 ms, and what
    # the path's own bends add.
    assert (np.abs(jerk) <= 3.0 * acceleration_limits(RX150) / 0.04).all()
    assert np.abs(q[0] - start).max() < 1e-9
    way = kinematics.points(RX150, q)[:, 3]
    foot = way[-1]
    assert foot[2] == pytest.approx(20.0, abs=1e-6)
    straight = way[way[:, 2] < 20.0 + 29.9]
    # The spline between exact solutions every 12 ms of full speed.
    assert np.abs(straight[:, :2] - foot[:2]).max() < 0.01
    assert (np.diff(straight[:, 2]) <= 1e-6).all()


def test_timing_is_near_the_limit_everywhere() -> None:
    """At every point of the fastest timing some joint is at its speed or acceleration limit: nothing is given away."""
    path = descent(RX150, np.array([1.8, *RX150.ready[1:]]), 200.0, -0.5, 0.4)
    speeds, accelerations = speed_limits(RX150), acceleration_limits(RX150)
    timing = fastest(path, speeds, accelerations)
    slope, bend = path.spline(timing.phases, 1), path.spline(timing.phases, 2)
    gain = np.diff(timing.rates**2) / 2.0 / np.diff(timing.phases)
    rate = timing.rates[:-1]
    qd = np.abs(slope[:-1] * rate[:, None]) / speeds
    qdd = np.abs(slope[:-1] * gain[:, None] + bend[:-1] * (rate**2)[:, None]) / accelerations
    busy = np.maximum(qd.max(axis=1), qdd.max(axis=1))
    assert qd.max() < 1.0 + 1e-6
    # Discretisation: a grid step is 1 % of the path, accelerations may change by that much within it.
    assert np.median(busy) > 0.99
    assert (busy > 0.9).mean() > 0.9


def test_a_single_joint_moves_as_a_trapezoid() -> None:
    start = np.zeros(5)
    end = np.array([2.0, 0.0, 0.0, 0.0, 0.0])
    waist = RX150.joints[0]
    v, a = waist.speed_limit, waist.acceleration_limit
    timing = fastest(join(RX150, [line(RX150, start, end)], []), speed_limits(RX150), acceleration_limits(RX150))
    # The grid of 1 % steps rounds the two corners of the profile.
    assert timing.times[-1] == pytest.approx(2.0 / v + v / a, rel=0.01)


def test_smoothing_costs_its_window_only() -> None:
    path = descent(RX150, np.array(RX150.ready), 220.0, 0.6, 0.0)
    move = generate(RX150, path, "test")
    best = fastest(path, speed_limits(RX150), acceleration_limits(RX150)).times[-1]
    assert best + 0.03 <= move.duration <= 1.08 * best + 0.06


def test_speed_stretches_time_without_leaving_the_path() -> None:
    path = descent(RX150, np.array(RX150.ready), 220.0, 0.6, 0.0)
    slow, fast = (kinematics.points(RX150, generate(RX150, path, "t", speed=s).positions)[:, 3] for s in (0.25, 1.0))
    assert len(slow) == pytest.approx(4 * len(fast), rel=0.05)
    for place in fast:
        assert np.linalg.norm(slow - place, axis=1).min() < 3.0  # half the distance of two samples of the slow move


def test_goals_lead_and_hold_the_arm_up() -> None:
    path = descent(RX150, np.array(RX150.ready), 220.0, 0.3, 0.0)
    offsets = np.array([0.01, -0.02, 0.03, 0.0, 0.0])
    plain = generate(RX150, path, "t")
    held = generate(RX150, path, "t", joint_offsets=offsets, payload=(0.0, 0.05))
    assert held.goals[0] - plain.goals[0] == pytest.approx(offsets, abs=2e-3)  # the weight comes over 0.1 s
    end = plain.positions[-1]
    stiffness = np.array([j.dynamics.stiffness for j in RX150.joints])
    for move, extra, mass in ((plain, 0.0 * offsets, 0.0), (held, offsets, 0.05)):
        still = np.zeros((1, len(end)))
        sag = dynamics.torque(RX150, end[None], still, still, mass)[0] / stiffness
        assert move.goals[-1] - extra == pytest.approx(end + sag, abs=1e-4)
    assert not held.positions.flags.writeable


@pytest.mark.parametrize("name", ARMS)
def test_no_move_at_all_is_a_move(name: str) -> None:
    arm = load_arm(name)
    pose = np.array(arm.ready)
    move = generate(arm, join(arm, [line(arm, pose, pose)], []), "stay")
    assert np.abs(move.positions - pose).max() < 1e-9
    assert np.isfinite(move.goals).all()


def test_as_fast_as_toppra_without_jerk_limit() -> None:
    toppra = pytest.importorskip("toppra")
    toppra.setup_logging("ERROR")
    rng = np.random.default_rng(5)
    ratios = []
    for _ in range(10):
        start = np.array([rng.uniform(-2.3, 2.3), *RX150.ready[1:]])
        path = descent(RX150, start, float(rng.uniform(160, 250)), float(rng.uniform(-0.8, 0.8)), 0.3)
        knots = np.linspace(0.0, path.length, 200)
        spline = toppra.SplineInterpolator(knots, path.spline(knots))
        limits = [
            toppra.constraint.JointVelocityConstraint(speed_limits(RX150)),
            toppra.constraint.JointAccelerationConstraint(acceleration_limits(RX150)),
        ]
        peer = toppra.algorithm.TOPPRA(limits, spline, parametrizer="ParametrizeConstAccel").compute_trajectory()
        own = fastest(path, speed_limits(RX150), acceleration_limits(RX150)).times[-1]
        ratios.append(own / peer.duration)
    assert max(ratios) < 1.03

"""Progress along a trajectory: it slips, slows and resumes, and never jumps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.domain import Trajectory
from drivers.arm.streaming import BLEND_TIME, LONGEST_RAMP, SHORTEST_RAMP, STANDSTILL, TORQUE_SHARE, Pace, Progress
from tests.contract.arm_suite import quintic

PERIOD = 0.01


def _move(duration: float = 1.0) -> Trajectory:
    return quintic(np.zeros(2), np.array([1.0, -0.5]), duration, PERIOD)


LAG = 0.04  # s

STALL = np.array([0.2, 0.2])
"""rad: an XM430's at its factory P gain."""


def _heavy(inertia: float, sag: float = 0.0) -> Trajectory:
    """A move whose goals lead against lag and sag (rad), and against inertia over stiffness (s^2) when it slows."""
    plain = _move()
    speeds = np.gradient(plain.positions, PERIOD, axis=0)
    still = plain.positions + sag
    return Trajectory("m", PERIOD, plain.positions, still + LAG * speeds, still, inertia * speeds)


def _progress(trajectory: Trajectory) -> Progress:
    return Progress(trajectory, trajectory.goals[0], STALL)


def test_on_time_every_sample_is_sent() -> None:
    move = _move()
    progress = _progress(move)
    for sample in move.goals:
        np.testing.assert_allclose(progress.goals, sample, atol=1e-12)
        progress.advance(PERIOD, Pace.GO)
    assert progress.at_end
    assert progress.slipped == 0.0


def test_between_samples_it_interpolates() -> None:
    move = _move()
    progress = _progress(move)
    progress.advance(PERIOD / 4, Pace.GO)
    np.testing.assert_allclose(progress.goals, 0.75 * move.goals[0] + 0.25 * move.goals[1], atol=1e-12)


@given(st.lists(st.tuples(st.floats(0.0, 0.5), st.sampled_from(Pace)), max_size=150))
@pytest.mark.safety("SR-14")
def test_it_never_jumps_and_never_goes_back(cycles: list[tuple[float, Pace]]) -> None:
    move = _move()
    progress = _progress(move)
    for elapsed, pace in cycles:
        before = progress.phase
        progress.advance(elapsed, pace)
        assert 0.0 <= progress.phase - before <= min(elapsed, 2 * PERIOD) + 1e-12
        assert 0.0 <= progress.rate <= 1.0


@pytest.mark.safety("SR-20")
@pytest.mark.parametrize(("inertia", "seconds"), [(0.0, SHORTEST_RAMP), (1.0, LONGEST_RAMP)])
@pytest.mark.parametrize("pace", TORQUE_SHARE)
def test_slowing_down_takes_its_time_and_stands(inertia: float, seconds: float, pace: Pace) -> None:
    """With inertia (s^2, over the stiffness) that the servos cannot hold, and with none."""
    progress = _progress(_heavy(inertia))
    for _ in range(40):
        progress.advance(PERIOD, Pace.GO)
    progress.advance(PERIOD, pace)
    began = progress.phase
    rates = [progress.rate]
    while not progress.standing:
        progress.advance(PERIOD, pace)
        rates.append(progress.rate)
    assert len(rates) - 1 == round(seconds / PERIOD)
    # An even ramp passes on half of its time.
    assert progress.phase - began == pytest.approx(seconds / 2, rel=0.01)
    assert np.all(np.diff(rates) < 0.0)
    there = progress.goals
    progress.advance(PERIOD, pace)
    np.testing.assert_array_equal(progress.goals, there)
    # And on again, gently: the first goal begins to push, the next is ahead.
    progress.advance(PERIOD, Pace.GO)
    progress.advance(PERIOD, Pace.GO)
    assert 0.0 < progress.rate < 0.1


@given(st.floats(0.1, 0.9), st.floats(0.0, 0.02), st.floats(-0.1, 0.1), st.sampled_from(sorted(TORQUE_SHARE, key=str)))
@pytest.mark.safety("SR-20")
def test_slowing_down_asks_no_servo_for_more_than_its_share(at: float, inertia: float, sag: float, pace: Pace) -> None:
    """Unless the move itself or the longest ramp does."""
    move = _heavy(inertia, sag)
    progress = _progress(move)
    for _ in range(round(at / PERIOD)):
        progress.advance(PERIOD, Pace.GO)
    asked = []
    progress.advance(PERIOD, pace)
    while not progress.standing:
        asked.append(np.abs(progress.goals - progress.positions).max())
        progress.advance(PERIOD, pace)
    top = np.abs(np.diff(move.positions, axis=0)).max() / PERIOD
    unavoidable = abs(sag) + top * max(LAG, inertia / LONGEST_RAMP)
    # The lead is that of the middle of the period, the torque that of its begin: half a period of the
    # steepest ramp.
    assert max(asked) <= max(TORQUE_SHARE[pace] * STALL[0], unavoidable) + 0.5 * PERIOD / SHORTEST_RAMP * LAG * top
    assert len(asked) <= round(LONGEST_RAMP / PERIOD)


@pytest.mark.safety("SR-14")
def test_a_goal_loses_its_lead_with_the_rate_and_pushes_against_the_change() -> None:
    """0.1 of lead against lag, 0.02 of sag, and 0.03 rad s of inertia."""
    plain = _move()
    still = plain.positions + 0.02
    move = Trajectory("m", PERIOD, plain.positions, still + 0.1, still, np.full_like(still, 0.03))
    progress = _progress(move)
    for _ in range(40):
        progress.advance(PERIOD, Pace.GO)
    np.testing.assert_allclose(progress.goals, progress.positions + 0.12, atol=1e-12)
    while not progress.standing:
        progress.advance(PERIOD, Pace.STOP)
        told, there, before = progress.goals, progress.positions, progress.rate
        progress.advance(PERIOD, Pace.STOP)
        gain = (progress.rate - before) / PERIOD
        # What a goal is made for is the middle of the period it holds for.
        wanted = there + 0.02 + 0.1 * 0.5 * (before + progress.rate) + 0.03 * gain
        np.testing.assert_allclose(told, wanted, atol=1e-12)
    progress.advance(PERIOD, Pace.STOP)
    np.testing.assert_allclose(progress.goals, progress.positions + 0.02, atol=1e-12)


def test_after_a_long_gap_it_starts_from_rest() -> None:
    progress = _progress(_move())
    for _ in range(40):
        progress.advance(PERIOD, Pace.GO)
    progress.advance(STANDSTILL + 0.01, Pace.GO)
    assert progress.rate < 0.1
    assert progress.slipped == pytest.approx(STANDSTILL + 0.01 - 2 * PERIOD)


def test_a_difference_from_the_last_goal_is_led_to_zero() -> None:
    move = _move()
    progress = Progress(move, move.goals[0] + np.array([0.1, 0.0]), STALL)
    np.testing.assert_allclose(progress.goals, [0.1, 0.0])
    for _ in range(round(BLEND_TIME / PERIOD)):
        progress.advance(PERIOD, Pace.GO)
    index = round(progress.phase / PERIOD)
    np.testing.assert_allclose(progress.goals, move.goals[index], atol=1e-9)


def test_a_trajectory_of_one_sample_blends_too() -> None:
    still = Trajectory("still", PERIOD, np.zeros((1, 2)), np.zeros((1, 2)))
    progress = Progress(still, np.array([0.05, 0.05]), STALL)
    ended = []
    for _ in range(round(BLEND_TIME / PERIOD) + 1):
        ended.append(progress.at_end)
        progress.advance(PERIOD, Pace.GO)
    ended.append(progress.at_end)
    assert ended[0] is False
    assert ended[-1] is True
    np.testing.assert_allclose(progress.goals, 0.0, atol=1e-9)


def test_rebasing_goes_on_from_where_the_joints_are() -> None:
    progress = _progress(_move())
    for _ in range(50):
        progress.advance(PERIOD, Pace.GO)
    here = progress.goals - 0.07
    progress.rebase(here)
    np.testing.assert_allclose(progress.goals, here)
    before = progress.goals
    for _ in range(100):
        progress.advance(PERIOD, Pace.GO)
        # Twice the planned speed at most: the blend comes on top of the move.
        assert np.abs(progress.goals - before).max() < 2 * 0.01875
        before = progress.goals
    assert progress.at_end

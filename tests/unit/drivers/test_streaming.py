"""Progress along a trajectory: it slips, slows and resumes, and never jumps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.domain import Array, Trajectory
from drivers.arm.streaming import BLEND_TIME, SHORTEST_STOP, STANDSTILL, STOP_TIME, Progress
from tests.contract.arm_suite import quintic

PERIOD = 0.01


def _move(duration: float = 1.0) -> Trajectory:
    return quintic(np.zeros(2), np.array([1.0, -0.5]), duration, PERIOD)


FULL_SPEED = np.array([1.0, 1.0])
"""rad/s: less than the moves' own, so that stops take their full time."""


def _progress(trajectory: Trajectory, full_speeds: Array = FULL_SPEED) -> Progress:
    return Progress(trajectory, trajectory.goals[0], full_speeds)


def test_on_time_every_sample_is_sent() -> None:
    move = _move()
    progress = _progress(move)
    for sample in move.goals:
        np.testing.assert_allclose(progress.goals, sample, atol=1e-12)
        progress.advance(PERIOD, stopping=False)
    assert progress.at_end
    assert progress.slipped == 0.0


def test_between_samples_it_interpolates() -> None:
    move = _move()
    progress = _progress(move)
    progress.advance(PERIOD / 4, stopping=False)
    np.testing.assert_allclose(progress.goals, 0.75 * move.goals[0] + 0.25 * move.goals[1], atol=1e-12)


@given(st.lists(st.tuples(st.floats(0.0, 0.5), st.booleans()), max_size=150))
@pytest.mark.safety("SR-14")
def test_it_never_jumps_and_never_goes_back(cycles: list[tuple[float, bool]]) -> None:
    move = _move()
    progress = _progress(move)
    for elapsed, stopping in cycles:
        before = progress.phase
        progress.advance(elapsed, stopping)
        assert 0.0 <= progress.phase - before <= min(elapsed, 2 * PERIOD) + 1e-12
        assert 0.0 <= progress.rate <= 1.0


def test_a_stop_takes_its_time_and_stands() -> None:
    progress = _progress(_move())
    for _ in range(40):
        progress.advance(PERIOD, stopping=False)
    began = progress.phase
    cycles = 0
    rates = [progress.rate]
    while not progress.standing:
        progress.advance(PERIOD, stopping=True)
        rates.append(progress.rate)
        cycles += 1
    assert cycles == round(STOP_TIME / PERIOD)
    # A raised cosine passes on half of its time.
    assert progress.phase - began == pytest.approx(STOP_TIME / 2, rel=0.01)
    assert np.all(np.diff(rates) < 0.0)
    there = progress.goals
    progress.advance(PERIOD, stopping=True)
    np.testing.assert_array_equal(progress.goals, there)
    # And on again, gently.
    progress.advance(PERIOD, stopping=False)
    assert 0.0 < progress.rate < 0.05


@given(st.floats(0.05, 0.95), st.floats(0.05, 1.0))
@pytest.mark.safety("SR-20")
def test_slower_joints_stop_sooner_and_no_harder(at: float, slow: float) -> None:
    """`slow` is the move's top speed as a share of the full one."""
    move = _move()
    top = np.abs(np.diff(move.positions, axis=0)).max(axis=0) / PERIOD
    progress = _progress(move, top / slow)
    for _ in range(round(at / PERIOD)):
        progress.advance(PERIOD, stopping=False)
    told = [progress.positions]
    while not progress.standing:
        progress.advance(PERIOD, stopping=True)
        told.append(progress.positions)
    seconds = (len(told) - 1) * PERIOD
    assert seconds <= max(SHORTEST_STOP, STOP_TIME * slow) + PERIOD
    # A cosine's steepest slope, beside the move's own slowing down.
    own = np.abs(np.diff(move.positions, 2, axis=0)).max(axis=0) / PERIOD**2
    slowing = np.abs(np.diff(told, 2, axis=0)).max(axis=0) / PERIOD**2
    assert np.all(slowing <= own + 0.5 * np.pi * (top / slow) / STOP_TIME)


@pytest.mark.safety("SR-14")
def test_a_goal_loses_its_lead_with_the_rate_and_pushes_against_the_change() -> None:
    """0.1 of lead against lag, 0.02 of sag, and 0.03 rad s of inertia."""
    plain = _move()
    still = plain.positions + 0.02
    move = Trajectory("m", PERIOD, plain.positions, still + 0.1, still, np.full_like(still, 0.03))
    progress = _progress(move)
    for _ in range(40):
        progress.advance(PERIOD, stopping=False)
    np.testing.assert_allclose(progress.goals, progress.positions + 0.12, atol=1e-12)
    before = progress.rate
    while not progress.standing:
        progress.advance(PERIOD, stopping=True)
        gain = (progress.rate - before) / PERIOD
        wanted = progress.positions + 0.02 + 0.1 * progress.rate + 0.03 * gain
        np.testing.assert_allclose(progress.goals, wanted, atol=1e-12)
        before = progress.rate
    progress.advance(PERIOD, stopping=True)
    np.testing.assert_allclose(progress.goals, progress.positions + 0.02, atol=1e-12)


def test_after_a_long_gap_it_starts_from_rest() -> None:
    progress = _progress(_move())
    for _ in range(40):
        progress.advance(PERIOD, stopping=False)
    progress.advance(STANDSTILL + 0.01, stopping=False)
    assert progress.rate < 0.1
    assert progress.slipped == pytest.approx(STANDSTILL + 0.01 - 2 * PERIOD)


def test_a_difference_from_the_last_goal_is_led_to_zero() -> None:
    move = _move()
    progress = Progress(move, move.goals[0] + np.array([0.1, 0.0]), FULL_SPEED)
    np.testing.assert_allclose(progress.goals, [0.1, 0.0])
    for _ in range(round(BLEND_TIME / PERIOD)):
        progress.advance(PERIOD, stopping=False)
    index = round(progress.phase / PERIOD)
    np.testing.assert_allclose(progress.goals, move.goals[index], atol=1e-9)


def test_a_trajectory_of_one_sample_blends_too() -> None:
    still = Trajectory("still", PERIOD, np.zeros((1, 2)), np.zeros((1, 2)))
    progress = Progress(still, np.array([0.05, 0.05]), FULL_SPEED)
    ended = []
    for _ in range(round(BLEND_TIME / PERIOD) + 1):
        ended.append(progress.at_end)
        progress.advance(PERIOD, stopping=False)
    ended.append(progress.at_end)
    assert ended[0] is False
    assert ended[-1] is True
    np.testing.assert_allclose(progress.goals, 0.0, atol=1e-9)


def test_rebasing_goes_on_from_where_the_joints_are() -> None:
    progress = _progress(_move())
    for _ in range(50):
        progress.advance(PERIOD, stopping=False)
    here = progress.goals - 0.07
    progress.rebase(here)
    np.testing.assert_allclose(progress.goals, here)
    before = progress.goals
    for _ in range(100):
        progress.advance(PERIOD, stopping=False)
        # Twice the planned speed at most: the blend comes on top of the move.
        assert np.abs(progress.goals - before).max() < 2 * 0.01875
        before = progress.goals
    assert progress.at_end

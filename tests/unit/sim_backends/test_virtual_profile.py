"""Motion profiles: they start where the servo is, keep their limits and end at the goal."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.virtual_dynamixel.profile import Profile, plan, rectangular, timed, trapezoidal

positions = st.floats(-4096.0, 8192.0)
velocities = st.floats(-3000.0, 3000.0)
speeds = st.floats(15.0, 3000.0)
ramps = st.floats(244.0, 50_000.0)


def duration(profile: Profile) -> float:
    return sum(piece[0] for piece in profile.pieces)


def ends(profile: Profile) -> list[tuple[float, float]]:
    """(position, velocity) at the end of each piece."""
    return [(p + t * (v + 0.5 * a * t), v + a * t) for t, p, v, a in profile.pieces]


@given(positions, velocities, positions, speeds, ramps)
def test_a_trapezoid_is_smooth_bounded_and_arrives(
    position: float, velocity: float, goal: float, speed: float, ramp: float
) -> None:
    profile = trapezoidal(5.0, position, velocity, goal, speed, ramp)
    place, pace = position, velocity
    for (_, p, v, a), (p_end, v_end) in zip(profile.pieces, ends(profile), strict=True):
        # Ticks: rounding of sums of some thousand ticks.
        assert p == pytest.approx(place, abs=1e-6)
        assert v == pytest.approx(pace, abs=1e-6)
        assert abs(a) <= ramp * (1 + 1e-9)
        place, pace = p_end, v_end
        assert abs(pace) <= max(speed, abs(velocity)) + 1e-6
    # A cruise shorter than the rounding is left out.
    assert place == pytest.approx(goal, abs=1e-5)
    assert pace == pytest.approx(0.0, abs=1e-5)
    assert profile.at(5.0 + duration(profile) + 1e-6) == (goal, 0.0, True)


@given(positions, positions, speeds, ramps)
def test_a_trapezoid_from_rest_is_the_fastest_way_within_its_limits(
    position: float, goal: float, speed: float, ramp: float
) -> None:
    profile = trapezoidal(0.0, position, 0.0, goal, speed, ramp)
    distance = abs(goal - position)
    full = distance >= speed * speed / ramp
    fastest = distance / speed + speed / ramp if full else 2.0 * (distance / ramp) ** 0.5
    assert duration(profile) == pytest.approx(fastest, rel=1e-6, abs=1e-6)


@given(positions, velocities, positions, st.integers(1, 5000), st.integers(0, 5000))
def test_a_timed_profile_takes_its_time_and_arrives(
    position: float, velocity: float, goal: float, duration_ms: int, ramp_ms: int
) -> None:
    seconds = duration_ms * 1e-3
    profile = timed(1.0, position, velocity, goal, seconds, ramp_ms * 1e-3)
    assert duration(profile) == pytest.approx(seconds)
    assert profile.at(1.0)[0] == pytest.approx(position)
    assert ends(profile)[-1][0] == pytest.approx(goal, abs=1e-5)
    assert profile.at(1.0 + seconds + 1e-9) == (goal, 0.0, True)


def test_registers_choose_the_kind() -> None:
    common = (0.0, 0.0, 0.0, 1000.0)
    assert plan(*common, 64, 0, False) == rectangular(0.0, 0.0, 1000.0, 64 * 0.229 / 60 * 4096)
    assert plan(*common, 64, 16, False).kind == 3
    assert plan(*common, 1000, 16, False).kind == 2
    assert duration(plan(*common, 700, 100, True)) == pytest.approx(0.7)

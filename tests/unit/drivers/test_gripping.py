"""When jaws have stopped."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.arm.gripping import RATED_PWM, SMALLEST_PWM, StopDetector, goal_pwm

PERIOD = 0.01


def _first_stop(angles: list[float]) -> int | None:
    detector = StopDetector(0.0, angles[0])
    for index, angle in enumerate(angles[1:], 1):
        if detector.stopped(index * PERIOD, angle):
            return index
    return None


def _approach(speed: float, contact: int, total: int = 60) -> list[float]:
    """Starts from rest over 50 ms, moves at `speed` rad/s, stands from sample `contact` on."""
    angles = [0.0]
    for index in range(1, total):
        angles.append(angles[-1] + speed * PERIOD * min(1.0, index / 5) * (index < contact))
    return angles


@pytest.mark.parametrize("speed", [0.5, 2.0, 6.0])
@pytest.mark.parametrize("contact", [8, 20, 45])
@pytest.mark.safety("SR-16")
def test_contact_is_seen_within_two_samples_and_never_before(speed: float, contact: int) -> None:
    stop = _first_stop(_approach(speed, contact))
    assert stop is not None
    assert contact <= stop <= contact + 2


def test_an_encoders_noise_is_no_motion_and_no_second_stop() -> None:
    noise = np.random.default_rng(1).integers(-1, 2, 100) * 0.00153
    angles = (np.array(_approach(2.0, 30, 100)) + noise).tolist()
    detector = StopDetector(0.0, angles[0])
    seen = [detector.stopped(index * PERIOD, angle) for index, angle in enumerate(angles[1:], 1)]
    assert not any(seen[:29])
    assert all(seen[33:])


def test_jaws_that_never_move_have_stopped() -> None:
    stop = _first_stop([0.0] * 40)
    assert stop is not None
    assert 0.15 < stop * PERIOD < 0.2


def test_slowing_down_a_little_is_no_stop() -> None:
    angles = np.concatenate([np.arange(20) * 0.03, 0.57 + np.arange(1, 20) * 0.015])
    assert _first_stop(angles.tolist()) is None


def test_missed_samples_do_not_matter() -> None:
    detector = StopDetector(0.0, 0.0)
    assert not detector.stopped(0.02, 0.06)
    assert not detector.stopped(0.09, 0.27)  # 70 ms later, still at 3 rad/s
    assert detector.stopped(0.12, 0.27)


@pytest.mark.safety("SR-16")
def test_force_from_effort() -> None:
    assert goal_pwm(1.0) == RATED_PWM
    assert goal_pwm(0.6) == round(0.6 * RATED_PWM)
    assert goal_pwm(0.01) == SMALLEST_PWM

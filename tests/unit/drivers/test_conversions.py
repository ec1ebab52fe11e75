"""Ticks, angles, openings: there and back."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.config.arm import load_arm
from drivers.arm.conversions import (
    VELOCITY_UNIT,
    angle_from_opening,
    angle_from_ticks,
    opening_from_angle,
    opening_sign,
    ticks_from_angle,
    ticks_from_angles,
)

ARMS = ["open_manipulator_x", "pincherx_100", "reactorx_150", "widowx_200", "widowx_250"]


@given(st.integers(0, 4095))
def test_ticks_survive_the_way_there_and_back(ticks: int) -> None:
    assert ticks_from_angle(angle_from_ticks(ticks)) == ticks


def test_known_angles() -> None:
    assert ticks_from_angle(0.0) == 2048
    assert ticks_from_angle(math.pi / 2) == 3072
    assert ticks_from_angles(np.array([-math.pi / 2, 0.001])).tolist() == [1024, 2049]
    # Source: e-Manual, Present_Velocity: 0.229 rev/min = 15.63 ticks/s.
    assert VELOCITY_UNIT * 4096 / (2 * math.pi) == pytest.approx(15.633, abs=0.001)


@pytest.mark.parametrize("name", ARMS)
def test_openings_survive_the_way_there_and_back(name: str) -> None:
    gripper = load_arm(name).gripper
    for opening in np.linspace(*gripper.opening, 50):
        assert opening_from_angle(gripper, angle_from_opening(gripper, opening)) == pytest.approx(opening, abs=1e-9)


def test_crank_by_hand() -> None:
    """Horn 14, link 24: at right angles to the jaws' way the jaw is sqrt(24^2 - 14^2) = 19.494 from the centre."""
    gripper = replace(load_arm("reactorx_150").gripper, parameters=(14.0, 24.0, 0.0))
    assert opening_from_angle(gripper, 0.0) == pytest.approx(2 * 19.4936, abs=1e-3)
    assert opening_from_angle(gripper, math.pi / 2) == pytest.approx(76.0)
    assert opening_from_angle(gripper, -math.pi / 2) == pytest.approx(20.0)
    inset = replace(gripper, parameters=(14.0, 24.0, 2.0))
    assert opening_from_angle(inset, 0.3) == pytest.approx(opening_from_angle(gripper, 0.3) - 4.0)
    # Beyond the dead points there is no angle; the nearest is taken.
    assert angle_from_opening(gripper, 500.0) == pytest.approx(math.pi / 2)
    assert angle_from_opening(gripper, 0.0) == pytest.approx(-math.pi / 2)


def test_rack_in_both_directions() -> None:
    gripper = replace(load_arm("reactorx_150").gripper, mechanism="rack", parameters=(-20.0, 50.0))
    assert opening_from_angle(gripper, 0.5) == pytest.approx(40.0)
    assert angle_from_opening(gripper, 40.0) == pytest.approx(0.5)
    assert opening_sign(gripper) == -1
    assert opening_sign(replace(gripper, parameters=(20.0, 50.0))) == 1


@pytest.mark.parametrize("name", ARMS)
def test_opening_sign_is_the_slope(name: str) -> None:
    gripper = load_arm(name).gripper
    middle = angle_from_opening(gripper, sum(gripper.opening) / 2)
    slope = opening_from_angle(gripper, middle + 0.01) - opening_from_angle(gripper, middle)
    assert math.copysign(1, slope) == opening_sign(gripper)

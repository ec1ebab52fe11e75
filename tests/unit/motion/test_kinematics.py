from __future__ import annotations

import gc
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.config.arm import load_arm
from controller.domain import ArmDescription
from controller.errors import Unreachable
from controller.motion import kinematics
from controller.motion.by_arm import KEPT
from tests.unit.motion.scene import ARMS, RX150

unit = st.floats(0.0, 1.0)


def posture(arm: ArmDescription, shares: list[float]) -> np.ndarray:
    c = kinematics.chain(arm)
    return c.low + np.array(shares[: c.joints]) * (c.high - c.low)


@pytest.mark.parametrize("name", ARMS)
@given(shares=st.lists(unit, min_size=5, max_size=5))
@settings(max_examples=150, deadline=None)
def test_every_solution_leads_back_to_the_pose(name: str, shares: list[float]) -> None:
    arm = load_arm(name)
    q = posture(arm, shares)
    tool = kinematics.forward(arm, q)
    place = tool[:3, 3]
    azimuth = math.atan2(place[1], place[0] - kinematics.chain(arm).axis[0])
    # The pitch and roll seen from the point's own azimuth.
    local = np.array([[math.cos(azimuth), math.sin(azimuth), 0], [-math.sin(azimuth), math.cos(azimuth), 0], [0, 0, 1]])
    pitch = math.atan2(-tool[2, 0], float(local[0] @ tool[:3, 0]))
    level = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    turn = level.T @ local @ tool[:3, :3]
    roll = math.atan2(turn[2, 1], turn[1, 1])
    solved = list(kinematics.solutions(arm, place, pitch, roll, within=False))
    for _, found in solved:
        again = kinematics.forward(arm, np.array(found))
        assert np.abs(again[:3, 3] - place).max() < 1e-6
        assert np.abs(again[:3, 0] - tool[:3, 0]).max() < 1e-9
        if len(arm.joints) == 5:
            assert np.abs(again[:3, 1] - tool[:3, 1]).max() < 1e-9
    if math.hypot(place[0] - kinematics.chain(arm).axis[0], place[1]) > 1.0:
        # Away from the waist axis, where the azimuth says nothing, the posture itself is among them. Near a
        # straight elbow the arc cosine loses half its digits.
        gaps = [np.abs((np.array(found) - q + math.pi) % (2 * math.pi) - math.pi).max() for _, found in solved]
        assert min(gaps) < 1e-6


@pytest.mark.parametrize("name", ARMS)
def test_one_pose_and_many_agree(name: str) -> None:
    arm = load_arm(name)
    rng = np.random.default_rng(1)
    places = rng.uniform([-300, -300, 0], [300, 300, 300], (200, 3))
    many, allowed = kinematics.branches(arm, places, 1.3, 0.4)
    for place, row, ok in zip(places, many, allowed, strict=True):
        single = {k: np.array(q) for k, q in kinematics.solutions(arm, place, 1.3, 0.4, within=False)}
        assert set(single) == set(np.flatnonzero(np.isfinite(row).all(axis=1)))
        for k, q in single.items():
            assert np.abs((q - row[k] + math.pi) % (2 * math.pi) - math.pi).max() < 1e-9
        within = {k for k, _ in kinematics.solutions(arm, place, 1.3, 0.4, within=True)}
        assert within == set(np.flatnonzero(ok))


def test_solutions_stay_within_the_limits() -> None:
    c = kinematics.chain(RX150)
    for q in kinematics.inverse(RX150, (200.0, 40.0, 30.0), roll=0.3):
        assert (q >= c.low).all()
        assert (q <= c.high).all()


def test_the_jaws_close_along_the_wanted_direction() -> None:
    for azimuth in np.radians([-50.0, -10.0, 0.0, 35.0]):
        for direction in np.radians([0.0, 30.0, 75.0, 120.0, 179.0]):
            for roll in kinematics.roll_for(RX150, azimuth, direction):
                q = kinematics.inverse(RX150, (200 * math.cos(azimuth), 200 * math.sin(azimuth), 20.0), roll=roll)[0]
                turn = (kinematics.closing_direction(q) - direction) % math.pi
                assert min(turn, math.pi - turn) < 1e-9


def test_four_joints_close_only_across_the_arm() -> None:
    arm = load_arm("open_manipulator_x")
    assert kinematics.roll_for(arm, 0.3, 0.3 + math.pi / 2) == (0.0,)
    assert kinematics.roll_for(arm, 0.3, 0.3 + math.pi / 2 + 0.1) == ()


def test_out_of_reach_says_so() -> None:
    with pytest.raises(Unreachable, match="too far"):
        kinematics.inverse(RX150, (500.0, 0.0, 20.0))
    with pytest.raises(Unreachable, match=r"straight behind the arm.* to one side"):
        kinematics.inverse(RX150, (-170.0, 0.0, 85.0))
    kinematics.inverse(RX150, (-170.0, 3.0, 85.0))
    with pytest.raises(Unreachable, match=r"needs \w+ at -?\d+\.\d\d deg, allowed"):
        kinematics.inverse(RX150, (100.0, 0.0, 100.0), pitch=0.5)


def test_home_matrix_of_the_maker() -> None:
    # Trossen's product-of-exponentials home of the RX-150: x 358.575, z 254.57 mm, pointing ahead.
    tool = kinematics.forward(RX150, np.zeros(5))
    assert tool[:3, 3] == pytest.approx([358.575, 0.0, 254.57], abs=1e-9)
    assert tool[:3, :3] == pytest.approx(np.eye(3))


def test_a_process_that_meets_ever_new_arms_forgets_the_old_ones() -> None:
    for _ in range(5 * KEPT):
        kinematics.chain(replace(RX150))
    assert kinematics.chain(RX150) is kinematics.chain(RX150)
    assert sum(isinstance(thing, kinematics.Chain) for thing in gc.get_objects()) <= KEPT

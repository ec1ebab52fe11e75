"""The figures by which the simulated cell is off."""

from __future__ import annotations

import math

import pytest

from controller.errors import ConfigError
from sim_backends.imperfections import draw


@pytest.mark.parametrize("level", ["ideal", "static", "dynamic"])
def test_the_same_seed_draws_the_same_cell(level: str) -> None:
    assert draw(level, 5) == draw(level, 5)


def test_another_seed_draws_another_cell() -> None:
    assert draw("static", 5) != draw("static", 6)


@pytest.mark.parametrize("seed", range(20))
def test_static_stays_within_what_it_promises(seed: int) -> None:
    drawn = draw("static", seed)
    assert all(abs(v) <= 20.0 for v in drawn.camera_shift)
    assert all(abs(v) <= math.radians(3.0) for v in drawn.camera_turn)
    assert -0.35 <= drawn.distortion[0] <= -0.1
    assert 0.15 <= drawn.shadow_depth <= 0.35
    assert 0.03 <= drawn.latency <= 0.12
    assert all(abs(v) <= math.radians(1.5) for v in drawn.joint_offsets)
    assert all(math.radians(0.1) <= v <= math.radians(0.3) for v in drawn.backlash)
    assert math.hypot(*drawn.sheet_shift) < 3.0
    assert drawn.noise == 0.0
    assert drawn.packet_loss == 0.0


def test_dynamic_is_static_with_noise_and_a_crowd() -> None:
    still, moving = draw("static", 3), draw("dynamic", 3)
    assert moving.camera_shift == still.camera_shift
    assert 2.0 <= moving.noise <= 6.0
    assert moving.packet_loss == 0.001
    assert (still.part_gap, moving.part_gap) == (12.0, 0.0)


def test_ideal_hangs_and_mounts_everything_as_drawn() -> None:
    drawn = draw("ideal", 1)
    assert not any((*drawn.camera_shift, *drawn.camera_turn, *drawn.joint_offsets, *drawn.backlash))
    assert set(drawn.link_scale) == {1.0}


def test_single_figures_can_be_replaced() -> None:
    assert draw("static", 1, {"noise": 3.0}).noise == 3.0
    assert draw("static", 1, {"noise": 3.0}).camera_shift == draw("static", 1).camera_shift


@pytest.mark.parametrize(("level", "overrides"), [("perfect", {}), ("static", {"noize": 1.0})])
def test_unknown_names_are_refused(level: str, overrides: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        draw(level, 0, overrides)

"""The map of what is left is kept where it helps, and the planner aims by it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from controller.calibration.arm import arm_from_json, by_ruler, named
from controller.calibration.error_map import LOOKS, fit_map
from controller.calibration.map_record import MapRecord
from controller.domain import Array, ErrorMap, Shape
from controller.errors import InputError
from controller.geometry import pose
from controller.motion.kinematics import points
from controller.motion.planner import Planner
from tests.unit.motion.scene import RX150, calibration, part

NOISE = 0.15
AT = ((10.0, 20.0), (-30.0, 5.5))


def places(random: np.random.Generator, count: int = LOOKS) -> Array:
    return random.uniform((-80.0, -180.0), (30.0, 180.0), (count, 2))


def bent(at: Array) -> Array:
    """A smooth error: a link too long, a base that leans, axes askew; up to 1 mm."""
    u, v = at[:, 0] / 100.0, at[:, 1] / 100.0
    return np.column_stack([0.4 + 0.3 * u - 0.1 * v * v, 0.2 * v - 0.15 * u * v])


def test_a_smooth_error_is_found_and_left_out_places_are_met() -> None:
    random = np.random.default_rng(1)
    at = places(random)
    found = fit_map(at, bent(at) + random.normal(0.0, NOISE, at.shape))
    assert found.map is not None
    assert found.with_mm < 0.6 * found.without_mm
    fresh = places(random, 200)
    left = bent(fresh) - [found.map.at((float(x), float(y))) for x, y in fresh]
    before, after = (float(np.linalg.norm(e, axis=1).mean()) for e in (bent(fresh), left))
    assert after < 0.35 * before
    # The stated figure is that of fresh places with the noise of a look in it.
    assert after < found.with_mm


def test_noise_alone_makes_no_map() -> None:
    kept = 0
    for seed in range(40):
        random = np.random.default_rng(seed)
        at = places(random)
        found = fit_map(at, random.normal(0.0, NOISE, at.shape))
        if found.map is not None:
            kept += 1
            # Where chance keeps one, it is flat: the ridge holds it well below the noise.
            assert max(abs(v) for v in (*found.map.x, *found.map.y)) < 2.0 * NOISE
    assert kept <= 4


def test_too_few_looks_make_no_map() -> None:
    at = places(np.random.default_rng(0), 6)
    assert fit_map(at, bent(at)).map is None


def test_beyond_the_looks_the_map_does_not_grow() -> None:
    steep = ErrorMap((0.0, 0.0), 100.0, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0), (0.0,) * 6)
    assert steep.at((100.0, 0.0)) == steep.at((400.0, 0.0)) == (1.0, 0.0)


def test_the_planner_sends_the_arm_where_the_map_says_it_comes_down_right() -> None:
    plain = calibration()
    shift = ErrorMap((0.0, 0.0), 200.0, (0.7, 0.0, 0.0, 0.0, 0.0, 0.0), (-0.4, 0.0, 0.0, 0.0, 0.0, 0.0))
    ends = []
    for cell in (plain, replace(plain, error_map=shift)):
        planner = Planner(RX150, cell, ())
        _, push, _ = planner.plan_touch(
            part(Shape.CIRCLE, 43.0, (20.0, 30.0)), (-20.0, 30.0), np.array([8.0, 0.0]), 0.0, np.array(RX150.ready)
        )
        ends.append(points(RX150, push.positions[0])[3])
    assert np.allclose(ends[1] - ends[0], [-0.7, 0.4, 0.0], atol=1e-6)


def test_a_map_survives_its_file_and_nonsense_is_refused() -> None:
    kept = ErrorMap((1.0, 2.0), 150.0, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6), (0.0, -0.1, 0.0, 0.0, 0.2, 0.0))
    ruler = by_ruler(pose(230.0, 0.0, 0.0), "camera-x", "table-x", "reactorx_150")
    for record in (None, MapRecord(None, AT, 0.2, 0.21), MapRecord(kept, AT, 0.3, 0.2)):
        made = named(replace(ruler, calibration_id="", error_map=record))
        again = arm_from_json(json.loads(json.dumps(made.to_json())), "arm.json")
        assert again.error_map == record
        assert again.calibration_id == made.calibration_id
    broken = made.to_json()
    broken["error_map"]["x"] = [0.0, 1.0]
    with pytest.raises(InputError, match="error_map"):
        arm_from_json(broken, "arm.json")

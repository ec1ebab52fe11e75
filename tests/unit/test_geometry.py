"""Poses, angles and the camera model undo themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.geometry import (
    CameraModel,
    PlaneMap,
    angle_difference,
    invert,
    pose,
    pose_from_rvec,
    rigidity_error,
    rvec_tvec,
    transform,
    wrap,
)

Vector = tuple[float, float, float]
# Turns below half a revolution: a Rodrigues vector beyond it names the same rotation by another vector.
turns = st.tuples(*(st.floats(-1.8, 1.8),) * 3)
shifts = st.tuples(*(st.floats(-2000.0, 2000.0),) * 3)
LENS = CameraModel(
    np.array([[1006.0, 0.0, 648.6], [0.0, 1004.5, 352.8], [0.0, 0.0, 1.0]]),
    np.array([-0.25, 0.06, 0.0006, -0.0004, 0.01]),
    (1280, 720),
)


@given(turns, shifts)
def test_a_pose_survives_its_vectors_and_its_inverse(turn: Vector, shift: Vector) -> None:
    T = pose_from_rvec(turn, shift)
    assert rigidity_error(T) < 1e-12
    rvec, tvec = rvec_tvec(T)
    assert np.allclose(rvec, turn, atol=1e-9)
    assert np.allclose(tvec, shift)
    assert np.allclose(invert(T) @ T, np.eye(4), atol=1e-9)
    points = np.array([[1.0, 2.0, 3.0], [-50.0, 7.0, 0.0]])
    # 2 m of shift at double precision.
    assert np.allclose(transform(invert(T), transform(T, points)), points, atol=1e-9)


@given(st.floats(-math.pi, math.pi), st.floats(-500, 500), st.floats(-500, 500))
def test_yaw_turns_x_towards_y(yaw: float, x: float, y: float) -> None:
    ahead = transform(pose(x, y, 1.0, yaw=yaw), [1.0, 0.0, 0.0])
    assert np.allclose(ahead, [x + math.cos(yaw), y + math.sin(yaw), 1.0])


def test_a_mirror_is_not_rigid() -> None:
    assert rigidity_error(np.diag([1.0, 1.0, -1.0, 1.0])) > 1.0
    for wrong in (2e154, math.nan, math.inf):
        assert rigidity_error(np.diag([wrong, 1.0, 1.0, 1.0])) == math.inf


@given(st.floats(-1e4, 1e4), st.floats(0.1, 10.0))
def test_wrap_keeps_the_angle_modulo_its_period(angle: float, period: float) -> None:
    wrapped = wrap(angle, period)
    assert 0.0 <= wrapped < period
    turns_ = (angle - wrapped) / period
    # 1e5 periods lose 1e5 times the precision of a double.
    assert abs(turns_ - round(turns_)) < 1e-9


@given(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.sampled_from([2 * math.pi, math.pi, math.pi / 3]))
def test_difference_is_the_short_way_round(a: float, b: float, period: float) -> None:
    difference = angle_difference(a, b, period)
    assert -period / 2 <= difference < period / 2
    gap = wrap(b + difference - a, period)
    assert min(gap, period - gap) < 1e-9


@pytest.mark.parametrize("angle", [-1e-18, -0.0, 0.0, 2 * math.pi, -2 * math.pi])
def test_wrap_never_returns_its_period(angle: float) -> None:
    assert wrap(angle) == 0.0


@given(st.floats(0.0, 1279.0), st.floats(0.0, 719.0), st.floats(100.0, 3000.0))
def test_a_ray_projects_back_onto_its_pixel(u: float, v: float, depth: float) -> None:
    ray = LENS.rays([[u, v]])
    assert ray[0, 2] == 1.0
    # The undistortion stops at 1e-10 in normalised coordinates: 1e-7 px; corners of the lens converge slowest.
    assert np.allclose(LENS.project(ray * depth), [[u, v]], atol=1e-4)


@given(
    st.floats(0.0, 0.5), st.floats(0.0, 6.3), st.floats(-150.0, 150.0), st.floats(-100.0, 100.0), st.floats(0.0, 60.0)
)
def test_plane_and_picture_are_one_to_one(tilt: float, towards: float, x: float, y: float, height: float) -> None:
    lean = pose_from_rvec([tilt * math.cos(towards), tilt * math.sin(towards), 0.0], [0.0, 0.0, 0.0])
    down = pose_from_rvec([math.pi, 0.0, 0.0], [0.0, 0.0, 0.0])
    plane = PlaneMap(LENS, pose(10.0, 20.0, 600.0, yaw=0.7) @ lean @ down).at(height)
    pixels = plane.to_pixels([[x, y]])
    # Inside the picture; outside it the lens model need not be invertible.
    if not ((pixels >= 0).all() and (pixels <= [1279, 719]).all()):
        return
    assert np.allclose(plane.to_plane(pixels), [[x, y]], atol=1e-4)


def test_a_ray_that_misses_the_plane_is_nan() -> None:
    level = PlaneMap(LENS, pose_from_rvec([-math.pi / 2, 0.0, 0.0], [0.0, 0.0, 100.0]))
    above, below = level.to_plane([[640.0, 10.0], [640.0, 710.0]])
    assert np.isnan(above).all()
    assert np.isfinite(below).all()

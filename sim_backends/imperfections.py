"""How far the simulated cell is from what the controller believes: every figure in one frozen value.

Three named levels draw the figures from a seed. The controller is told none of them: the camera hangs and
looks a little elsewhere, the joints are mounted askew, the printed sheet is laid by hand.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from controller.errors import ConfigError

LEVELS = ("ideal", "static", "dynamic")
_MOST_JOINTS = 8
Vector = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Imperfections:
    """The true cell minus the nominal one. Lengths mm, angles rad, times s unless said.

    Attributes:
        camera_shift: (3,) where the camera hangs against its nominal place, in `base`.
        camera_turn: (3,) Rodrigues vector of how it is turned against its nominal pose, in `camera`.
        focal_scale: True focal length over the nominal one.
        principal_shift: (2,) optical centre against the middle of the picture, fraction of the picture's width.
        distortion: (k1, k2, p1, p2) of OpenCV's lens model.
        light_gradient: Brightest minus darkest place of the evenly white table, fraction of the brightest.
        light_direction: Direction the light falls off, rad in the picture.
        lamp_azimuth, lamp_elevation: Where the lamp stands, rad.
        shadow_depth: Light missing in the core of a shadow, fraction.
        vignette: Light missing in the picture's corners, fraction.
        exposure: Gain of the whole picture.
        blur: Standard deviation of the defocus, px.
        noise: Standard deviation of the sensor's noise, levels of 255.
        latency: Between the end of an exposure and the delivery of its frame.
        sheet_shift, sheet_turn: How the calibration sheet is laid against its mark.
        hand_shift, hand_turn: Standard deviations of where hands hold a board against where they were asked to.
        marker_shift, marker_turn: (3,) each: how the marker plate is mounted against its drawing, in `tool`.
        size_tolerance: Parts differ from their nominal size by up to this.
        mass_tolerance: Parts differ from their nominal density by up to this fraction.
        friction: (lowest, highest) coefficient of a part against anything.
        part_gap: Parts are scattered at least this far from one another.
        joint_offsets: Encoder minus joint angle, base to tool.
        backlash: Full play between encoder and link of each joint, base to tool.
        link_scale: True mass of each link over the described one.
        packet_loss: Fraction of the servos' answers lost on the bus.
        jaw_shift: (y, z) of the middle of the jaws against the drawing, in `tool`.
    """

    camera_shift: Vector = (0.0, 0.0, 0.0)
    camera_turn: Vector = (0.0, 0.0, 0.0)
    focal_scale: float = 1.0
    principal_shift: Vector = (0.0, 0.0)
    distortion: Vector = (-0.1, 0.02, 0.0, 0.0)
    light_gradient: float = 0.0
    light_direction: float = 0.0
    lamp_azimuth: float = 0.7
    lamp_elevation: float = 1.05
    shadow_depth: float = 0.15
    vignette: float = 0.0
    exposure: float = 1.0
    blur: float = 0.5
    noise: float = 0.0
    latency: float = 0.03
    sheet_shift: Vector = (0.0, 0.0)
    sheet_turn: float = 0.0
    hand_shift: float = 2.0
    hand_turn: float = math.radians(1.5)
    marker_shift: Vector = (0.0, 0.0, 0.0)
    marker_turn: Vector = (0.0, 0.0, 0.0)
    size_tolerance: float = 0.0
    mass_tolerance: float = 0.0
    friction: Vector = (0.5, 0.5)
    part_gap: float = 12.0
    joint_offsets: Vector = (0.0,) * _MOST_JOINTS
    backlash: Vector = (0.0,) * _MOST_JOINTS
    link_scale: Vector = (1.0,) * _MOST_JOINTS
    packet_loss: float = 0.0
    jaw_shift: Vector = (0.0, 0.0)


def draw(level: str, seed: int, overrides: Mapping[str, float | Vector] | None = None) -> Imperfections:
    """The imperfections of one cell, the same for the same seed.

    Args:
        level: `ideal`, `static` or `dynamic`.
        seed: Which cell of that level.
        overrides: Single figures that replace the drawn ones, by field name.

    Raises:
        ConfigError: Unknown level or field.
    """
    if level not in LEVELS:
        raise ConfigError(f"unknown level {level!r}", f"use one of {', '.join(LEVELS)}")
    drawn = Imperfections() if level == "ideal" else _draw_static(np.random.default_rng([seed, 1]))
    if level == "dynamic":
        random = np.random.default_rng([seed, 2])
        drawn = replace(drawn, noise=float(random.uniform(2.0, 6.0)), packet_loss=0.001, part_gap=0.0)
    known = {field.name for field in fields(Imperfections)}
    for name in overrides or {}:
        if name not in known:
            raise ConfigError(f"unknown imperfection {name!r}", f"use one of {', '.join(sorted(known))}")
    return replace(drawn, **overrides) if overrides else drawn  # type: ignore[arg-type]  # checked by name above


def _draw_static(random: np.random.Generator) -> Imperfections:
    def spread(half: float, count: int) -> Vector:
        return tuple(float(v) for v in random.uniform(-half, half, count))

    k1 = float(random.uniform(-0.35, -0.1))
    return Imperfections(
        camera_shift=spread(20.0, 3),
        camera_turn=spread(math.radians(3.0), 3),
        focal_scale=1.0 + spread(0.02, 1)[0],
        principal_shift=spread(0.008, 2),
        # A lens with k2 about -k1/4 keeps its radial curve monotone out to the corners.
        distortion=(k1, -0.24 * k1, *spread(0.0006, 2)),
        light_gradient=float(random.uniform(0.05, 0.3)),
        light_direction=float(random.uniform(-math.pi, math.pi)),
        lamp_azimuth=float(random.uniform(-math.pi, math.pi)),
        lamp_elevation=math.radians(float(random.uniform(50.0, 75.0))),
        shadow_depth=float(random.uniform(0.15, 0.35)),
        vignette=float(random.uniform(0.0, 0.15)),
        exposure=float(random.uniform(0.9, 1.08)),
        blur=float(random.uniform(0.4, 0.8)),
        latency=float(random.uniform(0.03, 0.12)),
        sheet_shift=spread(2.0, 2),
        sheet_turn=math.radians(spread(0.5, 1)[0]),
        hand_shift=4.0,
        hand_turn=math.radians(3.0),
        marker_shift=spread(2.0, 3),
        marker_turn=spread(math.radians(2.0), 3),
        size_tolerance=0.3,
        mass_tolerance=0.1,
        friction=(0.3, 0.8),
        joint_offsets=spread(math.radians(1.5), _MOST_JOINTS),
        backlash=tuple(float(v) for v in np.radians(random.uniform(0.1, 0.3, _MOST_JOINTS))),
        link_scale=tuple(1.0 + v for v in spread(0.1, _MOST_JOINTS)),
        jaw_shift=spread(1.0, 2),
    )

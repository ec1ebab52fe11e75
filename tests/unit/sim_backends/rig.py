"""A ReactorX-150 moved by ideal shafts, without a bus: enough to pick a part in the simulated world."""

from __future__ import annotations

import math

import numpy as np

from controller.config.arm import load_arm
from controller.domain import Bin, Shape
from sim_backends.imperfections import Imperfections, draw
from sim_backends.mechanics import servo_angle
from sim_backends.parts import Part, area, outline
from sim_backends.plant import Drive
from sim_backends.solids import Array
from sim_backends.world import World

ARM = load_arm("reactorx_150")
HEIGHTS = {Shape.SQUARE: 20.0, Shape.RECTANGLE: 22.0, Shape.CIRCLE: 24.0, Shape.HEXAGON: 26.0, Shape.TRIANGLE: 28.0}
TABLE = np.array([[1.0, 0.0, 0.0, 230.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
BINS = tuple(
    Bin(f"bin{degrees}", (230.0 * math.cos(a) - 230.0, 230.0 * math.sin(a)), (90.0, 90.0), 35.0, 20)
    for degrees in (80, 110, 140, -80, -110, -140)
    for a in [math.radians(degrees)]
)
# A gripper servo held back to 250 of 885 PWM units of its 1.5 Nm.
GRIP_TORQUE = 1.5 * 250 / 885
GRASP_HEIGHT = 17.0  # the tips of the jaws 2 mm above the table


def part(shape: Shape, x: float, y: float, yaw: float = 0.0, *, grip: float = 40.0, friction: float = 0.5) -> Part:
    """A part of the usual height and density."""
    mass = 0.45e-6 * area(outline(shape, grip)) * HEIGHTS[shape]
    return Part(shape, "red", grip, HEIGHTS[shape], mass, friction, x, y, yaw)


def world(*parts: Part, imperfections: Imperfections | None = None) -> World:
    """A world without imperfections."""
    return World(ARM, BINS, TABLE, parts, imperfections or draw("ideal", 0))


def down(x: float, y: float, z: float, closing: float) -> Array:
    """Joint angles that point straight down at (x, y, z) of `base`, jaws closing along direction `closing`."""
    upper, tilt, fore = math.hypot(50.0, 150.0), math.atan2(-150.0, 50.0), 150.0
    out, up = math.hypot(x, y), z + 93.575 + 65.0 - 65.66 - 38.91
    bend = math.acos((out**2 + up**2 - upper**2 - fore**2) / (2.0 * upper * fore))
    first = math.atan2(-up, out) - math.atan2(fore * math.sin(bend), upper + fore * math.cos(bend))
    shoulder, elbow = first - tilt, bend + tilt
    azimuth = math.atan2(y, x)
    roll = math.remainder(azimuth + math.pi / 2.0 - closing, math.pi)
    return np.array([azimuth, shoulder, elbow, math.pi / 2.0 - shoulder - elbow, roll])


class Rig:
    """Stiff shafts that follow smooth moves.

    Args:
        world: What they turn.
        stiffness: Nm/rad; far above a servo's, so that nothing sags.
    """

    def __init__(self, world_: World, stiffness: float = 400.0) -> None:
        self.world = world_
        self._stiffness = stiffness
        self.angles = np.array(ARM.rest)
        self.move(self.angles, 0.1)

    def send(self, angles: Array) -> None:
        for joint, angle in zip(ARM.joints, angles, strict=True):
            target = -angle if joint.reverse else angle
            self.world.drive(joint.servo_id, Drive(float(target), self._stiffness, 8.0, 0.0, 40.0))

    def move(self, angles: Array, seconds: float) -> None:
        """Go there along a straight joint line, at rest at both ends."""
        start, steps = self.angles, max(1, round(seconds / 0.01))
        for k in range(1, steps + 1):
            u = k / steps
            self.send(start + (angles - start) * u**3 * (10.0 - 15.0 * u + 6.0 * u * u))
            self.world.advance(0.01)
        self.angles = angles

    def to(self, x: float, y: float, z: float, closing: float, seconds: float = 0.7) -> None:
        """Point down at a place."""
        self.move(down(x, y, z, closing), seconds)

    def grip(self, opening: float, torque: float = GRIP_TORQUE, seconds: float = 0.5) -> None:
        """Turn the gripper's servo towards a clear opening, mm."""
        target = servo_angle(ARM.gripper, opening)
        self.world.drive(ARM.gripper.servo_id, Drive(target, 5.5, 0.235, 0.0, torque))
        self.world.advance(seconds)

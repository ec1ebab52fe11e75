"""A numerical arm with mounting errors and play, and what a camera sees of its marker.

Its kinematics are plain matrix products along the description, written without the core's closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from controller.calibration.marker import ArmMarker
from controller.domain import ArmDescription
from controller.geometry import CameraModel, invert, pose

Array = NDArray[np.float64]


def chain_forward(arm: ArmDescription, q: Array) -> Array:
    """T_base_tool (4, 4) of true joint angles (J,)."""
    out = np.eye(4)
    for joint, angle in zip(arm.joints, q, strict=True):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_euler(joint.axis, angle).as_matrix()
        step[:3, 3] = joint.offset
        out = out @ step
    tool = np.eye(4)
    tool[:3, 3] = arm.tool
    return out @ tool


def small(random: np.random.Generator, mm: float, degrees: float) -> Array:
    """A small random pose."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(np.deg2rad(random.uniform(-degrees, degrees, 3))).as_matrix()
    out[:3, 3] = random.uniform(-mm, mm, 3)
    return out


@dataclass
class Metal:
    """One arm as it was really put together.

    Attributes:
        arm: Its description.
        camera: The true lens.
        T_table_camera: Where the camera truly is.
        nominal: T_base_table by ruler.
        seed: Of everything that is off.
        play: Full play of every joint, rad.
    """

    arm: ArmDescription
    camera: CameraModel
    T_table_camera: Array
    nominal: Array = field(default_factory=lambda: pose(230.0, 0.0, 0.0))
    seed: int = 0
    play: float = math.radians(0.3)
    pixel: float = 0.1

    def __post_init__(self) -> None:
        self.random = np.random.default_rng(self.seed)
        self.offsets = np.deg2rad(self.random.uniform(-1.5, 1.5, len(self.arm.joints)))
        self.T_base_table = self.nominal @ small(self.random, 2.0, 0.6)
        self.marker = ArmMarker()
        self.T_tool_marker = self.marker.T_tool_marker @ small(self.random, 2.0, 2.0)

    def tool(self, encoders: Array) -> Array:
        """T_table_tool of encoder angles, play drawn anew."""
        slack = self.random.uniform(-self.play / 2, self.play / 2, len(encoders))
        return invert(self.T_base_table) @ chain_forward(self.arm, encoders - self.offsets + slack)

    def corners(self, encoders: Array) -> Array:
        """Where the camera sees the marker's corners (4, 2), px."""
        T = invert(self.T_table_camera) @ self.tool(encoders) @ self.T_tool_marker
        points = self.marker.corners @ T[:3, :3].T + T[:3, 3]
        return self.camera.project(points) + self.random.normal(0.0, self.pixel, (4, 2))

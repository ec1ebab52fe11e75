"""A numerical arm with mounting errors and play, and what a camera sees of its marker.

Its kinematics are plain matrix products along the description, written without the core's closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from controller.calibration.arm_touch import Touch
from controller.calibration.marker import ArmMarker
from controller.domain import ArmDescription, ArmState, Frame
from controller.geometry import CameraModel, invert, pose
from tests.unit.calibration.scene import paint

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
        pixel: Noise of a corner, px per axis.
        jaws: (y, z) of the middle of the jaws beside the drawing, in `tool`, mm.
    """

    arm: ArmDescription
    camera: CameraModel
    T_table_camera: Array
    nominal: Array = field(default_factory=lambda: pose(230.0, 0.0, 0.0))
    seed: int = 0
    play: float = math.radians(0.3)
    pixel: float = 0.1
    jaws: tuple[float, float] = (0.0, 0.0)

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

    def grasp_point(self, encoders: Array) -> Array:
        """The middle of the jaws (3,) in `table`, mm."""
        return np.asarray((self.tool(encoders) @ [0.0, *self.jaws, 1.0])[:3])

    def corners(self, encoders: Array) -> Array:
        """Where the camera sees the marker's corners (4, 2), px."""
        T = invert(self.T_table_camera) @ self.tool(encoders) @ self.T_tool_marker
        points = self.marker.corners @ T[:3, :3].T + T[:3, 3]
        return self.camera.project(points) + self.random.normal(0.0, self.pixel, (4, 2))

    def push(self, encoders: Array, side: float, radius: float, height: float) -> Touch:
        """Where a disc on the table lies once the closed jaws have pushed it, and what a camera says of it.

        At every height the disc is stopped by the two inner edges of the jaws' faces; the foremost height counts.
        """
        T = self.tool(encoders)
        T[:3, 3] += T[:3, :3] @ [0.0, *self.jaws]
        half, face = self.arm.gripper.opening[0] / 2.0, side * self.arm.gripper.jaw_size[1] / 2.0
        ahead = side * T[:2, 2] / np.linalg.norm(T[:2, 2])
        rests = []
        for x in np.linspace(-30.0, self.arm.gripper.jaw_depth, 200):
            left, right = (T @ [x, y, face, 1.0] for y in (half, -half))
            if left[2] <= height:
                half_gap = np.linalg.norm(left[:2] - right[:2]) / 2.0
                rests.append((left[:2] + right[:2]) / 2.0 + ahead * math.sqrt(radius**2 - half_gap**2))
        center = max(rests, key=lambda place: float(place @ ahead)) + self.random.normal(0.0, 0.1, 2)
        return Touch(encoders, (float(center[0]), float(center[1])), height, radius, side)


class Cell:
    """An arm, a camera and a clock: the marker is painted where the true arm carries it."""

    def __init__(self, m: Metal) -> None:
        self.description = m.arm
        self.m, self.q, self.time, self.frames = m, np.asarray(m.arm.ready), 0.0, 0
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        marker = cv2.aruco.generateImageMarker(dictionary, 0, 240)
        self.print = np.asarray(np.pad(marker, 40, constant_values=255), np.uint8)

    def state(self) -> ArmState:
        return ArmState(self.time, self.q, np.zeros(5), 40.0, 0.0)

    def move_to(self, q: Array) -> None:
        self.q = q

    def now(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        self.frames += 1
        # The print's y runs down and its z away from the reader; the marker's the other way.
        over = np.diag([1.0, -1.0, -1.0, 1.0])
        T = invert(self.m.T_table_camera) @ self.m.tool(self.q) @ self.m.T_tool_marker @ over
        gray = paint(self.print, 0.125, T, self.m.camera, samples=3)
        return Frame(self.frames, after, np.repeat(gray[..., None], 3, axis=2))

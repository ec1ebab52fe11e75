"""Where a camera sees the marker on the gripper, given the base, the joint offsets and the mount.

Waist offset and base yaw turn the arm alike, and so do the last joint's offset and the marker's mount: both offsets
are fixed at zero and their share goes to the other. Of a wrist roll that is no loss: it turns the tool about its own
axis. Of an arm without one it moves the tip, and touches tell it from the mount. Touches also tell where the jaws are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from controller.calibration.marker import ArmMarker
from controller.domain import ArmDescription, Point
from controller.geometry import CameraModel, invert
from controller.motion.kinematics import forward

Array = NDArray[np.float64]

#: What is assumed of the unknowns before anything was seen, as standard deviations: the base by ruler and
#: eye, the marker by its drawing, the joints by the splines of their horns.
PRIOR_BASE = (np.deg2rad(3.0),) * 3 + (10.0,) * 3
PRIOR_MOUNT = (np.deg2rad(4.0),) * 3 + (5.0,) * 3
PRIOR_OFFSET = float(np.deg2rad(2.0))
#: Of the middle of the jaws beside its drawing, mm per axis.
PRIOR_JAWS = 1.0
#: Of a marker's corner in the picture, px per axis.
PIXEL_SIGMA = 0.2
#: Of a joint within its play: 0.3 degrees, evenly spread, rad.
JOINT_SIGMA = float(np.deg2rad(0.3) / np.sqrt(12.0))


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """One guess at everything that is fitted.

    Attributes:
        T_table_base: ndarray of shape (4, 4).
        T_tool_marker: ndarray of shape (4, 4).
        offsets: ndarray of shape (J,), rad: encoder minus joint.
        jaws: (y, z) of the middle of the jaws beside its place in the drawing, in `tool`, mm.
    """

    T_table_base: Array
    T_tool_marker: Array
    offsets: Array
    jaws: Point = (0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerView:
    """The model of one cell's camera, arm and marker around a first guess.

    Attributes:
        arm: As described.
        marker: As drawn.
        camera: The lens.
        T_table_camera, T_base_table: ndarray of shape (4, 4): the camera as calibrated, the base by ruler.
        touched: The tip touches things that the camera sees.
    """

    arm: ArmDescription
    marker: ArmMarker
    camera: CameraModel
    T_table_camera: Array
    T_base_table: Array
    touched: bool = False

    @property
    def free_joints(self) -> tuple[int, ...]:
        """Joints whose offset can be told: all but the first and the last; a touching wrist's as well."""
        last = len(self.arm.joints) - (0 if self.touched and not has_roll(self.arm) else 1)
        return tuple(range(1, last))

    @property
    def free_jaws(self) -> tuple[str, ...]:
        """Directions of `tool` the jaws may be off in: a wrist's offset moves them along z already."""
        return () if not self.touched else ("y", "z") if has_roll(self.arm) else ("y",)

    @property
    def prior(self) -> Array:
        """Standard deviations (P,) of the parameters: base 6, mount 6, then the free offsets and the jaws."""
        free = (PRIOR_OFFSET,) * len(self.free_joints) + (PRIOR_JAWS,) * len(self.free_jaws)
        return np.array([*PRIOR_BASE, *PRIOR_MOUNT, *free])

    def unknowns(self, parameters: Array) -> Unknowns:
        """Parameters (P,), small turns and shifts from the first guess, as poses and angles."""
        offsets = np.zeros(len(self.arm.joints))
        jaws = 12 + len(self.free_joints)
        offsets[list(self.free_joints)] = parameters[12:jaws]
        y, z = (*parameters[jaws:], 0.0, 0.0)[:2]
        return Unknowns(
            invert(self.T_base_table) @ _small(parameters[:6]),
            self.marker.T_tool_marker @ _small(parameters[6:12]),
            offsets,
            (float(y), float(z)),
        )

    def in_camera(self, unknowns: Unknowns, encoders: Array) -> Array:
        """Corners (N, 4, 3) in `camera`, mm, for encoder angles (N, J)."""
        chain = forward(self.arm, encoders - unknowns.offsets) @ unknowns.T_tool_marker
        chain = invert(self.T_table_camera) @ unknowns.T_table_base @ chain
        return np.asarray(np.einsum("nij,kj->nki", chain[:, :3, :3], self.marker.corners) + chain[:, None, :3, 3])

    def tools(self, unknowns: Unknowns, encoders: Array) -> Array:
        """Grasp points (N, 3) in `table`, mm, for encoder angles (N, J)."""
        chain = unknowns.T_table_base @ forward(self.arm, encoders - unknowns.offsets)
        return np.asarray((chain @ [0.0, *unknowns.jaws, 1.0])[:, :3])

    def predict(self, parameters: Array, encoders: Array) -> Array:
        """Corners (N, 8) in the picture, px, x and y in turn."""
        points = self.in_camera(self.unknowns(parameters), encoders)
        return self.camera.project(points.reshape(-1, 3)).reshape(len(encoders), 8)

    def jacobian(self, parameters: Array, encoders: Array) -> Array:
        """Derivative (N, 8, P) of `predict` by the parameters, central differences."""
        out = np.empty((len(encoders), 8, len(parameters)))
        for index, step in enumerate(1e-4 * self.prior):
            ahead, back = parameters.copy(), parameters.copy()
            ahead[index] += step
            back[index] -= step
            out[:, :, index] = (self.predict(ahead, encoders) - self.predict(back, encoders)) / (2 * step)
        return out

    def whitener(self, parameters: Array, encoders: Array) -> Array:
        """Inverse Cholesky factors (N, 8, 8): what a pose's corners are worth.

        Play in the joints moves all four corners together and by more than the pixel noise, so that a
        stretched arm counts less than a folded one.
        """
        step = 1e-5
        count, joints = encoders.shape
        by_joint = np.empty((count, 8, joints))
        for joint in range(joints):
            turn = np.zeros(joints)
            turn[joint] = step
            ahead, back = self.predict(parameters, encoders + turn), self.predict(parameters, encoders - turn)
            by_joint[:, :, joint] = (ahead - back) / (2 * step)
        covariance = PIXEL_SIGMA**2 * np.eye(8) + JOINT_SIGMA**2 * by_joint @ by_joint.transpose(0, 2, 1)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def has_roll(arm: ArmDescription) -> bool:
    """Whether the last joint turns the tool about its own axis."""
    return arm.joints[-1].axis == "x"


def _small(parameters: Array) -> Array:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(parameters[:3]).as_matrix()
    out[:3, 3] = parameters[3:]
    return out

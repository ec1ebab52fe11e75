"""What the arm hides from the camera: the cell may look at the table as soon as nothing of it is covered."""

from __future__ import annotations

import cv2
import numpy as np

from controller.domain import ArmDescription, Array
from controller.motion.kinematics import points

# Half width of the body around the lines shoulder-elbow-wrist and wrist-grasp point; the gripper's finger rail
# is the widest part of these arms.
_LIMB = 35.0
_HAND = 65.0


def discs(arm: ArmDescription, q: Array, eye: Array) -> Array:
    """What the arm hides of the table from the camera: discs (N, 3), x, y and radius on z = 0 of `base`, mm.

    They are the shadows of balls along the arm, cast from the eye, to second order. One that reaches as high as the
    camera hides everything: its radius is infinite.

    Args:
        arm: The arm.
        q: ndarray of shape (J,), rad.
        eye: (x, y, z) of the camera in `base`, mm.
    """
    body = points(arm, q)
    share = np.linspace(0.0, 1.0, 9)[:, None]
    balls = np.concatenate([body[k] + (body[k + 1] - body[k]) * share for k in range(3)])
    radii = np.repeat([_LIMB, _LIMB, _HAND], len(share))
    below = np.maximum(eye[2] - balls[:, 2], 1e-9)
    aside = balls[:, :2] - eye[:2]
    scale = eye[2] / below
    reach = radii * scale * np.sqrt(1.0 + (aside**2).sum(axis=1) / below**2)
    reach[balls[:, 2] + radii >= eye[2]] = np.inf
    return np.column_stack([eye[:2] + aside * scale[:, None], reach])


def hides(arm: ArmDescription, q: Array, eye: Array, area: Array) -> bool:
    """Whether the arm stands between the camera and any part of an area of the table.

    Args:
        arm: The arm.
        q: ndarray of shape (J,), rad.
        eye: (x, y, z) of the camera in `base`, mm.
        area: ndarray of shape (N, 2): outline on the plane z = 0 of `base`, mm.
    """
    outline = np.ascontiguousarray(area, np.float32)
    return any(
        cv2.pointPolygonTest(outline, (float(x), float(y)), True) > -reach for x, y, reach in discs(arm, q, eye)
    )

"""What the arm hides from the camera: the cell may look at the table as soon as nothing of it is covered."""

from __future__ import annotations

import math

import cv2
import numpy as np

from controller.domain import ArmDescription, Array
from controller.motion.kinematics import points

# Half width of the body around the lines shoulder-elbow-wrist and wrist-grasp point; the gripper's finger rail
# is the widest part of these arms.
_LIMB = 35.0
_HAND = 65.0


def hides(arm: ArmDescription, q: Array, eye: Array, area: Array) -> bool:
    """Whether the arm stands between the camera and any part of an area of the table.

    Args:
        arm: The arm.
        q: ndarray of shape (J,), rad.
        eye: (x, y, z) of the camera in `base`, mm.
        area: ndarray of shape (N, 2): outline on the plane z = 0 of `base`, mm.
    """
    body = points(arm, q)
    share = np.linspace(0.0, 1.0, 9)[:, None]
    limbs = [body[k] + (body[k + 1] - body[k]) * share for k in range(3)]
    balls = np.concatenate(limbs)
    radii = np.repeat([_LIMB, _LIMB, _HAND], len(share))
    outline = np.ascontiguousarray(area, np.float32)
    for ball, radius in zip(balls, radii, strict=True):
        if ball[2] + radius >= eye[2]:
            return True
        # The shadow of a ball cast from the eye, as the disc it is to second order.
        scale = eye[2] / (eye[2] - ball[2])
        centre = eye[:2] + (ball[:2] - eye[:2]) * scale
        slant = math.hypot(*(ball[:2] - eye[:2])) / (eye[2] - ball[2])
        reach = radius * scale * math.sqrt(1.0 + slant * slant)
        if cv2.pointPolygonTest(outline, (float(centre[0]), float(centre[1])), True) > -reach:
            return True
    return False

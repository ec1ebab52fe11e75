"""The localizer of the paper: one pinhole, looking straight down, without a lens and without heights.

It is kept beside ours so that what a calibrated lens, a measured pose and a known height are worth can be seen on
the same pictures. Source: the paper, section V, equations (2) to (6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from controller.domain import Array


@dataclass(frozen=True, slots=True)
class PaperModel:
    """The paper's camera, and its left-handed frame on the platform.

    The frame lies at the platform's upper right corner as the picture shows it, X to the right, Y up, Z into the
    table: left-handed, so that all of the paper's objects have negative coordinates. Its equations have the
    picture's x run against X and its y against Y; for this frame the first asks for a negative conversion factor.

    Attributes:
        focal_px: (f D_u, f D_v): focal length times the conversion factors, which only occur together, px.
        center_px: (u_0, v_0): the middle of the picture, taken for the optical centre.
        depth: z_i: distance of the objects from the camera along its axis, by ruler, mm.
        offset: (X_0, Y_0): minus the point of the platform that the axis meets, by ruler, mm.
    """

    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    depth: float
    offset: tuple[float, float]

    def world(self, pixels: ArrayLike) -> Array:
        """(X_w, Y_w) (N, 2) of centroids (N, 2) in the picture, mm. Source: equations (5) and (6)."""
        off = np.asarray(pixels, np.float64).reshape(-1, 2) - self.center_px
        return np.asarray(-(self.depth * off / np.array(self.focal_px)) - np.array(self.offset))

    def pixels(self, world: ArrayLike) -> Array:
        """Pixels (N, 2) of points (N, 2) of the platform, mm.

        Source: equations (2) to (4) with R = diag(-1, -1, 1) and the offset counted as (5) and (6) count it.
        """
        in_camera = -(np.asarray(world, np.float64).reshape(-1, 2) + np.array(self.offset))
        return np.asarray(in_camera / self.depth * np.array(self.focal_px) + self.center_px)

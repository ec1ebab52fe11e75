"""The camera as data sheet and ruler have it, before anything was measured."""

from __future__ import annotations

import math

import numpy as np

from controller.config.cell import CellConfig
from controller.domain import Array
from controller.geometry import CameraModel


def nominal_camera(config: CellConfig) -> tuple[CameraModel, Array]:
    """Lens and pose by data sheet and ruler: looking straight down, the picture's long side along the table's y
    axis (its left edge towards +y). Good to some centimetres only.

    Returns:
        The lens; `T_table_camera`, shape (4, 4), mm.
    """
    width, height = config.camera.width, config.camera.height
    focal = width / 2 / math.tan(math.radians(config.camera.field_of_view_deg) / 2)
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    looking_down = np.array([[0.0, -1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    looking_down[:3, 3] = *config.camera.above_mm, config.camera.height_mm
    return CameraModel(matrix, np.zeros(5), (width, height)), looking_down

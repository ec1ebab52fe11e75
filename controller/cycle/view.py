"""Where in the picture parts may lie: the work area as the camera sees it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.config.cell import CellConfig
from controller.domain import CellCalibration

MARGIN_MM = 40.0
"""A part centred on the border of the work area reaches this far beyond it; neighbours there matter for finger room."""


def region_mask(config: CellConfig, calibration: CellCalibration, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Mask (H, W), 255 where the work area and its margin lie on the table, for frames of `size` (width, height)."""
    outline = config.work_area_outline(calibration.T_base_table, MARGIN_MM)
    pixels = calibration.plane(0.0).to_pixels(outline)
    mask = np.zeros((size[1], size[0]), np.uint8)
    cv2.fillPoly(mask, [np.rint(pixels).astype(np.int32)], (255,))
    return mask

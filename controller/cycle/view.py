"""Where in the picture parts may lie, and where nothing changes: the work area as the camera sees it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.config.cell import CellConfig
from controller.domain import Array, CellCalibration
from controller.geometry import invert, transform

MARGIN_MM = 40.0
"""A part centred on the border of the work area reaches this far beyond it; neighbours there matter for finger room."""

_REACH_MM = 80.0
"""Parts on the border of the work area, their shadows and the jaws above them change the picture this far outside."""
_WALL_MM = 15.0
"""A bin is looked at with so much of the table around it: the outer edges of its walls are the best to hold on to."""


def region_mask(config: CellConfig, calibration: CellCalibration, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Mask (H, W), 255 where the work area and its margin lie on the table, for frames of `size` (width, height)."""
    outline = config.work_area_outline(calibration.T_base_table, MARGIN_MM)
    pixels = calibration.plane(0.0).to_pixels(outline)
    mask = np.zeros((size[1], size[0]), np.uint8)
    cv2.fillPoly(mask, [np.rint(pixels).astype(np.int32)], (255,))
    return mask


def still_mask(config: CellConfig, calibration: CellCalibration, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Mask (H, W), 255 where nothing is supposed to change from look to look, for frames of `size` (width, height).

    That is the table outside the work area and its surroundings, and the bins: not what lies in them, and not the
    arm's foot.
    """
    mask = np.full((size[1], size[0]), 255, np.uint8)

    def fill(outline: Array, height: float, value: int) -> None:
        pixels = calibration.plane(height).to_pixels(outline)
        cv2.fillPoly(mask, [np.rint(pixels).astype(np.int32)], (value,))

    T, corners = calibration.T_base_table, np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
    fill(config.work_area_outline(T, _REACH_MM), 0.0, 0)
    for bin_ in config.bin_values():
        for height in (0.0, bin_.height):
            fill(np.array(bin_.center) + (np.array(bin_.size) + 2.0 * _WALL_MM) * corners, height, 255)
        fill(np.array(bin_.center) + np.array(bin_.size) * corners, 0.0, 0)
    around = np.linspace(-np.pi, np.pi, 48, endpoint=False)
    foot = config.table.work_area.inner_radius_mm * np.column_stack([np.cos(around), np.sin(around), 0.0 * around])
    fill(transform(invert(T), foot)[:, :2], 0.0, 0)
    return mask

"""A hand, or anything else that is large and unknown, over the table: nothing may move before it is gone."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.config.cell import CellConfig
from controller.cycle.view import MARGIN_MM, region_mask
from controller.domain import CellCalibration, Frame
from controller.errors import Intruder
from controller.geometry import transform
from controller.localization.locate import Located
from controller.vision.rim import Rim

_ASIDE = math.radians(15.0)
"""Beyond the work area by more than this to either side stand bins, and the arm over them."""

_LARGE = 1.5
"""Something whose short side is longer than the widest part the jaws can take, times this, is no part."""

_STEP_PX = 8
"""The strip's border is found this coarsely: it is looked at no finer."""


def strip_mask(config: CellConfig, calibration: CellCalibration, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Mask (H, W), 255 beyond the work area and its margin where neither bins nor the arm over them are to be seen."""
    area = config.table.work_area
    low, high = np.radians(area.azimuth_deg)
    columns, rows = np.meshgrid(np.arange(0, size[0], _STEP_PX), np.arange(0, size[1], _STEP_PX))
    flat = calibration.plane(0.0).to_plane(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    base = transform(calibration.T_base_table, np.column_stack([flat, np.zeros(len(flat))]))
    radius, azimuth = np.hypot(base[:, 0], base[:, 1]), np.arctan2(base[:, 1], base[:, 0])
    free = (radius > area.outer_radius_mm + MARGIN_MM) & (azimuth > low - _ASIDE) & (azimuth < high + _ASIDE)
    coarse = np.where(free, 255, 0).astype(np.uint8).reshape(rows.shape)
    mask = cv2.resize(coarse, size, interpolation=cv2.INTER_NEAREST)
    for bin_ in config.bin_values():
        half = np.array(bin_.size) / 2.0 + MARGIN_MM
        corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * half + bin_.center
        ends = np.vstack([calibration.plane(z).to_pixels(corners) for z in (0.0, bin_.height)])
        if np.isfinite(ends).all():
            cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(ends).astype(np.int32)), (0,))
    return np.asarray(mask, np.uint8)


class Guard:
    """Tells when a hand or something else that is large and unknown is over the table.

    Args:
        config: The cell.
        calibration: Of its camera.
        widest: What the jaws can take at most, mm.
    """

    def __init__(self, config: CellConfig, calibration: CellCalibration, widest: float) -> None:
        self._config = config
        self._calibration = calibration
        self._largest = _LARGE * widest
        self._rim: Rim | None = None

    def check_frame(self, frame: Frame) -> None:
        """Look for whatever reaches over the table; the first frame is taken for how it looks when nothing does.

        Raises:
            Intruder: Something does.
        """
        if self._rim is None:
            strip = strip_mask(self._config, self._calibration, frame.size)
            inside = region_mask(self._config, self._calibration, frame.size)
            self._rim = Rim(frame.image, strip, inside)
        elif self._rim.crossed(frame.image):
            raise Intruder("something reaches over the table", "clear the view, then controller resume")

    def check_glance(self, glance: Frame) -> None:
        """Look at a glance as at a frame; nothing is known before the first frame.

        Raises:
            Intruder: Something reaches over the table.
        """
        if self._rim is not None and self._rim.crossed_in_glance(glance.image):
            raise Intruder("something reaches over the table", "clear the view, then controller resume")

    def check_things(self, found: Located) -> None:
        """Look for things that no part can be.

        Raises:
            Intruder: There is one.
        """
        T_base_table, reach = self._calibration.T_base_table, self._config.table.work_area.outer_radius_mm
        for thing in (*found.objects, *found.in_the_way):
            # Outside the area the arm and its shadow may look like anything; what is longer than it crosses the rim.
            there = thing.size[0] < reach and self._config.in_work_area(thing.center, T_base_table)
            if there and thing.size[1] > self._largest:
                x, y = thing.center
                raise Intruder(
                    f"something of {thing.size[0]:.0f} x {thing.size[1]:.0f} mm lies at ({x:.0f}, {y:.0f}) mm",
                    "take it away, then controller resume",
                )

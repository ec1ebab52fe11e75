"""Where in the picture parts may lie, and where nothing changes: the work area as the camera sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.config.cell import CellConfig
from controller.domain import Array, Bin, CellCalibration, LocatedObject
from controller.geometry import invert, transform
from controller.motion.gate import BIN_ASTRAY, WALL

MARGIN_MM = 40.0
"""A part centred on the border of the work area reaches this far beyond it; neighbours there matter for finger room."""

_REACH_MM = 80.0
"""Parts on the border of the work area, their shadows and the jaws above them change the picture this far outside."""
_BORDERS_MM = 25.0
"""What ends this near to what the arm hides may go on under it: a marker plate on the hand hides as much more."""
_STEP_PX = 8
"""What hides the table is found this coarsely; margins are wider."""
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


class Backdrop:
    """Where in the picture nothing is to be looked for: too far from where parts lie, in the bins, under the arm.

    Args:
        config: The cell.
        calibration: Of its camera.
        size: Of the frames, (width, height).
    """

    def __init__(self, config: CellConfig, calibration: CellCalibration, size: tuple[int, int]) -> None:
        self._size = size
        columns, rows = np.meshgrid(*(np.arange(_STEP_PX // 2, length, _STEP_PX) for length in size))
        pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
        self._shape = rows.shape
        at = calibration.plane(0.0).to_plane(pixels).astype(np.float32)
        area = config.work_area_outline(calibration.T_base_table, _REACH_MM)
        self._still = ~_within(area, at)
        for bin_ in config.bin_values():
            self._still |= _within(_silhouette(bin_, calibration.T_table_camera[:3, 3]), at)
        self._open = np.flatnonzero(~self._still)
        self._points = at[self._open]

    def mask(self, arm: Array) -> NDArray[np.uint8]:
        """Mask (H, W), 255 where nothing is to be looked for.

        Args:
            arm: ndarray of shape (N, 3): discs of the table that the arm hides, see `Planner.hidden`.
        """
        hidden = self._still.copy()
        apart = self._points[:, None] - arm[:, :2].astype(np.float32)
        covered = np.einsum("pnc,pnc->pn", apart, apart) <= arm[:, 2].astype(np.float32) ** 2
        hidden[self._open] = covered.any(axis=1)
        coarse = np.where(hidden, 255, 0).astype(np.uint8).reshape(self._shape)
        return np.asarray(cv2.resize(coarse, self._size, interpolation=cv2.INTER_NEAREST), np.uint8)


def reaching_under(things: Sequence[LocatedObject], arm: Array, widest: float) -> tuple[LocatedObject, ...]:
    """Those that border on what the arm hides, as far as they may reach on under it.

    Args:
        things: What is seen of them is no known shape.
        arm: See `Backdrop.mask`.
        widest: Long side of a part at most, mm.
    """
    found = []
    for thing in things:
        gaps = np.linalg.norm(thing.footprint[:, None] - arm[:, :2], axis=2) - arm[:, 2]
        disc = arm[gaps.min(axis=0).argmin()]
        if gaps.min() > _BORDERS_MM:
            continue
        ahead = disc[:2] - thing.center
        by = max(widest - thing.size[1], 0.0) / max(float(np.hypot(*ahead)), 1e-6) * ahead
        swept = cv2.convexHull(np.vstack([thing.footprint, thing.footprint + by]).astype(np.float32))[:, 0]
        found.append(replace(thing, footprint=swept.astype(np.float64)))
    return tuple(found)


def _silhouette(bin_: Bin, eye: Array) -> Array:
    """What of the table a bin hides, wherever it may stand: outline (N, 2) in `table`, mm."""
    half = np.array(bin_.size) / 2.0 + WALL + BIN_ASTRAY
    floor = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]) * half + bin_.center
    rim = eye[:2] + (floor - eye[:2]) * eye[2] / (eye[2] - bin_.height)
    return np.asarray(cv2.convexHull(np.vstack([floor, rim]).astype(np.float32))[:, 0], np.float64)


def _within(outline: Array, points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which of the points (N, 2) lie in an outline; what is no point does not."""
    ring, ahead = outline, np.roll(outline, -1, axis=0)
    inside = np.zeros(len(points), bool)
    x, y = points[:, 0], points[:, 1]
    for (x0, y0), (x1, y1) in zip(ring, ahead, strict=True):
        crosses = (y0 > y) != (y1 > y)
        if y0 != y1:
            inside ^= crosses & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return inside

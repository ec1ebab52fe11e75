"""Flat things with a picture on them: the table's top, printed sheets, the marker on the gripper."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_backends.lens import Lens
from sim_backends.painter_raster import Mask, Region
from sim_backends.solids import Array

_OVERSAMPLE = 2
_ROUGH = 1.6  # standard deviation of the table's grain from pixel to pixel
_SPECKS = 0.0005  # of the table's pixels
_SPECK_REACH = 3
_SPECK = 60.0 * np.outer(*2 * (cv2.getGaussianKernel(2 * _SPECK_REACH + 1, 0.8).astype(np.float32),))
# OpenCV takes both coordinates from one map when the second is empty.
NO_MAP = np.empty(0, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Print:
    """A printed picture lying in a plane.

    Attributes:
        picture: ndarray of shape (H, W) or (H, W, 3), dtype uint8.
        pixel_mm: Size of one of its pixels, mm.
        T_base_print: ndarray of shape (4, 4): origin in the middle of the picture, x to its right.
        y_up: y runs to the picture's top (z towards the reader); else to its bottom (z away from him).
        ink, paper: Brightness of its black and its white, 0..255.
    """

    picture: NDArray[np.uint8]
    pixel_mm: float
    T_base_print: Array
    y_up: bool
    ink: float = 28.0
    paper: float = 232.0

    @property
    def corners(self) -> Array:
        """Its corners in `base`, (4, 3), mm."""
        half = np.array(self.picture.shape[1::-1]) * self.pixel_mm / 2.0
        local = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * (*half, 0.0)
        return np.asarray(local @ self.T_base_print[:3, :3].T + self.T_base_print[:3, 3])


class Projector:
    """Looks planes up along the rays of one camera."""

    def __init__(self, lens: Lens) -> None:
        self.lens = lens
        self._rays = lens.rays()

    def plane(self, T_base_plane: Array, region: Region, oversample: int = 1) -> NDArray[np.float32]:
        """Points (x, y) of the plane, mm, that the pixels of a region look at; (h, w, 2)."""
        matrix = np.linalg.inv(self._homography(T_base_plane))
        return np.asarray(cv2.perspectiveTransform(self._finer(region, oversample), matrix), np.float32)

    def warp(self, print_: Print, region: Region) -> tuple[NDArray[np.uint8], Mask]:
        """The print as the camera sees it in a region: picture (h, w, 3) and how much of each pixel it covers."""
        picture, pixel = _reduced(print_, self._scale(print_))
        flip = -1.0 if print_.y_up else 1.0
        # mm of the plane to pixels of the picture, whose pixel centres are integers.
        to_pixels = np.array(
            [
                [1.0 / pixel, 0.0, print_.picture.shape[1] * print_.pixel_mm / 2.0 / pixel - 0.5],
                [0.0, flip / pixel, print_.picture.shape[0] * print_.pixel_mm / 2.0 / pixel - 0.5],
                [0.0, 0.0, 1.0],
            ]
        )
        matrix = to_pixels @ np.linalg.inv(self._homography(print_.T_base_print))
        at = cv2.perspectiveTransform(self._finer(region, _OVERSAMPLE), matrix)
        size = (region[2] - region[0], region[3] - region[1])
        seen = cv2.remap(picture, at, NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        x, y = at[..., 0], at[..., 1]
        # The paper's edge lies half a pixel beyond the centres of its outermost pixels.
        right = print_.picture.shape[1] * print_.pixel_mm / pixel - 0.5
        low = print_.picture.shape[0] * print_.pixel_mm / pixel - 0.5
        inside = ((x > -0.5) & (x < right) & (y > -0.5) & (y < low)).astype(np.uint8) * 255
        seen = cv2.resize(seen, size, interpolation=cv2.INTER_AREA)
        mask = cv2.resize(inside, size, interpolation=cv2.INTER_AREA)
        gain = (print_.paper - print_.ink) / 255.0
        toned = cv2.convertScaleAbs(seen, alpha=gain, beta=print_.ink)
        if toned.ndim == 2:
            toned = cv2.merge([toned, toned, toned])
        return np.asarray(toned, np.uint8), np.asarray(mask, np.uint8)

    def _homography(self, T_base_plane: Array) -> Array:
        """Plane (x, y, 1) to camera directions."""
        T = np.linalg.inv(self.lens.T_base_camera) @ T_base_plane
        return np.asarray(T[:3, [0, 1, 3]])

    def looks_down(self, region: Region, oversample: int) -> NDArray[np.bool_]:
        """Which rays of a region go down, and so meet the table's plane in front of the camera."""
        towards = self.lens.T_base_camera[2].astype(np.float32)
        return np.asarray(self._finer(region, oversample) @ towards[:2] + towards[2] < 0.0)

    def _finer(self, region: Region, oversample: int) -> NDArray[np.float32]:
        x0, y0, x1, y1 = region
        if oversample == 1:
            return np.ascontiguousarray(self._rays[y0:y1, x0:x1])
        # One more pixel around, so that the fine rays at the rim are interpolated, not clamped.
        height, width = self._rays.shape[:2]
        a, b, c, d = max(0, x0 - 1), max(0, y0 - 1), min(width, x1 + 1), min(height, y1 + 1)
        fine = cv2.resize(self._rays[b:d, a:c], None, fx=oversample, fy=oversample, interpolation=cv2.INTER_LINEAR)
        top, left = (y0 - b) * oversample, (x0 - a) * oversample
        return np.ascontiguousarray(
            fine[top : top + (y1 - y0) * oversample, left : left + (x1 - x0) * oversample], np.float32
        )

    def _scale(self, print_: Print) -> float:
        """Pixels of the camera per pixel of the print where it is seen largest."""
        pixels, ahead = self.lens.project(print_.corners)
        if not ahead.all():
            return 1.0
        sides = np.linalg.norm(np.roll(pixels, -1, axis=0) - pixels, axis=1)
        height, width = print_.picture.shape[:2]
        return float((sides / (width, height, width, height)).max())


def _reduced(print_: Print, scale: float) -> tuple[NDArray[np.uint8], float]:
    """The picture averaged down until its pixels are about as fine as the oversampled camera's, and their size."""
    factor = int(1.0 / max(scale * _OVERSAMPLE, 1e-6))
    if factor < 2:
        return print_.picture, print_.pixel_mm
    height, width = print_.picture.shape[:2]
    # Whole blocks only: the last rows and columns are filled up with copies of themselves.
    padded = cv2.copyMakeBorder(
        print_.picture, 0, -height % factor, 0, -width % factor, cv2.BORDER_REPLICATE
    )
    small = cv2.resize(
        padded, (padded.shape[1] // factor, padded.shape[0] // factor), interpolation=cv2.INTER_AREA
    )
    return np.asarray(small, np.uint8), print_.pixel_mm * factor


def table_texture(seed: int, low: tuple[float, float], high: tuple[float, float], per_mm: float) -> NDArray[np.uint8]:
    """Top of a bright laminated table: warm gray with faint grain and specks; (H, W, 3), x along columns."""
    random = np.random.default_rng([seed, 4])
    width, height = round((high[0] - low[0]) * per_mm), round((high[1] - low[1]) * per_mm)

    def smooth(rows: int, columns: int, level: float) -> NDArray[np.float32]:
        grain = random.standard_normal((rows, columns), np.float32) * np.float32(level)
        return np.asarray(cv2.resize(grain, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)

    # Long fibres across the arm's reach, clouds of some centimetres, and single specks; in hundredths of full white.
    value = random.standard_normal((height, width), np.float32) * np.float32(_ROUGH)
    cv2.add(value, smooth(height // 2, max(4, width // 60), 2.2), dst=value)
    cv2.add(value, smooth(max(4, height // 80), max(4, width // 80), 2.0), dst=value)
    specks = random.integers(0, value.size, random.poisson(_SPECKS * value.size))
    for row, column in zip(*np.divmod(specks, width), strict=True):
        # Cut where it reaches over the table's rim.
        top, left = max(row - _SPECK_REACH, 0), max(column - _SPECK_REACH, 0)
        patch = value[top : row + _SPECK_REACH + 1, left : column + _SPECK_REACH + 1]
        y, x = top - row + _SPECK_REACH, left - column + _SPECK_REACH
        patch -= _SPECK[y : y + patch.shape[0], x : x + patch.shape[1]]
    channels = [cv2.convertScaleAbs(value, alpha=tint / 200.0, beta=tint) for tint in (196.0, 206.0, 212.0)]
    return np.asarray(cv2.merge(channels), np.uint8)

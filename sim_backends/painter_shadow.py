"""Soft shadows on the table: hulls of the solids slid along the light, for several points of the lamp.

A shadow's rim is the softer the higher above the table its edge is. The points of the lamp make that for low
solids; what casts from high up is blurred as well, so that the points do not show one by one.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_backends.lens import Lens
from sim_backends.painter_raster import Region, region_of
from sim_backends.painter_scene import Scene
from sim_backends.solids import Array

Image = NDArray[np.uint8]

_LAMP_SAMPLES = 6
_LAMP_RADIUS = 0.055  # half width of the lamp as seen from the table, rad
_FLAT = 0.5  # what rises less above the table casts no shadow, mm
_HIGH = 75.0  # from here on a shadow is blurred as a high one, mm
# Blur in pixels of the half-size masks: the fine steps of the masks, and the distance of the lamp's points on
# the table under something 150 mm high.
_LOW_BLUR, _HIGH_BLUR = 1.2, 4.5


class Shadows:
    """Darkens pictures of one camera; first told what casts its shadow for ever.

    Args:
        scene: The solids.
        lens: The camera.
        lamp: Direction to the middle of the lamp, unit vector of shape (3,).
        depth: Light missing in the core, fraction.
    """

    def __init__(self, scene: Scene, lens: Lens, lamp: Array, depth: float) -> None:
        self._scene = scene
        self._lens = lens
        self._depth = depth
        side = np.cross(lamp, (0.0, 0.0, 1.0))
        side /= np.linalg.norm(side)
        angles = 2.0 * math.pi * np.arange(_LAMP_SAMPLES) / _LAMP_SAMPLES
        rim = np.outer(np.cos(angles), side) + np.outer(np.sin(angles), np.cross(lamp, side))
        lamps = lamp + _LAMP_RADIUS * rim
        self._slopes = lamps[:, :2] / lamps[:, 2:]
        # Shadows have no sharp edges: half the resolution will do.
        self._size = (lens.size[0] // 2, lens.size[1] // 2)
        self._fixed = np.zeros((_LAMP_SAMPLES, *self._size[::-1]), np.uint8)
        self._fixed_total = np.zeros(self._size[::-1], np.uint8)

    def fix(self, picture: Image, vertices: Array, shown: NDArray[np.bool_]) -> None:
        """Darken the ground under solids that never move; `darken` will not darken it there again."""
        points, casting, _ = self._cast(vertices, shown)
        whole = (0, 0, *self._size)
        total, self._fixed = self._low(points, casting, whole)
        self._multiply(picture, total, whole)
        self._fixed_total = total

    def darken(self, picture: Image, vertices: Array, shown: NDArray[np.bool_]) -> None:
        """Darken a picture of the ground and the fixed solids where these solids take the light.

        Args:
            picture: ndarray of shape (H, W, 3), dtype uint8; changed in place.
            vertices: ndarray of shape (V, 3): all vertices of the scene, mm.
            shown: ndarray of shape (N,), dtype bool: which solids cast.
        """
        points, low, high = self._cast(vertices, shown)
        if not low and not high:
            return
        spread = np.vstack([points[:, rows].reshape(-1, 2) for rows in (*low, *high)]).astype(np.float64)
        region = region_of(spread, self._size, 4 + round(2.5 * _HIGH_BLUR))
        if region is None:
            return
        total, _ = self._low(points, low, region)
        if high:
            cv2.max(total, self._high(points, high, region), dst=total)
        x0, y0, x1, y1 = region
        self._multiply(picture, np.asarray(cv2.subtract(total, self._fixed_total[y0:y1, x0:x1]), np.uint8), region)

    def _cast(
        self, vertices: Array, shown: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float32], list[slice], list[slice]]:
        """Shadow points (L, M, 2) at half resolution, and the rows that belong to each low and each high solid."""
        rows = [self._scene.vertices_of(int(i)) for i in np.flatnonzero(shown)] if self._depth > 0.0 else []
        tops = [float(vertices[own, 2].max()) for own in rows]
        rows = [own for own, top in zip(rows, tops, strict=True) if top > _FLAT]
        tops = [top for top in tops if top > _FLAT]
        if not rows:
            return np.zeros((_LAMP_SAMPLES, 0, 2), np.float32), [], []
        mine = np.vstack([vertices[own] for own in rows])
        ground = np.zeros((_LAMP_SAMPLES, len(mine), 3))
        ground[:, :, :2] = mine[:, :2] - np.maximum(mine[:, 2:], 0.0) * self._slopes[:, None, :]
        pixels, ahead = self._lens.project(ground.reshape(-1, 3))
        # Far away is as good as out of the picture, and fits into OpenCV's integers.
        half = np.clip((pixels + 0.5) / 2.0 - 0.5, -2000.0, 4000.0)
        points = half.reshape(_LAMP_SAMPLES, -1, 2).astype(np.float32)
        ahead = ahead.reshape(_LAMP_SAMPLES, -1)
        low: list[slice] = []
        high: list[slice] = []
        end = 0
        for own, top in zip(rows, tops, strict=True):
            start, end = end, end + own.stop - own.start
            flat = points[:, start:end].reshape(-1, 2)
            inside = (flat.max(axis=0) > 0.0).all() and (flat.min(axis=0) < self._size).all()
            if inside and ahead[:, start:end].all():
                (high if top > _HIGH else low).append(slice(start, end))
        return points, low, high

    def _low(self, points: NDArray[np.float32], rows: list[slice], region: Region) -> tuple[Image, NDArray[np.uint8]]:
        """Shadow of low and fixed solids together in a region, 0..255, and the share of every point of the lamp."""
        x0, y0, x1, y1 = region
        masks = self._fixed[:, y0:y1, x0:x1].copy()
        total = self._sum(masks, points, rows, region)
        return np.asarray(cv2.GaussianBlur(total, (0, 0), _LOW_BLUR), np.uint8), masks

    def _high(self, points: NDArray[np.float32], rows: list[slice], region: Region) -> Image:
        x0, y0, x1, y1 = region
        masks = np.zeros((_LAMP_SAMPLES, y1 - y0, x1 - x0), np.uint8)
        return np.asarray(cv2.GaussianBlur(self._sum(masks, points, rows, region), (0, 0), _HIGH_BLUR), np.uint8)

    def _sum(
        self, masks: NDArray[np.uint8], points: NDArray[np.float32], rows: list[slice], region: Region
    ) -> Image:
        share = round(255 / _LAMP_SAMPLES)
        corner = np.array(region[:2], np.float32)
        total = np.zeros(masks.shape[1:], np.uint8)
        for mask, own in zip(masks, points, strict=True):
            for solid in rows:
                hull = cv2.convexHull(own[solid]) - corner
                cv2.fillConvexPoly(mask, np.rint(hull * 16.0).astype(np.int32), share, cv2.LINE_AA, 4)
            cv2.add(total, mask, dst=total)
        return total

    def _multiply(self, picture: Image, shadow: Image, region: Region) -> None:
        x0, y0, x1, y1 = region
        full = cv2.resize(shadow, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
        gain = cv2.convertScaleAbs(full, alpha=-self._depth, beta=255.0)
        part = picture[2 * y0 : 2 * y1, 2 * x0 : 2 * x1]
        cv2.multiply(part, cv2.merge([gain, gain, gain]), dst=part, scale=1 / 255.0)

"""Glances of the simulated camera: an eighth of the picture's size, painted for a tenth of its cost.

At that size nobody sees faces, soft rims or grain: a solid is its outline in one tone, its shadow has one lamp point.
Light, lens, noise and everything that never moves are those of the full picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.ports import GLANCE_SCALE
from sim_backends.lens import Lens
from sim_backends.painter_scene import Scene
from sim_backends.solids import Array

Image = NDArray[np.uint8]

_FINER = 2  # times finer than the glance is drawn, and averaged
_SHIFT = 4  # fractional bits of OpenCV's polygon coordinates
_WINDOWS = 64  # places in both directions from where a glance's noise may be taken
_FAR = 4000.0  # px: outside every picture, and within OpenCV's integers


class Sketcher:
    """Paints glances of one world for one camera.

    Args:
        stage: ndarray of shape (H, W, 3), dtype uint8: what never moves, with its shadows.
        gain: ndarray of shape (H, W, 3): of uneven light; None where it is even.
        scene: The solids.
        lens: The camera.
        slope: Where a shadow falls for each mm of height, (x, y).
        depth: Light missing in a shadow, fraction.
        noise: Of a pixel of the full picture, levels.
        seed: Of the noise.
    """

    def __init__(
        self,
        stage: Image,
        gain: NDArray[np.float32] | None,
        scene: Scene,
        lens: Lens,
        slope: Array,
        depth: float,
        noise: float,
        seed: int,
    ) -> None:
        self._scale = _FINER / GLANCE_SCALE
        width, height = self._size = round(lens.size[0] / GLANCE_SCALE), round(lens.size[1] / GLANCE_SCALE)
        self._stage = _shrunk(stage, (_FINER * width, _FINER * height))
        self._gain = None if gain is None else cv2.resize(gain, self._size, interpolation=cv2.INTER_AREA)
        self._scene, self._lens = scene, lens
        self._slope, self._depth = slope, depth
        self._starts = np.array([scene.vertices_of(index).start for index in range(len(scene.solids))])
        self._random = np.random.default_rng([seed, 10])
        # The noise of the pixels that one pixel of a glance averages is independent; each glance takes its window.
        self._noise = self._random.standard_normal((height + _WINDOWS, width + _WINDOWS, 3), np.float32)
        self._noise *= noise / GLANCE_SCALE

    def paint(self, vertices: Array, shown: NDArray[np.bool_]) -> Image:
        """The glance, (H / 8, W / 8, 3), dtype uint8, BGR.

        Args:
            vertices: ndarray of shape (V, 3): all vertices of the scene, mm.
            shown: ndarray of shape (N,), dtype bool: which solids stand on the stage.
        """
        picture = self._stage.copy()
        shade = np.zeros(picture.shape[:2], np.uint8)
        shadows = self._project(self._on_table(vertices))
        for index in np.flatnonzero(shown & self._within(shadows)).tolist():
            _fill(shade, shadows[self._scene.vertices_of(index)], (255.0,))
        gain = cv2.convertScaleAbs(shade, alpha=-self._depth, beta=255.0)
        cv2.multiply(picture, cv2.merge([gain, gain, gain]), dst=picture, scale=1 / 255.0)
        pixels = self._project(vertices)
        away = ((vertices - self._lens.position) ** 2).sum(axis=1)
        nearest = np.minimum.reduceat(away, self._starts)
        for index in sorted(np.flatnonzero(shown & self._within(pixels)).tolist(), key=lambda index: -nearest[index]):
            _fill(picture, pixels[self._scene.vertices_of(index)], self._scene.solids[index].colour)
        return self._expose(_shrunk(picture, self._size))

    def _within(self, points: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which solids, their vertices at these (V, 2), may show in the sketch."""
        high = np.maximum.reduceat(points, self._starts)
        low = np.minimum.reduceat(points, self._starts)
        reaches = (high >= 0.0).all(axis=1) & (high < _FAR).all(axis=1)
        return np.asarray(reaches & (low < self._stage.shape[1::-1]).all(axis=1))

    def _on_table(self, vertices: Array) -> Array:
        """Where the light through points (V, 3) meets the table, mm."""
        flat = np.zeros_like(vertices)
        flat[:, :2] = vertices[:, :2] - np.maximum(vertices[:, 2:], 0.0) * self._slope
        return flat

    def _project(self, points: Array) -> NDArray[np.float32]:
        """Pixels (V, 2) of the sketch; what is behind the camera is far outside."""
        pixels, ahead = self._lens.project(points)
        fine = (pixels + 0.5) * self._scale - 0.5
        fine[~ahead] = _FAR
        return np.clip(fine, -_FAR, _FAR).astype(np.float32)

    def _expose(self, picture: Image) -> Image:
        """What light and sensor make of it."""
        light = picture.astype(np.float32)
        if self._gain is not None:
            light *= self._gain
        y, x = (int(v) for v in self._random.integers(0, _WINDOWS, 2))
        light += self._noise[y : y + len(light), x : x + light.shape[1]]
        return np.clip(np.rint(light), 0.0, 255.0).astype(np.uint8)


def _shrunk(picture: Image, size: tuple[int, int]) -> Image:
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _fill(picture: Image, points: NDArray[np.float32], colour: Sequence[float]) -> None:
    hull = np.rint(cv2.convexHull(points) * (1 << _SHIFT)).astype(np.int32)
    cv2.fillConvexPoly(picture, hull, colour, cv2.LINE_8, _SHIFT)

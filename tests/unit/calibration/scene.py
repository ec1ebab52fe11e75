"""Pictures of flat prints through a known lens: one ray a sample, so that edges carry no bias."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Frame
from controller.geometry import CameraModel, invert

Array = NDArray[np.float64]

LENS = CameraModel(
    np.array([[1006.0, 0.0, 648.6], [0.0, 1004.5, 352.8], [0.0, 0.0, 1.0]]),
    np.array([-0.25, 0.06, 0.0006, -0.0004, 0.0]),
    (1280, 720),
)
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def small_lens() -> CameraModel:
    """The same lens at half the resolution, for quick tests."""
    matrix = LENS.matrix * np.array([[0.5], [0.5], [1.0]])
    return CameraModel(matrix, LENS.distortion, (640, 360))


def paint(
    print_: NDArray[np.uint8], pixel_mm: float, T_camera_board: Array, camera: CameraModel, *, samples: int = 2
) -> NDArray[np.uint8]:
    """Picture (H, W) of a print on a gray ground, `samples`^2 rays a pixel averaged."""
    width, height = camera.image_size
    picture = np.full((height, width), 128, np.uint8)
    half = np.array(print_.shape[::-1]) * pixel_mm / 2
    along = np.linspace(-1.0, 1.0, 9)
    rim = np.vstack([[[a, b], [b, a]] for a in along for b in (-1.0, 1.0)]) * half
    T = T_camera_board
    seen = camera.project(np.column_stack([rim, np.zeros(len(rim))]) @ T[:3, :3].T + T[:3, 3])
    low = np.maximum(np.floor(seen.min(axis=0)).astype(int) - 3, 0)
    high = np.minimum(np.ceil(seen.max(axis=0)).astype(int) + 4, [width, height])
    if (high <= low).any():
        return picture
    rays = _rays(camera, low, high, samples)
    # The plane through the board: normal . ray * depth = normal . origin.
    depth = (T[:3, 2] @ T[:3, 3]).astype(np.float32) / (rays @ T[:3, 2].astype(np.float32))
    flat = (rays * depth[..., None] - T[:3, 3].astype(np.float32)) @ T[:3, :2].astype(np.float32)
    maps = (flat / pixel_mm + (np.array(print_.shape[::-1]) - 1) / 2).astype(np.float32)
    fine = cv2.remap(print_, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderValue=(128.0,))
    wide, tall = high - low
    coarse = fine.reshape(tall, samples, wide, samples).mean(axis=(1, 3), dtype=np.float32)
    picture[low[1] : high[1], low[0] : high[0]] = np.rint(coarse).astype(np.uint8)
    return picture


def _rays(
    camera: CameraModel, low: NDArray[np.intp], high: NDArray[np.intp], samples: int
) -> NDArray[np.float32]:
    """Directions (H', W', 3) with z = 1 of a window's samples, interpolated between pixel centres."""
    u, v = np.meshgrid(np.arange(low[0] - 1, high[0] + 1), np.arange(low[1] - 1, high[1] + 1))
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()])).astype(np.float32).reshape(*u.shape, 3)
    fine = cv2.resize(rays, None, fx=samples, fy=samples, interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine[samples:-samples, samples:-samples], np.float32)


class Studio:
    """A camera, a pair of hands and a clock around one painted board."""

    def __init__(self, camera: CameraModel, T_table_camera: Array, noise: float = 2.0) -> None:
        self.lens, self.T_table_camera, self.noise = camera, T_table_camera, noise
        self.picture: NDArray[np.uint8] = np.full(camera.image_size[::-1], 128, np.uint8)
        self.random = np.random.default_rng(5)
        self.time = 0.0
        self.count = 0

    def open(self) -> None: ...

    def close(self) -> None: ...

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        self.count += 1
        self.time = max(self.time, after) + 1 / 30
        noisy = self.picture + self.random.normal(0.0, self.noise, self.picture.shape)
        gray = np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)
        return Frame(self.count, self.time, np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), np.uint8))

    def now(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds

    def charge(self, seconds: float) -> None:
        self.time += seconds

    def hold(self, print_: NDArray[np.uint8], pixel_mm: float, T_camera_board: Array) -> None:
        self.picture = paint(print_, pixel_mm, T_camera_board, self.lens)

    def lay(self, print_: NDArray[np.uint8], pixel_mm: float) -> None:
        self.picture = paint(print_, pixel_mm, invert(self.T_table_camera) @ DOWN, self.lens)

    def remove(self) -> None:
        self.picture = np.full(self.lens.image_size[::-1], 128, np.uint8)

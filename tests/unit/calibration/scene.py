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
    # The plane through the board: normal . ray * depth = normal . origin.
    T = T_camera_board
    rays = _rays(camera, samples)
    depth = (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2].astype(np.float32))
    flat = (rays * depth[:, None] - T[:3, 3].astype(np.float32)) @ T[:3, :2].astype(np.float32)
    where = flat / pixel_mm + (np.array(print_.shape[::-1]) - 1) / 2
    maps = where.astype(np.float32).reshape(height * samples, width * samples, 2)
    fine = cv2.remap(print_, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderValue=(128.0,))
    coarse = fine.reshape(height, samples, width, samples).mean(axis=(1, 3), dtype=np.float32)
    return np.asarray(np.rint(coarse), np.uint8)


def _rays(camera: CameraModel, samples: int) -> NDArray[np.float32]:
    key = (camera.matrix.tobytes(), camera.distortion.tobytes(), samples)
    if key not in _RAYS:
        width, height = camera.image_size
        u = (np.arange(width * samples) + 0.5) / samples - 0.5
        v = (np.arange(height * samples) + 0.5) / samples - 0.5
        rays = camera.rays(np.column_stack([np.tile(u, len(v)), np.repeat(v, len(u))]))
        _RAYS.clear()
        _RAYS[key] = rays.astype(np.float32)
    return _RAYS[key]


#: The rays of the camera painted last: undoing the lens is most of the work.
_RAYS: dict[tuple[bytes, bytes, int], NDArray[np.float32]] = {}


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

"""The noise of a frame's pixels, and what is no noise but a fault: single pixels far from their neighbours."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.robust import median

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

_ROWS, _COLUMNS = 32, 80
"""Where the noise is looked at: about so many places tell a standard deviation to 2 %."""

_BLOCK, _SMALL_STEP = 8, 8
"""Side of a compressed picture's blocks, px, and what counts of a step between neighbours, levels: no more than a
block's, for objects have larger ones."""
_BLOCKY = 1.5
"""Where blocks meet, steps are so many times as large as elsewhere at JPEG quality 85 and below; without, 1.04."""
_BLOCK_STEP = 11.0
"""Blocks of colour beside strong edges were off by up to 10.9 levels at JPEG quality 50, over 10 noisy scenes."""


def pixel_noise(image: Image) -> Floats:
    """Covariance (3, 3) of the pixel noise, from differences of neighbours on a sample of rows."""
    height, width = image.shape[:2]
    if width < 4:
        return np.eye(3)
    rows = image[:: max(1, height // _ROWS)]
    step = max(1, width // _COLUMNS)
    last = (width - 3) // step * step + 1
    before, here, after = (
        np.ascontiguousarray(rows[:, i : i + last : step].reshape(-1, 3).T, np.float32) for i in range(3)
    )
    # The second difference is blind to slopes; its variance is 6 times the noise's.
    second = before - here - here + after
    size = np.abs(second)
    # Every other place is enough for the median.
    scale = np.maximum(np.float32(1.4826) * median(size[:, ::2], 1), np.float32(0.5))
    kept = (size < np.float32(3.5) * scale[:, None]).all(axis=0)
    covariance = (second * kept) @ second.T / (6.0 * max(int(np.count_nonzero(kept)), 1))
    # Rounding alone has a variance of 1/12; compression hides noise in flat blocks.
    return np.asarray(covariance + np.eye(3) * 0.3)


def least_step(image: Image) -> float:
    """The least step that a picture's own blocks do not make, levels; 0 unless it was compressed strongly."""
    rows = np.ascontiguousarray(image[:: max(1, image.shape[0] // 64), :, 1])
    count = (rows.shape[1] - 1) // _BLOCK
    if count < 8:
        return 0.0
    steps = np.minimum(cv2.absdiff(rows[:, 1:], rows[:, :-1]), np.uint8(_SMALL_STEP))
    columns = np.asarray(cv2.reduce(steps, 0, cv2.REDUCE_SUM, dtype=cv2.CV_32S))[0]
    at = np.sort(columns[: count * _BLOCK].reshape(count, _BLOCK).sum(axis=0))
    typical = 0.5 * float(at[_BLOCK // 2 - 1] + at[_BLOCK // 2])
    return _BLOCK_STEP if at[-1] > _BLOCKY * max(typical, 1e-9) else 0.0


def without_spikes(image: Image, noise: Floats) -> Image:
    """The image with impulses replaced by their neighbourhood's median; the image itself when it has none."""
    limit = max(40.0, 8.0 * math.sqrt(float(noise.trace()) / 3.0))
    if image.shape[0] < 64:
        return image
    rows = image[: image.shape[0] // 64 * 64].reshape(-1, 64, *image.shape[1:])[:, :3].reshape(-1, *image.shape[1:])
    spikes = np.count_nonzero(cv2.absdiff(rows, cv2.medianBlur(rows, 3)) > limit)
    # Corners of objects and print also change under a median, but on fewer than one pixel in a thousand.
    if spikes < 2e-3 * rows.size:
        return image
    clean = np.asarray(cv2.medianBlur(image, 3), np.uint8)
    mask = (cv2.absdiff(image, clean).max(axis=2) > limit).astype(np.uint8)
    return np.asarray(cv2.copyTo(clean, mask, image.copy()), np.uint8)

"""The noise of a frame's pixels, and what is no noise but a fault: single pixels far from their neighbours."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]


def pixel_noise(image: Image) -> Floats:
    """Covariance (3, 3) of the pixel noise, from differences of neighbours on a sample of rows."""
    height, width = image.shape[:2]
    if width < 4:
        return np.eye(3)
    rows = image[:: max(1, height // 40)]
    step = max(1, width // 100)
    at = np.arange(0, width - 2, step)
    before, here, after = (rows[:, at + i].astype(np.float32) for i in range(3))
    # The second difference is blind to slopes; its variance is 6 times the noise's.
    second = (before - 2.0 * here + after).reshape(-1, 3)
    # Rows are partitioned much faster than columns.
    scale = np.maximum(1.4826 * np.median(np.abs(np.ascontiguousarray(second.T)), axis=1), 0.5)
    kept = second[(np.abs(second) < 3.5 * scale).all(axis=1)].astype(np.float64)
    covariance = kept.T @ kept / max(len(kept), 1) / 6.0
    # Rounding alone has a variance of 1/12; compression hides noise in flat blocks.
    return np.asarray(covariance + np.eye(3) * 0.3)


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

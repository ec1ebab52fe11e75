"""Gray profiles across outlines: sampled for all objects at once, averaged along short chunks of each side.

A chunk's profile is the mean over parallel lines one pixel apart, so that hardly any information is lost while
the arithmetic that follows becomes a few hundred numbers an object.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CHUNKS = 24
"""Chunks of an outline: divisible by the 3, 4 and 6 sides of the families."""
_GRID = 32.0
"""Interpolation positions of `cv2.remap` to a pixel: samples are put exactly there, so none is moved unseen."""


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Averaged profiles of the C chunks of K outlines.

    Attributes:
        values: ndarray of shape (K, C, D, 3), BGR levels.
        pixels: ndarray of shape (K, C, D, 2): mean position of the samples, px.
        lines: ndarray of shape (K, C): lines averaged, about the chunk's length in px.
        inside: ndarray of shape (K, C, D), bool: the sample lies within the picture.
    """

    values: Floats
    pixels: Floats
    lines: Floats
    inside: NDArray[np.bool_]


def sample(
    image: NDArray[np.uint8], starts: Floats, ends: Floats, normals: Floats, reach: Floats, columns: int
) -> Profiles:
    """Profiles across chunks of outlines.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8.
        starts: ndarray of shape (K, C, 2), px: where each chunk begins.
        ends: ndarray of shape (K, C, 2), px: where it ends.
        normals: ndarray of shape (K, C, 2), unit, outward.
        reach: ndarray of shape (K,): how far the profiles go to either side, px.
        columns: Samples of a profile, D.
    """
    count, chunks = starts.shape[:2]
    along = (ends - starts).reshape(-1, 2)
    length = np.hypot(along[:, 0], along[:, 1])
    lines = np.clip(np.ceil(length), 1, 64).astype(np.intp)
    first = np.concatenate([[0], np.cumsum(lines)[:-1]])
    chunk = np.repeat(np.arange(len(lines)), lines)
    part = (np.arange(len(chunk)) - first[chunk] + 0.5) / lines[chunk]
    # On the grid, positions and their sums over a chunk are exact in single precision.
    base = ((starts.reshape(-1, 2)[chunk] + along[chunk] * part[:, None]) * _GRID).astype(np.float32)
    offset = np.repeat(reach * _GRID, chunks)[:, None] * np.linspace(-1.0, 1.0, columns)
    normal = normals.reshape(-1, 2)
    scale = 1.0 / lines[:, None]
    steps, means = [], []
    for i in range(2):
        position = (normal[:, i, None] * offset).astype(np.float32)[chunk]
        position += base[:, i, None]
        np.rint(position, out=position)
        position *= np.float32(1.0 / _GRID)
        steps.append(position)
        means.append(np.add.reduceat(position, first, axis=0) * scale)
    raw = _remap(image, *steps).reshape(len(chunk), -1)
    values = np.add.reduceat(raw, first, axis=0) * scale
    mean_x, mean_y = means
    height, width = image.shape[:2]
    inside = (mean_x >= 0.5) & (mean_x <= width - 1.5) & (mean_y >= 0.5) & (mean_y <= height - 1.5)
    shape = (count, chunks, columns)
    return Profiles(
        values.reshape(*shape, 3),
        np.stack([mean_x, mean_y], axis=-1).reshape(*shape, 2),
        lines.reshape(count, chunks).astype(np.float64),
        inside.reshape(shape),
    )


def _remap(image: NDArray[np.uint8], x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
    """Bilinear samples, shape (N, D, 3), in blocks short enough for OpenCV's 16-bit row index."""
    blocks = []
    for start in range(0, len(x), 30_000):
        block = slice(start, start + 30_000)
        blocks.append(cv2.remap(image, x[block], y[block], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return np.concatenate(blocks).astype(np.float32)

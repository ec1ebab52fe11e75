"""Gray profiles across outlines: sampled for all objects at once, averaged along short chunks of each side.

A chunk's profile is the mean over parallel lines one pixel apart, so that hardly any information is lost while
the arithmetic that follows becomes a few hundred numbers an object.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Pixel = TypeVar("Pixel", np.uint8, np.float32)

CHUNKS = 24
"""Chunks of an outline: divisible by the 3, 4 and 6 sides of the families."""
_GRID = 32.0
"""Interpolation positions of `cv2.remap` to a pixel: samples are put exactly there, so none is moved unseen."""
_APART, _MOST_LINES = 1.4, 64
"""Distance of a chunk's lines, px, and the most of them.

Between pixels a sample is a mean of several, with two thirds of their variance each way: lines 1.5 px apart hold as
much as every pixel does.
"""
_ROW, _MOST_ROWS = 512, 30_000
"""Samples of a row of `cv2.remap`, and the most rows."""


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Averaged profiles of the C chunks of K outlines.

    Attributes:
        values: ndarray of shape (K, C, D, 3), dtype float32, BGR levels.
        middle: ndarray of shape (K, C, 2): mean position of the lines, px.
        offset: ndarray of shape (K, C, D), dtype float32: how far outwards from there each sample lies, px.
        pixels: ndarray of shape (K, C): how many pixels' noise is averaged, about the chunk's length in px.
        inside: ndarray of shape (K, C, D), bool: the sample lies within the picture.
    """

    values: Floats32
    middle: Floats
    offset: Floats32
    pixels: Floats
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
    begin = starts.reshape(-1, 2)
    along = ends.reshape(-1, 2) - begin
    length = np.hypot(along[:, 0], along[:, 1])
    lines = np.minimum(np.maximum(np.ceil(length / _APART), 1), _MOST_LINES).astype(np.intp)
    last = np.cumsum(lines)
    first = last - lines
    chunk = np.repeat(np.arange(len(lines)), lines)
    # The place of each line, and of each sample on it, is rounded to the grid by itself: so is their sum.
    origin, step = begin.T * _GRID, along.T * (_GRID / lines)
    number = np.arange(len(chunk)) - first[chunk] + 0.5
    base = (np.rint(step.take(chunk, axis=1) * number + origin.take(chunk, axis=1)) * (1.0 / _GRID)).astype(np.float32)
    normal = normals.reshape(-1, 2)
    wide = np.repeat(reach, chunks)[:, None] * np.linspace(-_GRID, _GRID, columns)
    apart = np.rint(normal.T[..., None] * wide) * (1.0 / _GRID)
    places = apart.astype(np.float32).take(chunk, axis=1)
    places += base[..., None]
    raw = bilinear(image, places[0], places[1]).reshape(len(chunk), -1)
    scale = 1.0 / lines[:, None]
    values = _sums(raw, first, lines)
    values *= scale.astype(np.float32)
    middle = (np.add.reduceat(base, first, axis=1, dtype=np.float64) * scale[:, 0]).T
    x, y = middle[:, :1] + apart[0], middle[:, 1:] + apart[1]
    height, width = image.shape[:2]
    inside = (x >= 0.5) & (x <= width - 1.5) & (y >= 0.5) & (y <= height - 1.5)
    offset = normal[:, :1] * apart[0] + normal[:, 1:] * apart[1]
    shape = (count, chunks, columns)
    return Profiles(
        values.reshape(*shape, 3),
        middle.reshape(count, chunks, 2),
        offset.astype(np.float32).reshape(shape),
        np.minimum(np.maximum(length, 1.0), 1.5 * _MOST_LINES).reshape(count, chunks),
        inside.reshape(shape),
    )


def _sums(raw: NDArray[np.uint8], first: NDArray[np.intp], lines: NDArray[np.intp]) -> Floats32:
    """Sums (M, W) of so many rows of `raw` (L, W) from each first one on."""
    # All that lies above and to the left of each place: exact, and several times as fast as `np.add.reduceat`.
    total = cv2.integral(raw, sdepth=cv2.CV_64F)
    return np.asarray(np.diff(total[first + lines] - total[first], axis=1), np.float32)


def bilinear(image: NDArray[Pixel], x: Floats32, y: Floats32) -> NDArray[Pixel]:
    """Samples (..., C) of an image between its pixels, at places (...), beyond its rim those of the rim."""
    count = x.size
    # OpenCV is slow on short rows, and their number has 16 bits.
    width = max(_ROW, math.ceil(count / _MOST_ROWS))
    rows = max(1, math.ceil(count / width))
    places = np.zeros((2, rows * width), np.float32)
    places[0, :count], places[1, :count] = x.ravel(), y.ravel()
    both = places.reshape(2, rows, width)
    found = cv2.remap(image, both[0], both[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, image.dtype).reshape(rows * width, -1)[:count].reshape(*x.shape, -1)

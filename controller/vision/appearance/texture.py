"""Texture of parts: a descriptor that does not change when the part turns, and names for common textures.

The surface is reduced to the one colour direction in which it varies most, so that red on green counts like black
on white; its sign is chosen so that the rarer shade is the brighter. The descriptor holds contrast in four bands,
how much gradients agree in direction (stripes) and in right angles (checks), the shape of the shades' distribution,
and histograms of local binary patterns at two radii.

Source: Ojala, Pietikainen and Maenpaa, "Multiresolution gray-scale and rotation invariant texture classification
with local binary patterns", IEEE Trans. PAMI 24(7), 2002; structure tensor: Bigun and Granlund, ICCV 1987.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.appearance.naming import Namer, load
from controller.vision.appearance.tiles import SIDE, Tiles

Floats32 = NDArray[np.float32]

BANDS = (0.8, 1.6, 3.2, 6.4)
"""Standard deviations of the Gaussians between which contrast is measured, px of a tile."""
RADII = (1.5, 3.0)
"""Of the local binary patterns, px of a tile."""
FLOOR = 0.01
"""Contrast below which nothing is told apart: 1 % of the range of codes is a good camera's noise."""
_PATTERNS = 10
LENGTH = len(BANDS) + 1 + 2 + 6 + _PATTERNS * len(RADII)


def descriptors(surface: Tiles) -> Floats32:
    """(N, LENGTH) texture descriptors of tiles."""
    count = len(surface.image)
    if not count:
        return np.empty((0, LENGTH), np.float32)
    inside = (surface.material > 127).astype(np.float32)
    shades = _shades(surface.image, inside)
    weight = np.maximum(inside.sum(axis=(1, 2)), 1.0)
    tall = np.ascontiguousarray(shades.reshape(-1, SIDE))
    # Differences that reach beyond the material are left out.
    eroded = cv2.erode(np.ascontiguousarray(inside.reshape(-1, SIDE)), np.ones((3, 3), np.uint8))
    deep = np.asarray(eroded, np.float32).reshape(inside.shape)
    deep[:, [0, -1]] = 0.0
    deep[:, :, [0, -1]] = 0.0
    deep_weight = np.maximum(deep.sum(axis=(1, 2)), 1.0)
    total = np.sqrt((shades * shades).sum(axis=(1, 2)) / weight)
    columns = [np.log(total + FLOOR)]
    blurred = [tall]
    for sigma in BANDS:
        blurred.append(np.asarray(cv2.GaussianBlur(tall, (0, 0), sigma), np.float32))
    for fine, coarse in pairwise(blurred):
        band = (fine - coarse).reshape(shades.shape)
        columns.append(np.log(np.sqrt((band * band * deep).sum(axis=(1, 2)) / deep_weight) + FLOOR))
    unit = shades / (total + FLOOR)[:, None, None] * inside
    square = unit * unit
    columns.append((square * unit).sum(axis=(1, 2)) / weight)
    columns.append(np.log1p((square * square).sum(axis=(1, 2)) / weight))
    for level in (1, 2, 3):
        columns += _agreement(np.asarray(blurred[level].reshape(shades.shape), np.float32), deep)
    own = np.arange(count)[:, None, None] * _PATTERNS
    keep = deep > 0.0
    for radius, level in zip(RADII, (1, 2), strict=True):
        base = blurred[level]
        codes = _patterns(base, radius, total, count)
        histogram = np.bincount((own + codes)[keep], minlength=count * _PATTERNS).reshape(count, _PATTERNS)
        columns += list(np.sqrt(histogram / deep_weight[:, None]).T)
    return np.stack(columns, axis=1).astype(np.float32)


def _shades(image: NDArray[np.uint8], inside: Floats32) -> Floats32:
    """(N, SIDE, SIDE) of how far each pixel is from its part's mean along the main variation, 1 = full range.

    Slow shading, a plane across the part, is taken out; outside the material it is 0.
    """
    weight = np.maximum(inside.sum(axis=(1, 2)), 1.0)
    values = image.reshape(len(image), -1, 3).astype(np.float32) / 255.0
    keep = inside.reshape(len(image), -1)
    mean = (keep[:, None, :] @ values)[:, 0] / weight[:, None]
    rest = (values - mean[:, None]) * keep[:, :, None]
    covariance = rest.transpose(0, 2, 1) @ rest / weight[:, None, None]
    _, axes = np.linalg.eigh(covariance)
    along = (rest @ axes[:, :, 2:])[:, :, 0]
    ramp = (np.arange(SIDE, dtype=np.float32) - (SIDE - 1) / 2.0) / SIDE
    across, down = np.meshgrid(ramp, ramp)
    basis = np.stack([np.ones_like(across), across, down]).reshape(3, -1).astype(np.float32)
    weighted = keep[:, None, :] * basis
    normal = weighted @ basis.T + 1e-3 * np.eye(3, dtype=np.float32)
    plane = np.linalg.solve(normal, weighted @ along[:, :, None])[:, :, 0]
    along = (along - plane @ basis) * keep
    skew = (along * along * along).sum(axis=1)
    return np.asarray((along * np.where(skew < 0.0, -1.0, 1.0)[:, None]).reshape(inside.shape), np.float32)


def _agreement(values: Floats32, deep: Floats32) -> list[Floats32]:
    """How much gradients share one axis, and one pair of axes, 0 to 1."""
    dx = np.zeros_like(values)
    dy = np.zeros_like(values)
    dx[:, :, 1:-1] = values[:, :, 2:] - values[:, :, :-2]
    dy[:, 1:-1] = values[:, 2:] - values[:, :-2]
    square = dx * dx - dy * dy
    cross = 2.0 * dx * dy
    power = np.sqrt(square * square + cross * cross) * deep
    total = power.sum(axis=(1, 2)) + 1e-4
    one = np.hypot((square * deep).sum(axis=(1, 2)), (cross * deep).sum(axis=(1, 2))) / total
    # The doubled angle once more: (square + i cross)^2 / |.| has four times the direction's angle.
    safe = np.maximum(power, 1e-9)
    real = ((square * square - cross * cross) * deep / safe).sum(axis=(1, 2))
    imaginary = ((2.0 * square * cross) * deep / safe).sum(axis=(1, 2))
    return [np.asarray(one, np.float32), np.asarray(np.hypot(real, imaginary) / total, np.float32)]


def _kernels(radius: float) -> list[NDArray[np.float32]]:
    """Eight kernels that read the values at equal angles on a circle, between pixels, less the middle's."""
    reach = math.ceil(radius)
    out = []
    for k in range(8):
        x, y = radius * math.cos(k * math.pi / 4.0), radius * math.sin(k * math.pi / 4.0)
        kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
        i, j = math.floor(y), math.floor(x)
        u, v = y - i, x - j
        for di, dj, share in ((0, 0, (1 - u) * (1 - v)), (0, 1, (1 - u) * v), (1, 0, u * (1 - v)), (1, 1, u * v)):
            if share > 1e-9:
                kernel[reach + i + di, reach + j + dj] += share
        kernel[reach, reach] -= 1.0
        out.append(kernel)
    return out


_CIRCLES = {radius: _kernels(radius) for radius in RADII}
_LEAST_STEP = 0.15
"""A neighbour counts as brighter when it is so by this share of the texture's contrast: noise has no pattern."""


def _patterns(base: Floats32, radius: float, total: Floats32, count: int) -> NDArray[np.intp]:
    """Rotation-invariant uniform patterns, 0 to 9, of every pixel of N tiles that stand on one another."""
    least = np.repeat(_LEAST_STEP * (total + FLOOR), SIDE)[:, None].astype(np.float32)
    bits = [
        (cv2.filter2D(base, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE) > least).view(np.uint8)
        for kernel in _CIRCLES[radius]
    ]
    ones = sum(bits[1:], bits[0].copy())
    changes = bits[-1] ^ bits[0]
    for a, b in pairwise(bits):
        changes = changes + (a ^ b)
    codes = np.where(changes <= 2, ones, 9)
    return codes.reshape(count, SIDE, SIDE).astype(np.intp)


SHIPPED = Path(__file__).with_name("textures.npz")
_DOUBT = -0.15
"""Below this best score a texture is none of the known ones."""


@cache
def _namer() -> Namer:
    return load(SHIPPED)


def names_of(values: Floats32) -> list[str | None]:
    """Names of textures (N, LENGTH); None where none fits."""
    if not len(values):
        return []
    namer = _namer()
    scores = namer.scores(values)
    best = scores.argmax(axis=1)
    return [namer.names[k] if row[k] > _DOUBT else None for row, k in zip(scores, best, strict=True)]

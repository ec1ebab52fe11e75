"""Texture of parts: a descriptor that does not change when the part turns, and names for common textures.

The surface is reduced to the one colour direction in which it varies most, so that red on green counts like black
on white; its sign is chosen so that the rarer shade is the brighter. The descriptor holds contrast in four bands,
how much gradients agree in direction (stripes) and in right angles (checks), the shape of the shades' distribution,
and histograms of local binary patterns at two finenesses.

Source: Ojala, Pietikainen and Maenpaa, "Multiresolution gray-scale and rotation invariant texture classification
with local binary patterns", IEEE Trans. PAMI 24(7), 2002; structure tensor: Bigun and Granlund, ICCV 1987.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.appearance.hole import counts
from controller.vision.appearance.naming import Namer, load
from controller.vision.appearance.tiles import SIDE, Masks, Tiles

Floats32 = NDArray[np.float32]

BANDS = (0.8, 1.6, 3.2, 6.4)
"""Standard deviations of the Gaussians between which contrast is measured, px of a tile."""
REACH = 2
"""Of the local binary patterns, px of a tile and of one half as fine: they compare a pixel with the eight on a circle
of radius 1.5 around it, between two pixels along the axes and one pixel off (1.4) across."""
FLOOR = 0.01
"""Contrast below which nothing is told apart: 1 % of the range of codes is a good camera's noise."""
_VISIBLE = 0.02
"""Contrast of the faintest texture, twice what is told from nothing; of those the model was trained on, 0.036."""
_PLAIN = "plain"
_PATTERNS = 10
LENGTH = len(BANDS) + 1 + 2 + 6 + _PATTERNS * 2


def descriptors(surface: Tiles) -> Floats32:
    """(N, LENGTH) texture descriptors of tiles."""
    if not surface.which:
        return np.empty((0, LENGTH), np.float32)
    return _described(_shades(surface), surface.material)


def names(surface: Tiles) -> list[str | None]:
    """Names of the textures of tiles; None where none fits."""
    if not surface.which:
        return []
    shades = _shades(surface)
    out: list[str | None] = [_PLAIN] * len(shades)
    # Well within the material: an edge's blur is no texture.
    deep = _deep(_side_by_side(surface.material.view(np.uint8)))
    wide = _side_by_side(shades)
    rough = np.flatnonzero(_dot(wide * wide, deep) >= _VISIBLE**2 * _sums(deep))
    if len(rough):
        for k, name in zip(rough.tolist(), names_of(_described(shades[rough], surface.material[rough])), strict=True):
            out[k] = name
    return out


def _contrast(shades: Floats32, material: Masks) -> Floats32:
    """Standard deviation (N,) of the shades (N, SIDE, SIDE) within the material."""
    weight = np.maximum(counts(material), 1).astype(np.float32)
    flat = shades.reshape(len(shades), -1)
    return np.asarray(np.sqrt(np.vecdot(flat, flat) / weight), np.float32)


def _described(shades: Floats32, material: Masks) -> Floats32:
    """(N, LENGTH) texture descriptors of N tiles, at least one, by their shades and material (N, SIDE, SIDE)."""
    count = len(shades)
    total = _contrast(shades, material)
    # From here on tiles stand side by side, (SIDE, N, SIDE): long rows are what OpenCV and BLAS are quick on.
    shades = _side_by_side(shades)
    weight = np.maximum(counts(material), 1).astype(np.float32)
    deep = _deep(_side_by_side(material.view(np.uint8)))
    deep_weight = np.maximum(_sums(deep), 1.0)
    square = shades * shades
    columns = [np.log(total + FLOOR)]
    blurred = [shades, *_blurred(shades)]
    for fine, coarse in pairwise(blurred):
        band = fine - coarse
        columns.append(np.log(np.sqrt(_dot(band * band, deep) / deep_weight) + FLOOR))
    unit = np.float32(1.0) / (total + np.float32(FLOOR))
    columns.append(_dot(square, shades) * unit**3 / weight)
    columns.append(np.log1p(_dot(square, square) * unit**4 / weight))
    # What was blurred is looked at on every second pixel: it has no finer detail.
    halves = np.concatenate([blurred[level][::2, :, ::2] for level in (2, 3)], axis=1)
    deep_half = np.ascontiguousarray(deep[::2, :, ::2])
    columns += _agreement(blurred[1], deep)
    both = _agreement(halves, np.concatenate([deep_half, deep_half], axis=1))
    columns += [share[some] for some in (slice(None, count), slice(count, None)) for share in both]
    columns += _histograms(blurred[1], total, deep)
    columns += _histograms(halves[:, :count], total, deep_half)
    return np.array(columns, np.float32).T


def _side_by_side(tiles: NDArray[Any]) -> NDArray[Any]:
    """Tiles (N, SIDE, SIDE) as (SIDE, N, SIDE), each flipped over its diagonal: nothing here minds that."""
    return np.ascontiguousarray(tiles.transpose(2, 0, 1))


def _sums(values: Floats32) -> Floats32:
    """(N,) sums over tiles (h, N, w)."""
    return np.asarray(np.einsum("inj->n", values), np.float32)


def _dot(a: Floats32, b: Floats32) -> Floats32:
    """(N,) sums of products over tiles (h, N, w)."""
    return np.asarray(np.einsum("inj,inj->n", a, b), np.float32)


def _deep(material: NDArray[np.uint8]) -> Floats32:
    """1 where what is computed from a neighbourhood stays within the material (SIDE, N, SIDE) and the tile, else 0."""
    deep = np.asarray(cv2.erode(material.reshape(SIDE, -1), np.ones((3, 3), np.uint8)), np.float32)
    deep = deep.reshape(material.shape)
    # Tiles stand beside one another when patterns are read: no column near another tile counts, nor such a row.
    reach = 2 * REACH
    deep[:, :, :reach] = deep[:, :, -reach:] = 0.0
    deep[:reach] = deep[-reach:] = 0.0
    return deep


def _gaussians() -> Floats32:
    """(len(BANDS), SIDE, SIDE): a tile's row times one is the row blurred by that band, mirrored at its ends."""
    place = np.arange(SIDE)
    far = np.arange(-SIDE, 2 * SIDE)
    mirrored = np.abs(far)
    mirrored = np.where(mirrored > SIDE - 1, 2 * (SIDE - 1) - mirrored, mirrored)
    out = np.zeros((len(BANDS), SIDE, SIDE))
    for k, sigma in enumerate(BANDS):
        np.add.at(out[k], mirrored, np.exp(-0.5 * ((far[:, None] - place) / sigma) ** 2))
    return np.asarray(out / out.sum(axis=1, keepdims=True), np.float32)


_GAUSSIANS = _gaussians()
_DOWN = np.ascontiguousarray(_GAUSSIANS.transpose(0, 2, 1)).reshape(-1, SIDE)


def _blurred(shades: Floats32) -> Floats32:
    """(len(BANDS), SIDE, N, SIDE): the tiles (SIDE, N, SIDE) blurred by each of BANDS."""
    down = (_DOWN @ shades.reshape(SIDE, -1)).reshape(len(BANDS), -1, SIDE)
    return np.asarray((down @ _GAUSSIANS).reshape(len(BANDS), *shades.shape), np.float32)


def _plane() -> Floats32:
    """(3, SIDE * SIDE): one, and a ramp along either axis, of about unit size."""
    ramp = (np.arange(SIDE, dtype=np.float32) - (SIDE - 1) / 2.0) / SIDE
    across, down = np.meshgrid(ramp, ramp)
    return np.stack([np.ones_like(across), across, down]).reshape(3, -1).astype(np.float32)


_PLANE = _plane()
# Products of two of them, one a row: 3 x 3 times SIDE * SIDE.
_PLANE_PRODUCTS = (_PLANE[:, None] * _PLANE[None]).reshape(9, -1)


def _shades(surface: Tiles) -> Floats32:
    """(N, SIDE, SIDE) of how far each pixel is from its part's mean along the main variation, 1 = full range.

    Slow shading, a plane across the part, is taken out; outside the material it is 0.
    """
    count = len(surface.which)
    keep = surface.material.reshape(count, -1).astype(np.float32)
    weight = np.maximum(keep.sum(axis=1), 1.0)
    # (3, N, SIDE * SIDE): blue, green and red.
    values = surface.planes.reshape(3, count, -1).astype(np.float32)
    mean = (values.transpose(1, 0, 2) @ keep[:, :, None])[:, :, 0].T / weight
    values -= mean[:, :, None]
    values *= keep / np.float32(255.0)
    # The weights do not matter to the axes.
    covariance = np.zeros((count, 3, 3), np.float32)
    for a, b in ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)):
        covariance[:, a, b] = covariance[:, b, a] = np.einsum("ni,ni->n", values[a], values[b])
    # The axis of the largest spread comes first.
    axes = np.array([cv2.eigen(own)[2][0] for own in covariance])
    along = (axes[:, None] @ values.transpose(1, 0, 2))[:, 0]
    # `along` is 0 outside the material, and the mean was taken off: only the normal matrix needs the weights.
    normal = (keep @ _PLANE_PRODUCTS.T).reshape(count, 3, 3) + 1e-3 * np.eye(3, dtype=np.float32)
    plane = np.linalg.solve(normal, (along @ _PLANE.T)[:, :, None])[:, :, 0].astype(np.float32)
    along -= plane @ _PLANE
    along *= keep
    skew = np.einsum("ni,ni->n", along * along, along)
    along *= np.where(skew < 0.0, np.float32(-1.0), np.float32(1.0))[:, None]
    return np.asarray(along, np.float32).reshape(-1, SIDE, SIDE)


def _agreement(values: Floats32, deep: Floats32) -> list[Floats32]:
    """How much gradients of tiles (h, N, w) share one axis, and one pair of axes, 0 to 1."""
    dx = values[1:-1, :, 2:] - values[1:-1, :, :-2]
    dy = values[2:, :, 1:-1] - values[:-2, :, 1:-1]
    deep = deep[1:-1, :, 1:-1]
    square = dx * dx - dy * dy
    cross = 2.0 * dx * dy
    squared, crossed = square * square, cross * cross
    power = np.sqrt(squared + crossed)
    total = _dot(power, deep) + np.float32(1e-4)
    one = np.hypot(_dot(square, deep), _dot(cross, deep)) / total
    # The doubled angle once more: (square + i cross)^2 / |.| has four times the direction's angle.
    weight = deep / np.maximum(power, np.float32(1e-9))
    real = _dot(squared - crossed, weight)
    imaginary = 2.0 * _dot(square * cross, weight)
    return [np.asarray(one, np.float32), np.asarray(np.hypot(real, imaginary) / total, np.float32)]


_LEAST_STEP = 0.15
"""A neighbour counts as brighter when it is so by this share of the texture's contrast: noise has no pattern."""


def _histograms(values: Floats32, total: Floats32, deep: Floats32) -> list[Floats32]:
    """Roots of the shares of rotation-invariant uniform patterns 0 to 9, each (N,), where `deep` is not 0."""
    side, count, _ = values.shape
    wide = values.reshape(side, -1)
    across: Floats32 = 0.5 * (wide[:, 1:] + wide[:, :-1])
    down: Floats32 = 0.5 * (wide[1:] + wide[:-1])
    least = np.repeat(_LEAST_STEP * (total + FLOOR), side).astype(np.float32)
    limit = _shifted(wide + least, 0, 0, wide.shape)
    # In their order around the middle; `across` and `down` lie half a pixel further on.
    circle = [(across, 1, 0), (wide, 1, 1), (down, 0, 1), (wide, -1, 1)]
    circle += [(across, -2, 0), (wide, -1, -1), (down, 0, -2), (wide, 1, -1)]
    bits = [(_shifted(picture, x, y, wide.shape) > limit).view(np.uint8) for picture, x, y in circle]
    ones = bits[0].copy()
    changes = bits[-1] ^ bits[0]
    for a, b in pairwise(bits):
        ones += b
        changes += a ^ b
    # One more bin for what does not count.
    bins = _PATTERNS + 1
    np.putmask(ones, changes > 2, np.uint8(9))
    np.putmask(ones, _shifted(deep.reshape(side, -1), 0, 0, wide.shape) == 0.0, np.uint8(_PATTERNS))
    offsets = np.repeat(np.arange(count) * bins, side)[REACH:-REACH]
    shares = np.bincount((ones + offsets).ravel(), minlength=count * bins).reshape(count, bins)[:, :_PATTERNS]
    return list(np.sqrt(shares / np.maximum(_sums(deep), 1.0)[:, None]).astype(np.float32).T)


def _shifted(picture: Floats32, x: int, y: int, shape: tuple[int, ...]) -> Floats32:
    """What lies x to the right of and y below the pixels of a picture of this shape that are not near its border."""
    return picture[REACH + y : shape[0] - REACH + y, REACH + x : shape[1] - REACH + x]


SHIPPED = Path(__file__).with_name("textures.npz")
_DOUBT = -0.15
"""Below this best score a texture is none of the known ones."""


@cache
def _namer() -> Namer:
    return load(SHIPPED)


def names_of(values: Floats32) -> list[str | None]:
    """Names of textures by their descriptors (N, LENGTH); None where none fits."""
    if not len(values):
        return []
    namer = _namer()
    scores = namer.scores(values)
    best = scores.argmax(axis=1)
    return [namer.names[k] if row[k] > _DOUBT else None for row, k in zip(scores, best, strict=True)]

"""What the empty table looks like in a frame, so that what differs from it stands out.

The table's colour is a smooth polynomial of the place (light falls off), its texture and noise a covariance
between the three channels. Both are fitted to the frame itself by weights that shrink on what does not belong
to the table, or taken from a picture of the empty table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Box = tuple[slice, slice]

_SAMPLES = 1500
"""About how many pixels the polynomial and the covariance are fitted to: enough for 2 % of a standard deviation."""
_STRIP = 30_000
"""About how many pixels are worked on at once: so many stay in a processor's cache from one step to the next."""
_NOISE_FLOOR = 1.0
"""Smallest standard deviation (levels) believed: compression makes flat blocks that look free of noise."""
_LEAST = np.eye(3) * _NOISE_FLOOR**2 / 3.0
_ADDED = 1e-6
_UPRIGHT = _ADDED * np.eye(3)


@dataclass(frozen=True, slots=True)
class Whitened:
    """A frame as its difference from the table in units of the table's own variation.

    Attributes:
        difference: ndarray of shape (H, W, 3), dtype float32: whitened difference from the table.
        strength: ndarray of shape (H, W), dtype float32: its length.
        half: ndarray of shape (H // 2, W // 2, 3), dtype float32: it at half the size.
        whitener: ndarray of shape (3, 3): maps a difference in BGR levels to whitened units.
        table_colour: ndarray of shape (3,): the table's mean colour, BGR levels.
        fine: ndarray of shape (3, 3): maps a whitened difference to units of the table's variation from pixel to pixel.
            Texture is mostly gray and coarse, noise fine and of all colours: edges, which are steps between pixels,
            stand out in these units, the gray ones above all.
    """

    difference: Floats32
    strength: Floats32
    half: Floats32
    whitener: Floats
    table_colour: Floats
    fine: Floats


def whiten(image: Floats32, empty: Floats32 | None = None, box: Box | None = None) -> Whitened:
    """The frame's whitened difference from the table.

    Args:
        image: ndarray of shape (H, W, 3), dtype float32, smoothed.
        empty: The same view of the empty table, same shape; None to estimate the table from the frame.
        box: Rows and columns, from even ones on, outside of which the difference is left 0; the table is estimated from
            all of the frame.
    """
    height, width = image.shape[:2]
    step = max(1, int(np.sqrt(height * width / _SAMPLES)))
    grid = slice(step // 2, None, step)
    reference = image if empty is None else image - empty
    samples = _columns(reference[grid, grid])
    coefficients, rest, weight = _robust_surface(samples, _sampled_terms(height, width, step))
    covariance = _robust_covariance(rest, weight) + _LEAST
    whitener = _inverse_root(covariance)
    difference, strength, half = _differences(reference, coefficients, whitener, box)
    colours = samples if empty is None else _columns(image[grid, grid])
    colour = colours @ (weight + np.float32(1e-6)) / (weight.sum() + 1e-6 * len(weight))
    beside = np.minimum(np.arange(step // 2, width, step) + 1, width - 1)
    steps = samples - _columns(reference[grid, beside])
    fine = _inverse_root(_robust_covariance(steps, weight) + _LEAST)
    return Whitened(difference, strength, half, whitener, colour.astype(np.float64), fine @ np.linalg.inv(whitener))


_POWERS = [(i, degree - i) for degree in range(4) for i in range(degree + 1)]
"""Exponents of x and y in the terms of a cubic polynomial: those of each order come after those below."""
_TERMS = (1, 3, 6, 10)
"""How many terms polynomials of order 0, 1, ... have."""
_ORDERS = len(_TERMS)
_ONES = np.ones((1, 3), np.float32)


def _terms(x: Floats, y: Floats) -> Floats32:
    """The terms (10, N) of a cubic polynomial where N columns x and M rows y cross, row by row."""
    across, down = np.tile(x, len(y)), np.repeat(y, len(x))
    xs, ys = (np.stack([np.ones_like(v), v, v * v, v * v * v]) for v in (across, down))
    return np.stack([xs[i] * ys[j] for i, j in _POWERS]).astype(np.float32)


@lru_cache(maxsize=4)
def _sampled_terms(height: int, width: int, step: int) -> Floats32:
    """The terms at every `step`th pixel of an image."""
    y, x = (_places(length)[step // 2 :: step] for length in (height, width))
    return _terms(x, y)


def _places(length: int) -> Floats:
    """Where the pixels of a row or column lie, -0.5 to 0.5."""
    return np.asarray((np.arange(length) + 0.5) / length - 0.5)


@lru_cache(maxsize=4)
def _powers(length: int) -> Floats32:
    """Powers (length, _ORDERS) of those places."""
    return np.asarray(np.vander(_places(length), _ORDERS, increasing=True), np.float32)


def _columns(values: Floats32) -> Floats32:
    """Pixels (H, W, 3) as one row a channel, (3, H * W): rows are summed and sorted much faster than columns."""
    return np.ascontiguousarray(values.reshape(-1, 3).T, np.float32)


def _robust_surface(samples: Floats32, terms: Floats32) -> tuple[Floats, Floats32, Floats32]:
    """Polynomial of growing order through most samples (3, N): coefficients (10, 3), residuals (3, N), weights (N,).

    Args:
        samples: ndarray of shape (3, N), dtype float32, levels.
        terms: ndarray of shape (10, N), dtype float32: the polynomial's terms at each.
    """
    low, width = _shortest(samples)
    rest = samples - (low + 0.5 * width)[:, None]
    weight = np.ones(samples.shape[1], np.float32)
    coefficients = np.zeros((1, 3))
    for order in (1, 1, 1, 2, 2, 3, 3):
        scaled = rest / _scale(rest)[:, None]
        # Weights are Tukey's, zero at three standard deviations of the mean over the channels.
        kept = 1.0 - np.minimum(_squares(scaled) / np.float32(9.0 * len(samples)), 1.0)
        weight = kept * kept
        basis = terms[: _TERMS[order]]
        weighted = basis * weight
        normal = weighted @ basis.T
        normal.flat[:: len(basis) + 1] += 1e-9 * len(weight)
        _, found = cv2.solve(normal.astype(np.float64), (weighted @ samples.T).astype(np.float64))
        coefficients = np.asarray(found, np.float64)
        rest = samples - coefficients.T.astype(np.float32) @ basis
    return coefficients, rest, weight


def _squares(values: Floats32) -> Floats32:
    """Sums (N,) of the squares of each column of (3, N)."""
    return np.asarray(np.einsum("cn,cn->n", values, values), np.float32)


def _scale(rest: Floats32) -> Floats32:
    """Robust standard deviation of each row, from its shortest interval that holds 45 % of the values.

    Unlike the median absolute deviation it is hardly inflated by objects that cover 40 % of the table.
    """
    _, width = _shortest(rest)
    # 45 % of a normal distribution lie within 0.598 standard deviations of the middle.
    return np.asarray(np.maximum(width / np.float32(2.0 * 0.598), 1.0), np.float32)


def _shortest(values: Floats32) -> tuple[Floats32, Floats32]:
    """Start and width of the shortest interval with 45 % of the values, for each row, by every other value."""
    ordered = np.sort(values[:, ::2], axis=1)
    count = max(1, int(0.45 * ordered.shape[1]))
    widths = ordered[:, count:] - ordered[:, :-count]
    best = widths.argmin(axis=1)
    rows = np.arange(len(ordered))
    return ordered[rows, best], widths[rows, best]


def _differences(
    reference: Floats32, coefficients: Floats, whitener: Floats, box: Box | None
) -> tuple[Floats32, Floats32, Floats32]:
    """Whitened differences (H, W, 3) of a picture from a polynomial (10, 3), their lengths (H, W), and half their size.

    Outside of the box all are 0.
    """
    height, width = reference.shape[:2]
    make = np.empty if box is None else np.zeros
    difference, strength = make(reference.shape, np.float32), make((height, width), np.float32)
    half = make((height // 2, width // 2, 3), np.float32)
    rows, columns = box or (slice(0, height), slice(0, width))
    first, last, _ = rows.indices(height)
    matrix = whitener.astype(np.float32)
    # A polynomial in x for each power of y, channel by channel.
    terms = np.zeros((_ORDERS, _ORDERS, 3), np.float32)
    for (i, j), values in zip(_POWERS, coefficients, strict=True):
        terms[j, i] = values
    own = _powers(width)[columns]
    across, down = (own @ terms).reshape(_ORDERS, -1), _powers(height)
    left, wide = columns.indices(width)[0] // 2, len(own) // 2
    step = 2 * max(1, _STRIP // (2 * len(own)))
    for top in range(first, last, step):
        strip = slice(top, min(top + step, last)), columns
        work = np.asarray((down[strip[0]] @ across).reshape(-1, len(own), 3), np.float32)
        cv2.subtract(reference[strip], work, dst=work)
        part = cv2.transform(work, matrix, dst=difference[strip])
        cv2.multiply(part, part, dst=work)
        length = cv2.transform(work, _ONES, dst=strength[strip])
        cv2.sqrt(length, dst=length)
        high = len(work) // 2
        if min(high, wide) > 0:
            into = half[top // 2 : top // 2 + high, left : left + wide]
            cv2.resize(part[: 2 * high, : 2 * wide], (wide, high), dst=into, interpolation=cv2.INTER_LINEAR)
    return difference, strength, half


def _robust_covariance(rest: Floats32, weight: Floats32) -> Floats:
    """Covariance (3, 3) of what belongs to the table among rows (3, N), by three rounds of trimming at 3 sigma."""
    keep = (weight > 0.0).astype(np.float32)
    covariance = np.eye(3)
    for _ in range(3):
        count = float(keep.sum())
        if count < 20.0:
            break
        # 3-sigma trimming of a 3-D normal keeps 97 %; what is lost is far below the texture's variation.
        chosen = rest * keep
        mean = chosen.sum(axis=1) / count
        covariance = (chosen @ rest.T - count * np.outer(mean, mean)) / (count - 1.0) + _UPRIGHT
        far = _squares(_inverse_root(covariance).astype(np.float32) @ rest)
        keep = (far < 9.0 + 2.2).astype(np.float32)
    return np.asarray(covariance)


def _inverse_root(covariance: Floats) -> Floats:
    """Inverse of the lower Cholesky factor of a covariance (3, 3), by its formulas: a call of LAPACK costs far more."""
    (xx, _, _), (xy, yy, _), (xz, yz, zz) = covariance.tolist()
    a = math.sqrt(xx)
    b, c = xy / a, xz / a
    # Of channels that are nearly alike rounding may leave less than was added to the diagonal.
    d = math.sqrt(max(yy - b * b, _ADDED))
    e = (yz - b * c) / d
    f = math.sqrt(max(zz - c * c - e * e, _ADDED))
    return np.array([
        [1.0 / a, 0.0, 0.0],
        [-b / (a * d), 1.0 / d, 0.0],
        [(b * e / d - c) / (a * f), -e / (d * f), 1.0 / f],
    ])  # fmt: skip

"""What the empty table looks like in a frame, so that what differs from it stands out.

The table's colour is a smooth polynomial of the place (light falls off), its texture and noise a covariance
between the three channels. Both are fitted to the frame itself by weights that shrink on what does not belong
to the table, or taken from a picture of the empty table.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Box = tuple[slice, slice]

_SAMPLES = 1500
"""About how many pixels the polynomial and the covariance are fitted to: enough for 2 % of a standard deviation."""
_NOISE_FLOOR = 1.0
"""Smallest standard deviation (levels) believed: compression makes flat blocks that look free of noise."""


@dataclass(frozen=True, slots=True)
class Whitened:
    """A frame as its difference from the table in units of the table's own variation.

    Attributes:
        difference: ndarray of shape (H, W, 3), dtype float32: whitened difference from the table.
        whitener: ndarray of shape (3, 3): maps a difference in BGR levels to whitened units.
        table_colour: ndarray of shape (3,): the table's mean colour, BGR levels.
    """

    difference: Floats32
    whitener: Floats
    table_colour: Floats


def whiten(image: Floats32, empty: Floats32 | None = None, box: Box | None = None) -> Whitened:
    """The frame's whitened difference from the table.

    Args:
        image: ndarray of shape (H, W, 3), dtype float32, smoothed.
        empty: The same view of the empty table, same shape; None to estimate the table from the frame.
        box: Rows and columns outside of which the difference is left 0; the table is estimated from all of the frame.
    """
    height, width = image.shape[:2]
    step = max(1, int(np.sqrt(height * width / _SAMPLES)))
    ys, xs = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    ys, xs = ys.ravel(), xs.ravel()
    reference = image if empty is None else image - empty
    samples = reference[ys, xs].astype(np.float64)
    coefficients, order, weight = _robust_surface(samples, xs / width - 0.5, ys / height - 0.5)
    surface = _surface(coefficients, order, height, width)
    rest = (reference[ys, xs] - surface[ys, xs]).astype(np.float64)
    covariance = _robust_covariance(rest, weight) + np.eye(3) * _NOISE_FLOOR**2 / 3.0
    whitener = np.linalg.inv(np.linalg.cholesky(covariance))
    matrix = whitener.astype(np.float32)
    if box is None:
        out = np.asarray(cv2.transform(cv2.subtract(reference, surface), matrix), np.float32)
    else:
        out = np.zeros(image.shape, np.float32)
        out[box] = cv2.transform(cv2.subtract(reference[box], surface[box]), matrix)
    colour = np.average(image[ys, xs], axis=0, weights=weight + 1e-9)
    return Whitened(out, whitener, np.asarray(colour, np.float64))


def _powers(order: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]


def _robust_surface(samples: Floats, x: Floats, y: Floats) -> tuple[Floats, int, Floats]:
    """Polynomial of growing order through most samples; returns coefficients, order and final weights."""
    low, width = _shortest(samples)
    start = low + 0.5 * width
    rest = samples - start
    weight = np.ones(len(samples))
    coefficients, order = start[None], 0
    for order in (1, 1, 1, 2, 2, 3, 3):
        spread = np.sqrt(np.sum((rest / _scale(rest)) ** 2, axis=1) / samples.shape[1])
        ratio = np.minimum(spread / 3.0, 1.0)
        weight = (1.0 - ratio**2) ** 2
        basis = np.stack([x**i * y**j for i, j in _powers(order)], axis=1)
        weighted = basis * weight[:, None]
        normal = weighted.T @ basis + np.eye(basis.shape[1]) * 1e-9 * len(samples)
        coefficients = np.linalg.solve(normal, weighted.T @ samples)
        rest = samples - basis @ coefficients
    return coefficients, order, weight


def _scale(rest: Floats) -> Floats:
    """Robust standard deviation of each column, from its shortest interval that holds 45 % of the values.

    Unlike the median absolute deviation it is hardly inflated by objects that cover 40 % of the table.
    """
    _, width = _shortest(rest)
    # 45 % of a normal distribution lie within 0.598 standard deviations of the middle.
    return np.asarray(np.maximum(width / (2.0 * 0.598), 1.0))


def _shortest(values: Floats) -> tuple[Floats, Floats]:
    """Start and width of the shortest interval with 45 % of the values, for each column."""
    # Rows are sorted much faster than columns.
    ordered = np.sort(np.ascontiguousarray(values.T), axis=1)
    count = max(1, int(0.45 * ordered.shape[1]))
    widths = ordered[:, count:] - ordered[:, :-count]
    best = widths.argmin(axis=1)
    columns = np.arange(len(ordered))
    return ordered[columns, best], widths[columns, best]


def _surface(coefficients: Floats, order: int, height: int, width: int) -> Floats32:
    """The polynomial at every pixel, by way of a coarse grid: it is smooth."""
    rows, cols = 19, 33
    y, x = np.mgrid[0:rows, 0:cols]
    px = (x + 0.5) / cols - 0.5
    py = (y + 0.5) / rows - 0.5
    basis = np.stack([px**i * py**j for i, j in _powers(order)], axis=2)
    grid = (basis @ coefficients).astype(np.float32)
    # Bilinear resizing replicates the rim of half a cell; cubic surfaces bend little there.
    return np.asarray(cv2.resize(grid, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _robust_covariance(rest: Floats, weight: Floats) -> Floats:
    """Covariance of what belongs to the table, by three rounds of trimming at 3 sigma."""
    keep = weight > 0.0
    covariance = np.eye(3)
    for _ in range(3):
        chosen = rest[keep]
        if len(chosen) < 20:
            break
        # 3-sigma trimming of a 3-D normal keeps 97 %; what is lost is far below the texture's variation.
        covariance = np.cov(chosen.T) + np.eye(3) * 1e-6
        distance = np.einsum("ni,ij,nj->n", rest, np.linalg.inv(covariance), rest, optimize=True)
        keep = distance < 9.0 + 2.2
    return np.asarray(covariance)

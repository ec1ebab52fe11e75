"""The paper's three variables of an object, from its binary picture, and the classes made of their ranges."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Descriptors, Shape
from controller.vision.morphology import Mask, boundary, bwarea, chain_length
from controller.vision.recipe import Ranges

Floats = NDArray[np.float64]


def describe(mask: Mask) -> Descriptors:
    """Extent, compactness and side difference of the one component in a mask that is cut to its bounding box.

    Extent is the bounding box's area over `bwarea`, compactness the squared length of the boundary chain over
    4 pi `bwarea`. Source: the paper, section III and equation (1).
    """
    covered = bwarea(mask)
    length = chain_length(boundary(mask))
    return Descriptors(
        extent=mask.size / covered,
        compactness=length**2 / (4.0 * math.pi * covered),
        side_difference=side_difference(corners(mask)),
    )


def corners(mask: Mask, count: int = 4) -> Floats:
    """The strongest corners (N, 2) of a mask, (x, y), strongest first (`corner`, Harris).

    Gradients are central differences, smoothed by a 5 x 5 Gaussian of sigma 1.5; the response is
    det - 0.04 trace^2; local maxima of at least 1 % of the strongest count.

    Source: Harris and Stephens, Alvey Vision Conference, 1988.
    """
    rim = 4
    values = np.pad(mask, rim).astype(np.float64)
    dx = np.zeros_like(values)
    dy = np.zeros_like(values)
    dx[:, 1:-1] = values[:, 2:] - values[:, :-2]
    dy[1:-1] = values[2:] - values[:-2]
    kernel = cv2.getGaussianKernel(5, 1.5, cv2.CV_64F)
    xx, yy, xy = (
        cv2.sepFilter2D(part, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
        for part in (dx * dx, dy * dy, dx * dy)
    )
    response = xx * yy - xy * xy - 0.04 * (xx + yy) ** 2
    highest = cv2.dilate(response, np.ones((3, 3), np.uint8))
    peak = (response >= highest) & (response > 0.01 * max(float(response.max()), 1e-12))
    ys, xs = np.nonzero(peak)
    order = np.argsort(-response[ys, xs], kind="stable")[:count]
    return np.stack([xs[order] - rim, ys[order] - rim], axis=1).astype(np.float64)


def side_difference(points: Floats) -> float:
    """Absolute difference of two adjacent sides of the polygon through corners (N, 2), px; 0 with fewer than 3."""
    if len(points) < 3:
        return 0.0
    around = points - points.mean(axis=0)
    ordered = points[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]
    sides = np.linalg.norm(np.roll(ordered, -1, axis=0) - ordered, axis=1)
    return float(abs(sides[0] - sides[1]))


def classify(values: Descriptors, area: float, ranges: Ranges) -> Shape:
    """The class whose ranges the variables fall into, or OTHER."""
    if values.extent < ranges.four_sided_extent:
        square = values.side_difference < ranges.square_difference * math.sqrt(area)
        return Shape.SQUARE if square else Shape.RECTANGLE
    if values.extent < ranges.circle_extent and values.compactness < ranges.circle_compactness:
        return Shape.CIRCLE
    low, high = ranges.hexagon_extent
    low_c, high_c = ranges.hexagon_compactness
    if low <= values.extent < high and low_c <= values.compactness < high_c:
        return Shape.HEXAGON
    return Shape.OTHER

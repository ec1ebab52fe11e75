"""Upright prisms: their footprints, and what a fit to an outline says of one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape

Array = NDArray[np.float64]

#: Vertices of the polygon that stands for a circle; its circumradius is enlarged to keep the area.
CIRCLE_VERTICES = 96


@dataclass(frozen=True, slots=True)
class Noise:
    """What is known about outlines and parts beforehand.

    Attributes:
        point: Independent error of an outline point, px.
        edge: Error shared by a whole edge (light, shadow, blur), px; it sets the accuracy.
        height: Standard deviation of a part's stated height, mm.
        tail: Residual from which on a point counts less, px.
    """

    point: float = 0.1
    edge: float = 0.1
    height: float = 0.5
    tail: float = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class PrismFit:
    """A prism that explains an outline.

    Attributes:
        center: (x, y) of the footprint's centroid, mm, `table`.
        yaw: rad, as `LocatedObject.yaw`; None for a circle.
        dimensions: Side (square, hexagon, triangle), (long, short) (rectangle) or diameter, mm.
        height: mm.
        covariance: ndarray of shape (2, 2) of the centre, mm^2.
        residuals: ndarray of shape (N,), px, outwards positive, of all outline points.
        edges: ndarray of shape (N,): the silhouette edge each point belongs to.
        used: ndarray of shape (N,), bool: points away from corners, which the fit rests on.
    """

    center: tuple[float, float]
    yaw: float | None
    dimensions: tuple[float, ...]
    height: float
    covariance: Array
    residuals: Array
    edges: NDArray[np.int64]
    used: NDArray[np.bool_]

    @property
    def cost(self) -> float:
        """Mean of min(|r|, 2 px) over all points: bounded, so that starts can be compared."""
        return float(np.minimum(np.abs(self.residuals), 2.0).mean())


@cache
def unit_footprint(shape: Shape) -> Array:
    """Vertices (K, 2, D) of the footprint at yaw 0, counter-clockwise, per mm of each dimension; not to be changed."""
    unit = _unit_footprint(shape)
    unit.flags.writeable = False
    return unit


def _unit_footprint(shape: Shape) -> Array:
    if shape in (Shape.SQUARE, Shape.RECTANGLE):
        box = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        if shape is Shape.SQUARE:
            return box[:, :, None]
        return np.stack([box * [1.0, 0.0], box * [0.0, 1.0]], axis=2)
    if shape is Shape.TRIANGLE:
        low = -math.sqrt(3) / 6
        return np.array([[-0.5, low], [0.5, low], [0.0, math.sqrt(3) / 3]])[:, :, None]
    count, radius = (6, 1.0) if shape is Shape.HEXAGON else (CIRCLE_VERTICES, 0.5)
    if shape is Shape.CIRCLE:
        step = 2 * math.pi / count
        radius *= math.sqrt(step / math.sin(step))
    turn = 2 * math.pi * np.arange(count) / count
    return (radius * np.column_stack([np.cos(turn), np.sin(turn)]))[:, :, None]


def footprint(shape: Shape, center: tuple[float, float], yaw: float | None, dimensions: tuple[float, ...]) -> Array:
    """Vertices (K, 2) of a footprint on the table, mm, counter-clockwise."""
    c, s = math.cos(yaw or 0.0), math.sin(yaw or 0.0)
    local = unit_footprint(shape) @ np.asarray(dimensions)
    return np.asarray(local @ np.array([[c, s], [-s, c]]) + np.asarray(center))


def bounding_size(shape: Shape, dimensions: tuple[float, ...]) -> tuple[float, float]:
    """(long, short) side of the footprint's minimum-area rectangle, mm."""
    first = dimensions[0]
    if shape is Shape.RECTANGLE:
        return max(dimensions), min(dimensions)
    if shape is Shape.HEXAGON:
        return 2.0 * first, math.sqrt(3) * first
    if shape is Shape.TRIANGLE:
        return first, math.sqrt(3) / 2 * first
    return first, first

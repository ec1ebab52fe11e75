"""The silhouette of an upright prism, and the fit of its pose, size and height to an outline.

Seen from above, a part shows its top face and some of its sides, so its outline is neither its footprint
nor its top: it is the hull of both polygons as the camera sees them. Fitting that hull removes the shift
of several mm that parallax causes at 20 mm of height (z = 0 and z = h are equally wrong; z = h/2 is the
start value). The lens is undone first, so that edges are straight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from controller.geometry import CameraModel, invert, wrap

Array = NDArray[np.float64]

#: Vertices of the polygon that stands for a circle; its circumradius is enlarged to keep the area.
CIRCLE_VERTICES = 96
#: Parts of a circle's outline that a shadow or lamp shifts independently.
_ARCS = 6
#: Outline points this close to a silhouette corner, px, are left out: blur rounds corners.
_CORNER = 3.0
_ROUNDS = 25


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


def unit_footprint(shape: Shape) -> Array:
    """Vertices (K, 2, D) of the footprint at yaw 0, counter-clockwise, per mm of each dimension."""
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


class Silhouette:
    """One outline seen by one camera, ready to be compared with prisms.

    Everything happens in a plane that is the image with its lens undone, scaled so that distances near
    this outline are px.
    """

    def __init__(self, outline_px: Array, camera: CameraModel, T_table_camera: Array) -> None:
        rays = camera.rays(outline_px)[:, :2]
        self._origin = rays.mean(axis=0)
        step = 1e-4
        around = self._origin + np.array([[0.0, 0.0], [step, 0.0], [0.0, step]])
        seen = camera.project(np.column_stack([around, np.ones(3)]))
        self._local = np.column_stack([seen[1] - seen[0], seen[2] - seen[0]]) / step
        T_camera_table = invert(T_table_camera)
        self._R, self._t = T_camera_table[:3, :3], T_camera_table[:3, 3]
        self.points = (rays - self._origin) @ self._local.T

    def fit(
        self,
        shape: Shape,
        start: tuple[float, float, float],
        dimensions: tuple[float, ...],
        height: float,
        noise: Noise,
    ) -> PrismFit:
        """Least squares from one start (x, y, yaw); the height is held to the stated one by its prior."""
        model = _Model(shape, self._R, self._t, self._local, self._origin)
        parameters = np.array([*start, *dimensions, height])
        free = np.ones(len(parameters), bool)
        free[2] = shape is not Shape.CIRCLE
        last = np.inf
        for _ in range(_ROUNDS):
            residuals, jacobian, edges, used = model.compare(self.points, parameters)
            weights = _weights(residuals, edges, used, noise, shape)
            rows = jacobian[:, free] * weights[:, None]
            normal = rows.T @ rows
            right = rows.T @ (weights * residuals)
            normal[-1, -1] += 1.0 / noise.height**2
            right[-1] += (height - parameters[-1]) / noise.height**2
            step = np.linalg.solve(normal + 1e-9 * np.eye(len(normal)), right)
            # A step never leaves the neighbourhood in which the assignment of points to edges holds.
            longest = np.abs(step).max()
            if longest > 5.0:
                step *= 5.0 / longest
            parameters[free] += step
            parameters[3:] = np.maximum(parameters[3:], 1.0)
            if np.abs(step).max() < 1e-4 or (np.abs(step).max() < 1e-2 and np.abs(step).max() > 0.9 * last):
                break
            last = float(np.abs(step).max())
        residuals, jacobian, edges, used = model.compare(self.points, parameters)
        weights = _weights(residuals, edges, used, noise, shape)
        rows = jacobian[:, free] * weights[:, None]
        normal = rows.T @ rows
        normal[-1, -1] += 1.0 / noise.height**2
        covariance = np.asarray(np.linalg.inv(normal + 1e-9 * np.eye(len(normal)))[:2, :2], np.float64)
        sides = tuple(float(d) for d in parameters[3:-1])
        yaw: float | None = float(parameters[2])
        if shape is Shape.RECTANGLE and sides[1] > sides[0]:
            sides, yaw = (sides[1], sides[0]), float(parameters[2]) + math.pi / 2
        period = shape.period
        return PrismFit(
            (float(parameters[0]), float(parameters[1])),
            None if period is None or yaw is None else wrap(yaw, period),
            sides,
            float(parameters[-1]),
            covariance,
            residuals,
            edges,
            used,
        )


class _Model:
    """Silhouette of a prism in the undone image, with its derivatives."""

    def __init__(self, shape: Shape, R: Array, t: Array, local: Array, origin: Array) -> None:
        self._unit = unit_footprint(shape)
        self._smooth = shape is Shape.CIRCLE
        self._R, self._t, self._local, self._origin = R, t, local, origin

    def vertices(self, parameters: Array) -> tuple[Array, Array]:
        """Vertices (2K, 2), foot then top, and their derivatives (2K, 2, P)."""
        x, y, yaw = parameters[:3]
        dimensions, height = parameters[3:-1], parameters[-1]
        c, s = math.cos(yaw), math.sin(yaw)
        turn, turned = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
        local = self._unit @ dimensions
        level = np.repeat([0.0, 1.0], len(local))
        points = np.column_stack([np.tile(local @ turn.T + [x, y], (2, 1)), level * height])
        slopes = np.zeros((len(points), 3, len(parameters)))
        slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
        slopes[:, :2, 2] = np.tile(local @ turned.T, (2, 1))
        slopes[:, :2, 3:-1] = np.tile(np.einsum("ij,kjd->kid", turn, self._unit), (2, 1, 1))
        slopes[:, 2, -1] = level
        inside = points @ self._R.T + self._t
        flat = inside[:, :2] / inside[:, 2:]
        through = np.zeros((len(points), 2, 3))
        through[:, 0, 0] = through[:, 1, 1] = 1.0
        through[:, :, 2] = -flat
        through /= inside[:, 2, None, None]
        derivative = (self._local @ (through @ self._R)) @ slopes
        return (flat - self._origin) @ self._local.T, derivative

    def compare(self, points: Array, parameters: Array) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.bool_]]:
        """Distances (N,) of points from the silhouette (outwards positive), their derivatives, edges, use."""
        corners, slopes = self.vertices(parameters)
        hull = np.asarray(cv2.convexHull(corners.astype(np.float32), returnPoints=False)).ravel()
        a, b = hull, np.roll(hull, -1)
        along = corners[b] - corners[a]
        length = np.linalg.norm(along, axis=1)
        along = along / length[:, None]
        normal = np.column_stack([along[:, 1], -along[:, 0]])
        if _signed_area(corners[hull]) < 0.0:
            normal = -normal
        distances = points @ normal.T - np.einsum("ij,ij->i", corners[a], normal)
        edge = distances.argmax(axis=1)
        rows = np.arange(len(points))
        residual = distances[rows, edge]
        place = np.einsum("ij,ij->i", points - corners[a[edge]], along[edge])
        share = np.clip(place / length[edge], 0.0, 1.0)[:, None]
        from_a = np.einsum("mi,mip->mp", normal, slopes[a])
        from_b = np.einsum("mi,mip->mp", normal, slopes[b])
        # d(point - silhouette) = -normal . d(silhouette); the fit moves the silhouette towards the points.
        jacobian = (1.0 - share) * from_a[edge] + share * from_b[edge]
        used = (place > _CORNER) & (place < length[edge] - _CORNER) | self._smooth
        return residual, jacobian, edge, used


def _signed_area(polygon: Array) -> float:
    x, y = polygon[:, 0], polygon[:, 1]
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)


def _weights(
    residuals: Array, edges: NDArray[np.int64], used: NDArray[np.bool_], noise: Noise, shape: Shape
) -> Array:
    """Inverse standard deviations, so that an edge counts for its shared shift, not for its many points."""
    if shape is Shape.CIRCLE:
        sharing = np.full(len(residuals), len(residuals) / _ARCS)
    else:
        counts = np.bincount(edges[used], minlength=int(edges.max()) + 1)
        sharing = counts[edges].astype(np.float64)
    weights = 1.0 / np.sqrt(noise.point**2 + noise.edge**2 * sharing)
    weights *= np.sqrt(np.minimum(1.0, noise.tail / np.maximum(np.abs(residuals), 1e-12)))
    return np.where(used, weights, 0.0)

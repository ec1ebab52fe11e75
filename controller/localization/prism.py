"""The silhouette of an upright prism, and the fit of its pose, size and height to an outline.

Seen from above, a part shows its top face and some of its sides, so its outline is neither its footprint
nor its top: it is the hull of both polygons as the camera sees them. Fitting that hull removes the shift
of several mm that parallax causes at 20 mm of height (z = 0 and z = h are equally wrong; z = h/2 is the
start value). The lens is undone first, so that edges are straight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

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
#: A prism that explains its outline is found in two to eight rounds; one that does not may wander for ever.
_ROUNDS = 12
#: A step that moves no corner further than this, mm, is the last: the next one is smaller by orders of magnitude.
_SETTLED = 1e-3
#: So is one below this that is hardly shorter than the one before: points change edges to and fro.
_WAVERING = 1e-2


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
        free = np.arange(len(parameters)) if shape is not Shape.CIRCLE else np.array([0, 1, 3, 4])
        certain = 1.0 / noise.height**2
        ridge = 1e-9 * np.eye(len(free))
        last = math.inf
        for _ in range(_ROUNDS):
            residuals, jacobian, edges, used = model.compare(self.points, parameters)
            weights = _weights(residuals, edges, used, noise, shape)
            rows = jacobian[:, free] * weights[:, None]
            normal = rows.T @ rows + ridge
            right = rows.T @ (weights * residuals)
            normal[-1, -1] += certain
            right[-1] += (height - parameters[-1]) * certain
            step = np.zeros(len(parameters))
            step[free] = np.linalg.solve(normal, right)
            # A step never leaves the neighbourhood in which the assignment of points to edges holds.
            longest = float(np.abs(step).max())
            if longest > 5.0:
                step *= 5.0 / longest
            parameters += step
            np.maximum(parameters[3:], 1.0, out=parameters[3:])
            moved = max(longest, abs(float(step[2])) * float(parameters[3]))
            if moved < _SETTLED or 0.9 * last < moved < _WAVERING:
                residuals = residuals - jacobian @ step
                break
            last = moved
        else:
            residuals, jacobian, edges, used = model.compare(self.points, parameters)
        covariance = np.asarray(np.linalg.inv(normal)[:2, :2], np.float64)
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
        # Homogeneous pixels of the undone image: (u w, v w, w) = matrix @ point + offset.
        to_pixels = np.vstack([np.column_stack([local, -local @ origin]), [0.0, 0.0, 1.0]])
        self._matrix, self._offset = to_pixels @ R, to_pixels @ t
        count, _, sizes = self._unit.shape
        self._points = np.zeros((2 * count, 3))
        # Derivatives of the vertices on the table by x, y, yaw, dimensions and height: the first two never change.
        self._slopes = np.zeros((2 * count, 3, 4 + sizes))
        self._slopes[:, 0, 0] = self._slopes[:, 1, 1] = 1.0
        self._slopes[count:, 2, -1] = 1.0

    def vertices(self, parameters: Array) -> tuple[Array, Array]:
        """Vertices (2K, 2), foot then top, and their derivatives (2K, 2, P)."""
        c, s = math.cos(parameters[2]), math.sin(parameters[2])
        turn, turned = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
        local = self._unit @ parameters[3:-1]
        count = len(local)
        points, slopes = self._points, self._slopes
        points[:count, :2] = points[count:, :2] = local @ turn.T + parameters[:2]
        points[count:, 2] = parameters[-1]
        slopes[:count, :2, 2] = slopes[count:, :2, 2] = local @ turned.T
        slopes[:count, :2, 3:-1] = slopes[count:, :2, 3:-1] = turn @ self._unit
        seen = points @ self._matrix.T + self._offset
        inverse = 1.0 / seen[:, 2]
        flat = seen[:, :2] * inverse[:, None]
        moved = self._matrix @ slopes
        return flat, (moved[:, :2] - flat[:, :, None] * moved[:, 2:]) * inverse[:, None, None]

    def compare(self, points: Array, parameters: Array) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.bool_]]:
        """Distances (N,) of points from the silhouette (outwards positive), their derivatives, edges, use."""
        corners, slopes = self.vertices(parameters)
        a = cv2.convexHull(corners.astype(np.float32), returnPoints=False).ravel()
        b = np.append(a[1:], a[:1])
        start = corners[a]
        along = corners[b] - start
        sense = math.copysign(1.0, start[:, 0] @ along[:, 1] - start[:, 1] @ along[:, 0])
        length = np.sqrt((along * along).sum(axis=1))
        along /= length[:, None]
        normal = along[:, ::-1] * (sense, -sense)
        distances = points @ normal.T - (start * normal).sum(axis=1)
        edge = distances.argmax(axis=1)
        residual = distances[np.arange(len(points)), edge]
        reach = length[edge]
        place = ((points - start[edge]) * along[edge]).sum(axis=1)
        share = np.minimum(np.maximum(place / reach, 0.0), 1.0)
        from_a = (normal[:, None] @ slopes[a])[:, 0]
        onwards = (normal[:, None] @ slopes[b])[:, 0] - from_a
        # d(point - silhouette) = -normal . d(silhouette); the fit moves the silhouette towards the points.
        jacobian = from_a[edge] + share[:, None] * onwards[edge]
        used = (place > _CORNER) & (place < reach - _CORNER) | self._smooth
        return residual, jacobian, edge, used


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

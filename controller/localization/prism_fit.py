"""The fit of upright prisms to outlines: pose, size and height of many parts at once.

Seen from above, a part shows its top face and some of its sides, so its outline is neither its footprint nor its top:
it is the hull of both polygons as the camera sees them. Fitting that hull removes the shift of several mm that
parallax causes at 20 mm of height (z = 0 and z = h are equally wrong; z = h/2 is the start value). The lens is undone
first, so that edges are straight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from controller.geometry import CameraModel, invert, wrap
from controller.localization.prism import Noise, PrismFit, unit_footprint

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

_ARCS = 6
"""Parts of a circle's outline that a shadow or lamp shifts independently."""
_CORNER = 3.0
"""Outline points this close to a silhouette corner, px, are left out: blur rounds corners."""
_ROUNDS = 12
"""A prism that explains its outline is found in two to eight rounds; one that does not may wander for ever."""
_SETTLED = 1e-3
"""A step that moves no corner further than this, mm, is the last: the next one is smaller by orders of magnitude."""
_WAVERING = 1e-2
"""So is one below this that is hardly shorter than the one before: points change edges to and fro."""
_LONGEST = 5.0
"""A step, mm, never leaves the neighbourhood in which the assignment of points to edges holds."""
_PARAMETERS = 6
"""x, y, yaw, two dimensions and the height: what a shape lacks stays as it is."""
_CORNERS = 6
"""Corners of a polygon's footprint at most; those of few are repeated."""
_RIDGE = 1e-9 * np.eye(_PARAMETERS)


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where the fit of a prism to an outline starts.

    Attributes:
        outline_px: ndarray of shape (N, 2), px.
        shape: Of the prism.
        place: (x, y, yaw), mm and rad, `table`.
        dimensions: As those of a `PrismFit`.
        height: Stated, mm: the fitted one is held to it by its prior.
    """

    outline_px: Array
    shape: Shape
    place: tuple[float, float, float]
    dimensions: tuple[float, ...]
    height: float


def fit_prisms(starts: Sequence[Start], camera: CameraModel, T_table_camera: Array, noise: Noise) -> list[PrismFit]:
    """Least squares from each start, by Gauss-Newton steps of all prisms at once.

    Args:
        starts: The outlines and where to begin.
        camera: That took the picture.
        T_table_camera: ndarray of shape (4, 4), maps `camera` into `table`.
        noise: What is known about outlines and heights.
    """
    fits: dict[int, PrismFit] = {}
    for smooth in (False, True):
        chosen = [i for i, start in enumerate(starts) if (start.shape is Shape.CIRCLE) is smooth]
        if chosen:
            own = [starts[i] for i in chosen]
            found = _Descent(own, silhouettes(own, camera, T_table_camera), noise).fits()
            fits.update(zip(chosen, found, strict=True))
    return [fits[i] for i in range(len(starts))]


@dataclass(frozen=True, slots=True, eq=False)
class Silhouettes:
    """K outlines seen by one camera, and the prisms to be compared with them; all are circular, or none is.

    Everything happens in a plane that is the image with its lens undone, scaled so that distances near each outline
    are px.

    Attributes:
        points: ndarray of shape (K, N, 2), px: the outlines, what one has less than others filled up.
        given: ndarray of shape (K, N), bool: which of them are no filling.
        matrix: ndarray of shape (K, 3, 3), and
        offset: ndarray of shape (K, 3): (u w, v w, w) of a point of the table in that plane is matrix @ point + offset.
        unit: ndarray of shape (K, V, 2, 2): corners of each footprint at yaw 0, per mm of each dimension.
        smooth: The prisms are circular: they have no corners, and no yaw.
    """

    points: Array
    given: NDArray[np.bool_]
    matrix: Array
    offset: Array
    unit: Array
    smooth: bool

    def some(self, rows: Rows) -> Silhouettes:
        """Some of them."""
        return replace(
            self, points=self.points[rows], given=self.given[rows], matrix=self.matrix[rows],
            offset=self.offset[rows], unit=self.unit[rows],
        )  # fmt: skip

    def corners(self, parameters: Array) -> tuple[Array, Array]:
        """Corners (K, 2 V, 2), foot then top, of prisms with parameters (K, 6); their derivatives (K, 2, 2 V, 6)."""
        count, half = self.unit.shape[:2]
        c, s = np.cos(parameters[:, 2]), np.sin(parameters[:, 2])
        turn = np.stack([c, -s, s, c], axis=1).reshape(count, 2, 2)
        turned = np.stack([-s, -c, c, -s], axis=1).reshape(count, 2, 2)
        local = (self.unit @ parameters[:, None, 3:5, None])[..., 0]
        points = np.zeros((count, 2 * half, 3))
        points[:, :half, :2] = points[:, half:, :2] = local @ turn.transpose(0, 2, 1) + parameters[:, None, :2]
        points[:, half:, 2] = parameters[:, None, 5]
        # The coordinates come first: one product maps them for all corners.
        slopes = np.zeros((count, 3, 2 * half, _PARAMETERS))
        slopes[:, 0, :, 0] = slopes[:, 1, :, 1] = slopes[:, 2, half:, 5] = 1.0
        if not self.smooth:
            slopes[:, :2, :half, 2] = slopes[:, :2, half:, 2] = turned @ local.transpose(0, 2, 1)
        wider = (turn @ self.unit.transpose(0, 2, 1, 3).reshape(count, 2, -1)).reshape(count, 2, half, 2)
        slopes[:, :2, :half, 3:5] = slopes[:, :2, half:, 3:5] = wider
        seen = points @ self.matrix.transpose(0, 2, 1) + self.offset[:, None]
        inverse = 1.0 / seen[..., 2:]
        flat = seen[..., :2] * inverse
        moved = (self.matrix @ slopes.reshape(count, 3, -1)).reshape(slopes.shape)
        across = flat.transpose(0, 2, 1)[..., None]
        return flat, (moved[:, :2] - across * moved[:, 2:]) * inverse.transpose(0, 2, 1)[..., None]

    def compare(self, parameters: Array) -> tuple[Array, Array, Rows, NDArray[np.bool_]]:
        """Points against the silhouettes of prisms with parameters (K, 6).

        Returns:
            Distances (K, N), px, outwards positive; their derivatives (K, N, 6); the edge each point belongs to; which
            points lie away from corners.
        """
        corners, slopes = self.corners(parameters)
        begin, end = _hulls(corners)
        row = np.arange(len(corners))[:, None]
        start = corners[row, begin]
        along = corners[row, end] - start
        length = np.hypot(along[..., 0], along[..., 1])
        along /= length[..., None]
        normal = along[..., ::-1] * (1.0, -1.0)
        distances = self.points @ normal.transpose(0, 2, 1) - np.vecdot(start, normal)[:, None]
        edge = distances.argmax(axis=2)
        residual = np.take_along_axis(distances, edge[..., None], axis=2)[..., 0]
        reach = length[row, edge]
        place = np.vecdot(self.points - start[row, edge], along[row, edge])
        share = np.minimum(np.maximum(place / reach, 0.0), 1.0)
        x, y = normal[..., :1], normal[..., 1:]
        from_a = x * slopes[row, 0, begin] + y * slopes[row, 1, begin]
        onwards = x * slopes[row, 0, end] + y * slopes[row, 1, end] - from_a
        # d(point - silhouette) = -normal . d(silhouette); the fit moves the silhouette towards the points.
        jacobian = from_a[row, edge] + share[..., None] * onwards[row, edge]
        if self.smooth:
            return residual, jacobian, edge, self.given
        return residual, jacobian, edge, (place > _CORNER) & (place < reach - _CORNER) & self.given


def silhouettes(starts: Sequence[Start], camera: CameraModel, T_table_camera: Array) -> Silhouettes:
    """The outlines of some starts, as `Silhouettes`."""
    counts = np.array([len(start.outline_px) for start in starts])
    given = np.arange(counts.max()) < counts[:, None]
    rays = np.zeros((*given.shape, 2))
    rays[given] = camera.rays(np.concatenate([start.outline_px for start in starts]))[:, :2]
    origin = rays.sum(axis=1) / counts[:, None]
    step = 1e-4
    around = np.ones((len(starts), 3, 3))
    around[..., :2] = origin[:, None] + step * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    seen = camera.project(around.reshape(-1, 3)).reshape(-1, 3, 2)
    local = (seen[:, 1:] - seen[:, :1]).transpose(0, 2, 1) / step
    to_pixels = np.zeros((len(starts), 3, 3))
    to_pixels[:, :2, :2] = local
    to_pixels[:, :2, 2] = -(local @ origin[..., None])[..., 0]
    to_pixels[:, 2, 2] = 1.0
    T_camera_table = invert(T_table_camera)
    return Silhouettes(
        points=(rays - origin[:, None]) @ local.transpose(0, 2, 1),
        given=given,
        matrix=to_pixels @ T_camera_table[:3, :3],
        offset=to_pixels @ T_camera_table[:3, 3],
        unit=np.stack([_unit(start.shape) for start in starts]),
        smooth=starts[0].shape is Shape.CIRCLE,
    )


@cache
def _unit(shape: Shape) -> Array:
    """Corners (V, 2, 2) of a footprint as those of `Silhouettes`."""
    own = unit_footprint(shape)
    corners = np.zeros((max(len(own), _CORNERS), 2, 2))
    corners[:, :, : own.shape[2]] = own[np.minimum(np.arange(len(corners)), len(own) - 1)]
    return corners


def _hulls(corners: Array) -> tuple[Rows, Rows]:
    """Begin and end (K, E) of the edges of the hulls of points (K, P, 2): from x towards y, as OpenCV goes around.

    The last edge of hulls with fewer is repeated.
    """
    near = corners.astype(np.float32)
    rings = [cv2.convexHull(points, returnPoints=False)[:, 0] for points in near]
    count = np.array([len(ring) for ring in rings])[:, None]
    at = np.minimum(np.arange(int(count.max())), count - 1)
    ring = np.concatenate(rings)
    first = np.cumsum(count)[:, None] - count
    return ring[first + at], ring[first + (at + 1) % count]


class _Descent:
    """Gauss-Newton steps of prisms towards their outlines: those that have settled take no part in the next one."""

    def __init__(self, starts: Sequence[Start], seen: Silhouettes, noise: Noise) -> None:
        self._starts, self._seen, self._noise = starts, seen, noise
        self._at = np.array(
            [(*start.place, *start.dimensions, 1.0)[:5] + (start.height,) for start in starts], np.float64
        )

    def fits(self) -> list[PrismFit]:
        """The prisms where all have settled, or after a number of rounds."""
        count, stated = len(self._at), self._at[:, 5].copy()
        certain = 1.0 / self._noise.height**2
        out: list[PrismFit | None] = [None] * count
        rows, last, seen = np.arange(count), np.full(count, math.inf), self._seen
        for _ in range(_ROUNDS):
            at = self._at[rows]
            residuals, jacobian, edges, used = seen.compare(at)
            weights = self._weights(seen, residuals, edges, used)
            weighted = jacobian * weights[..., None]
            turned = weighted.transpose(0, 2, 1)
            normal = turned @ weighted + _RIDGE
            right = (turned @ (weights * residuals)[..., None])[..., 0]
            normal[:, 5, 5] += certain
            right[:, 5] += (stated[rows] - at[:, 5]) * certain
            step = np.linalg.solve(normal, right[..., None])[..., 0]
            longest = np.abs(step).max(axis=1)
            step *= np.minimum(1.0, _LONGEST / np.maximum(longest, 1e-9))[:, None]
            at += step
            np.maximum(at[:, 3:], 1.0, out=at[:, 3:])
            self._at[rows] = at
            moved = np.maximum(longest, np.abs(step[:, 2]) * at[:, 3])
            done = (moved < _SETTLED) | ((0.9 * last < moved) & (moved < _WAVERING))
            residuals -= (jacobian @ step[..., None])[..., 0]
            for k in np.flatnonzero(done).tolist():
                out[int(rows[k])] = self._fit(int(rows[k]), normal[k], residuals[k], edges[k], used[k], seen.given[k])
            on = np.flatnonzero(~done)
            rows, last, normal = rows[on], moved[on], normal[on]
            if not len(rows):
                break
            seen = seen.some(on)
        else:
            residuals, _, edges, used = seen.compare(self._at[rows])
            for k, row in enumerate(rows.tolist()):
                out[row] = self._fit(row, normal[k], residuals[k], edges[k], used[k], seen.given[k])
        return [fit for fit in out if fit is not None]

    def _weights(self, seen: Silhouettes, residuals: Array, edges: Rows, used: NDArray[np.bool_]) -> Array:
        """Inverse standard deviations (K, N): an edge counts for its shared shift, not for its many points."""
        count = len(residuals)
        if seen.smooth:
            sharing = np.repeat(seen.given.sum(axis=1, keepdims=True) / _ARCS, residuals.shape[1], axis=1)
        else:
            # All edges of all prisms are counted at once.
            number = edges + (int(edges.max()) + 1) * np.arange(count)[:, None]
            sharing = np.bincount(number[used], minlength=int(number.max()) + 1)[number].astype(np.float64)
        variance = self._noise.point**2 + self._noise.edge**2 * sharing
        trust = np.minimum(1.0, self._noise.tail / np.maximum(np.abs(residuals), 1e-12))
        return np.where(used, np.sqrt(trust / variance), 0.0)

    def _fit(
        self, row: int, normal: Array, residuals: Array, edges: Rows, used: NDArray[np.bool_], given: NDArray[np.bool_]
    ) -> PrismFit:
        """What has been found of one outline."""
        shape, at = self._starts[row].shape, self._at[row].tolist()
        sides = tuple(at[3 : 3 + len(self._starts[row].dimensions)])
        yaw: float | None = at[2]
        if shape is Shape.RECTANGLE and sides[1] > sides[0]:
            sides, yaw = (sides[1], sides[0]), at[2] + math.pi / 2
        period = shape.period
        return PrismFit(
            (at[0], at[1]),
            None if period is None or yaw is None else wrap(yaw, period),
            sides,
            at[5],
            np.asarray(np.linalg.inv(normal)[:2, :2], np.float64),
            residuals[given],
            edges[given],
            used[given],
        )



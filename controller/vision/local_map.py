"""Each object's own flat coordinates: the plane it lies in, scaled to pixels, around its centre.

Shape is decided there: a square seen at an angle or through a bending lens is no square in the image. Near one
object the way from pixels to the plane is a cubic to well below a thousandth of a pixel, which spares undoing the
lens pixel by pixel. Without a calibration the plane is the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.geometry import PlaneMap

Floats = NDArray[np.float64]

_EXPONENTS = [(i, j) for i in range(4) for j in range(4 - i)]
_GRID = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 6), np.linspace(-1.0, 1.0, 6)), axis=-1).reshape(-1, 2)


def _basis(points: Floats) -> Floats:
    x, y = points[..., 0], points[..., 1]
    x2, y2 = x * x, y * y
    out = np.empty((*x.shape, len(_EXPONENTS)))
    for term, values in enumerate((1.0, y, y2, y2 * y, x, x * y, x * y2, x2, x2 * y, x2 * x)):
        out[..., term] = values
    return out


_SOLVE = np.linalg.pinv(_basis(_GRID))


@dataclass(frozen=True, slots=True, eq=False)
class LocalMaps:
    """Maps between pixels and the local coordinates of K objects.

    Attributes:
        centers: ndarray of shape (K, 2), origins, px.
        plane: The plane, or None for the image itself.
        reach: ndarray of shape (K,): half the side of the square around the centre where the map is good, px.
        coefficients: ndarray of shape (K, 10, 2), px to local.
        scale: ndarray of shape (K,): mm of the plane per local unit.
        origin: ndarray of shape (K, 2): the centres in the plane, mm.
    """

    centers: Floats
    plane: PlaneMap | None
    reach: Floats
    coefficients: Floats
    scale: Floats
    origin: Floats

    def all_to_local(self, pixels: Floats) -> Floats:
        """Local coordinates (K, N, 2) of N pixels near each of the K objects."""
        shifted = pixels - self.centers[:, None]
        if self.plane is None:
            return np.asarray(shifted)
        return np.asarray(_basis(shifted / self.reach[:, None, None]) @ self.coefficients)

    def many_to_local(self, index: NDArray[np.intp], pixels: Floats) -> Floats:
        """Local coordinates (K, ..., 2) of pixels near each of the objects `index` (K,)."""
        place = (len(index), *(1,) * (pixels.ndim - 1))
        shifted = pixels - self.centers[index].reshape(*place[:-1], 2)
        if self.plane is None:
            return np.asarray(shifted)
        basis = _basis(shifted / self.reach[index].reshape(place)).reshape(len(index), -1, len(_EXPONENTS))
        return np.asarray(basis @ self.coefficients[index]).reshape(pixels.shape)

    def all_to_pixels(self, index: NDArray[np.intp], local: Floats) -> Floats:
        """Pixels (K, N, 2) of local coordinates of each of the objects `index` (K,), exact."""
        if self.plane is None or not len(local):
            return np.asarray(local + self.centers[index][:, None])
        on_plane = local * self.scale[index][:, None, None] + self.origin[index][:, None]
        return self.plane.to_pixels(on_plane.reshape(-1, 2)).reshape(local.shape)

    def to_pixels(self, k: int, local: Floats) -> Floats:
        """Pixels (N, 2) of local coordinates of object k, exact."""
        if self.plane is None:
            return np.asarray(local + self.centers[k])
        return self.plane.to_pixels(local * self.scale[k] + self.origin[k])


def local_maps(centers: Floats, reach: Floats, plane: PlaneMap | None) -> LocalMaps:
    """Maps for objects at `centers` (K, 2) with half extents `reach` (K,), px."""
    count = len(centers)
    if plane is None or count == 0:
        empty = np.zeros((count, len(_EXPONENTS), 2))
        return LocalMaps(centers, None, reach, empty, np.ones(count), np.zeros((count, 2)))
    grid = centers[:, None] + _GRID * reach[:, None, None]
    on_plane = plane.to_plane(grid.reshape(-1, 2)).reshape(count, -1, 2)
    coefficients = np.asarray(_SOLVE @ np.nan_to_num(on_plane), np.float64)
    origin = coefficients[:, 0].copy()
    # Rows 1 and 4 are d/dy and d/dx: their determinant is the local scale.
    det = np.abs(coefficients[:, 4, 0] * coefficients[:, 1, 1] - coefficients[:, 4, 1] * coefficients[:, 1, 0])
    scale = np.asarray(np.sqrt(np.maximum(det, 1e-12)) / reach, np.float64)
    coefficients[:, 0] = 0.0
    coefficients /= scale[:, None, None]
    return LocalMaps(centers, plane, reach, coefficients, scale, origin)


def joined(a: LocalMaps, b: LocalMaps) -> LocalMaps:
    """The objects of both, those of `a` first."""
    pairs = ((a.centers, b.centers), (a.reach, b.reach), (a.coefficients, b.coefficients), (a.scale, b.scale))
    centers, reach, coefficients, scale = (np.concatenate(pair) for pair in pairs)
    plane = a.plane if len(a.centers) else b.plane
    return LocalMaps(centers, plane, reach, coefficients, scale, np.concatenate([a.origin, b.origin]))

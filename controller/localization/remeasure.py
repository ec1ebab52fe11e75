"""An outline measured again where a prism of the stated height would have it.

Vision knows one typical height for all parts. Where a part is much lower or taller, or a shadow lies along its foot,
the outline it hands over runs between edges; the picture itself tells, once it is known where to look.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Pieces of the outline that are measured one by one, px: short against any side, long enough to average noise.
_PIECE = 8.0
_STEP = 0.5
#: Where along a piece it is sampled.
_SHARES = np.linspace(-0.5, 0.5, 9)
_ONES = np.ones((1, len(_SHARES)), np.float32)
#: An edge is this clear by itself, levels of 255 a pixel, ...
_LEAST = 3.0
#: ... and against the clearest one in reach.
_SHARE = 0.35
#: Edges further off than this, px, are not those of the prism.
_FAR = 3.0
#: Of a side narrower than this, px, only the foot's edge is told apart.
_NARROWEST = 4.0
#: A polygon with more corners than this stands for a circle.
_MANY = 24
#: Points handed on a piece.
_POINTS = np.array([-1.0, 0.0, 1.0]) / 3.0


def remeasured(image: NDArray[np.uint8], prisms: Sequence[tuple[Array, Array]], reach: float) -> list[Array]:
    """Outlines (N, 2), px, on the edges nearest to prisms' silhouettes; where there is none a piece is left out.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8.
        prisms: Where each prism has its foot's corners (V, 2), px, and those of its top face.
        reach: How far to either side is looked, px.
    """
    hulls = [cv2.convexHull(np.vstack(prism).astype(np.float32))[:, 0].astype(np.float64) for prism in prisms]
    middle, along, normal, owner = _pieces([_thinned(hull, np.roll(hull, -1, axis=0)) for hull in hulls])
    at, found = _beside(image, middle, along, normal, reach)
    places = middle[:, None] + _POINTS[:, None] * along[:, None] + at[:, None, None] * normal[:, None]
    return [places[found & (owner == k)].reshape(-1, 2) for k in range(len(prisms))]


def misfits(image: NDArray[np.uint8], prisms: Sequence[tuple[Array, Array]]) -> Array:
    """How far (K,) the edges in the picture lie beside those of prisms that a camera sees, px in the mean.

    The border between top face and a side counts too: without it a prism as large as the whole silhouette would do.
    What has no edge near it counts as `_FAR`.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8.
        prisms: K of them, as for `remeasured`.
    """
    if not prisms:
        return np.empty(0)
    middle, along, normal, owner = _pieces([_edges(foot, top) for foot, top in prisms])
    at, found = _beside(image, middle, along, normal, _FAR)
    off = np.bincount(owner, np.where(found, np.abs(at), _FAR), len(prisms))
    return np.asarray(off / np.maximum(np.bincount(owner, minlength=len(prisms)), 1))


def _edges(foot: Array, top: Array) -> tuple[Array, Array]:
    """Starts and ends (L, 2), px, of the edges that a camera sees of a prism."""
    next_foot, next_top = (np.concatenate([corners[1:], corners[:1]]) for corners in (foot, top))
    side = next_foot - foot
    normal = side[:, ::-1] * (1.0, -1.0) / np.hypot(side[:, 0], side[:, 1])[:, None]
    normal *= np.sign((normal * (foot + side / 2 - top.mean(axis=0))).sum(axis=1))[:, None]
    strip = (normal * (foot - top)).sum(axis=1)
    border, ground = (strip <= 0.0) | (strip > _NARROWEST), strip > 0.0
    starts = np.concatenate([top[border], foot[ground]])
    return _thinned(starts, np.concatenate([next_top[border], next_foot[ground]]))


def _beside(
    image: NDArray[np.uint8], middle: Array, along: Array, normal: Array, reach: float
) -> tuple[Array, NDArray[np.bool_]]:
    """How far (M,) beside each piece the nearest clear edge lies, px, and whether there is one."""
    across = np.arange(-reach - 1.0, reach + 1.0 + _STEP, _STEP)
    on = (middle[:, None] + _SHARES[:, None] * along[:, None]).astype(np.float32)
    out = (across[:, None] * normal[:, None]).astype(np.float32)
    x, y = ((on[:, :, None, i] + out[:, None, :, i]).reshape(len(middle), -1) for i in (0, 1))
    seen = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    profile = (_ONES @ seen.reshape(len(middle), len(_SHARES), -1)).reshape(len(middle), -1, 3)
    step = profile[:, 2:] - profile[:, :-2]
    slope = np.sqrt(np.einsum("ijk,ijk->ij", step, step)).astype(np.float64) / (2 * _STEP * len(_SHARES))
    return _nearest(slope, across[1:-1], reach)


def _thinned(starts: Array, ends: Array) -> tuple[Array, Array]:
    """Lines (K, 2) to (K, 2); of a circle's many short ones every so manieth, made longer."""
    if len(starts) <= _MANY:
        return starts, ends
    side = ends - starts
    step = max(1, int(_PIECE / max(float(np.median(np.hypot(side[:, 0], side[:, 1]))), 1e-9)))
    return starts[::step], starts[::step] + step * side[::step]


def _pieces(lines: Sequence[tuple[Array, Array]]) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """Middles, vectors along and unit normals (M, 2) of the pieces of lines, and which (M,) of the sets each is of.

    Args:
        lines: Sets of lines: where they start and where they end, (L, 2) each.
    """
    starts, ends = (np.concatenate(part) for part in zip(*lines, strict=True))
    side = ends - starts
    length = np.hypot(side[:, 0], side[:, 1])
    counts = np.maximum((length // _PIECE).astype(int), (length > _PIECE / 2).astype(int))
    which = np.repeat(np.arange(len(side)), counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    along = side[which] / counts[which][:, None]
    middle = starts[which] + (np.arange(len(which)) - first + 0.5)[:, None] * along
    normal = along[:, ::-1] * (1.0, -1.0) / np.hypot(along[:, 0], along[:, 1])[:, None]
    owner = np.repeat(np.arange(len(lines)), [len(own) for own, _ in lines])
    return middle, along, normal, owner[which]


def _nearest(slope: Array, across: Array, reach: float) -> tuple[Array, NDArray[np.bool_]]:
    """Of each row of slopes (M, S): the clear peak nearest to the middle (M,), px, and whether there is one."""
    inner = slope[:, 1:-1]
    peak = (inner >= slope[:, :-2]) & (inner > slope[:, 2:]) & (np.abs(across[1:-1]) <= reach)
    peak &= inner > np.maximum(_LEAST, _SHARE * inner.max(axis=1, keepdims=True))
    distance = np.where(peak, np.abs(across[1:-1]), np.inf)
    best = distance.argmin(axis=1)
    rows = np.arange(len(slope))
    a, b, c = slope[rows, best], slope[rows, best + 1], slope[rows, best + 2]
    bend = a - 2.0 * b + c
    shift = np.where(bend < 0.0, 0.5 * (a - c) / np.where(bend < 0.0, bend, -1.0), 0.0)
    return across[best + 1] + np.clip(shift, -0.5, 0.5) * _STEP, np.isfinite(distance.min(axis=1))

"""Outlines of different families as equal rows of numbers, cut into chunks along their sides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.vision.local_map import LocalMaps
from controller.vision.profiles import CHUNKS
from controller.vision.shapes import CIRCLE, Family

Floats = NDArray[np.float64]

PARAMETERS = 8
"""Parameters of any family, padded: (cx, cy, three sizes, three turns)."""
_CORNER = 1.6
"""Samples closer than this many blurs to another side see a rounded corner, not an edge."""
_SIDE = {n: np.repeat(np.arange(n), CHUNKS // n) for n in (3, 4, 6, 8)}
_BEFORE = {n: np.arange(-1, n - 1) for n in (3, 4, 6, 8)}
_AFTER = {n: np.arange(1, n + 1) % n for n in (3, 4, 6, 8)}


@dataclass(slots=True, eq=False)
class Batch:
    """Outlines being refined; arrays have one row an object."""

    families: list[Family]
    index: NDArray[np.intp]
    q: Floats
    blur: Floats
    base: Floats
    size_of: NDArray[np.intp]
    turn_of: NDArray[np.intp]
    round_: NDArray[np.bool_]
    moves: NDArray[np.bool_]
    group: NDArray[np.intp]

    def geometry(self) -> tuple[Floats, Floats]:
        """Outward normals (K, CHUNKS, 2) and distances from the centre (K, CHUNKS) of every chunk's side."""
        rows = np.arange(len(self.q))[:, None]
        turn = self.base + np.where(self.round_[:, None], 0.0, self.q[rows, 5 + self.turn_of])
        reach = self.q[rows, 2 + self.size_of]
        return np.stack([np.cos(turn), np.sin(turn)], axis=-1), reach

    def by_family(self) -> list[tuple[Family, NDArray[np.intp], Floats]]:
        """The outlines of each family: which rows they are, and their own parameters (K, P)."""
        out = []
        for family in dict.fromkeys(self.families):
            rows = np.array([i for i, other in enumerate(self.families) if other is family])
            own = [*range(2 + family.sizes), *range(5, 5 + family.turns)]
            out.append((family, rows, self.q[rows][:, own]))
        return out


def pad(family: Family, q: Floats) -> Floats:
    """A family's parameters in the places that all families share."""
    out = np.zeros(PARAMETERS)
    out[: 2 + family.sizes] = q[: 2 + family.sizes]
    out[5 : 5 + family.turns] = q[2 + family.sizes :]
    return out


def unpad(family: Family, q: Floats) -> Floats:
    """The family's own parameters, the inverse of `pad`."""
    return np.concatenate([q[: 2 + family.sizes], q[5 : 5 + family.turns]])


def batch_of(families: Sequence[Family], qs: Sequence[Floats], index: Sequence[int], blur: float) -> Batch:
    """Outlines as one batch; `index` says which object of the local maps each belongs to."""
    count = len(families)
    base = np.empty((count, CHUNKS))
    size_of = np.zeros((count, CHUNKS), np.intp)
    turn_of = np.zeros((count, CHUNKS), np.intp)
    for i, family in enumerate(families):
        if family is CIRCLE:
            base[i] = (np.arange(CHUNKS) + 0.5) * 2.0 * math.pi / CHUNKS
        else:
            side = _SIDE[len(family.normals)]
            base[i], size_of[i], turn_of[i] = family.normals[side], family.size_of[side], family.turn_of[side]
    return Batch(
        list(families),
        np.asarray(index, np.intp),
        np.array([pad(f, q) for f, q in zip(families, qs, strict=True)]),
        np.full(count, blur),
        base,
        size_of,
        turn_of,
        np.array([f is CIRCLE for f in families]),
        np.array([f.moves for f in families]),
        np.array([CHUNKS if f.sizes == 1 else CHUNKS // len(f.normals) for f in families]),
    )


def chunk_ends(batch: Batch, maps: LocalMaps) -> tuple[Floats, Floats, Floats]:
    """Start, end (K, CHUNKS, 2) and outward normal of every chunk, px."""
    starts = np.empty((len(batch.q), CHUNKS, 2))
    ends = np.empty_like(starts)
    for family, rows, q in batch.by_family():
        if family is CIRCLE:
            turn = np.arange(CHUNKS + 1) * 2.0 * math.pi / CHUNKS
            # Moved out a little, a chord straddles its arc evenly.
            radius = q[:, 2, None, None] * (1.0 + (math.pi / CHUNKS) ** 2 / 3.0)
            ring = q[:, None, :2] + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
            starts[rows], ends[rows] = ring[:, :-1], ring[:, 1:]
            continue
        n = len(family.normals)
        corner = corners(family, q)
        before = corner[:, _BEFORE[n]]
        side = corner - before
        length = np.maximum(np.hypot(side[..., 0], side[..., 1]), 1e-6)
        cut = np.minimum(_CORNER * batch.blur[rows, None] / length, 0.3)[..., None]
        t = cut + (1.0 - 2.0 * cut) * np.linspace(0.0, 1.0, CHUNKS // n + 1)
        points = before[:, :, None] + side[:, :, None] * t[..., None]
        starts[rows] = points[:, :, :-1].reshape(-1, CHUNKS, 2)
        ends[rows] = points[:, :, 1:].reshape(-1, CHUNKS, 2)
    normals, _ = batch.geometry()
    if maps.plane is None:
        center = maps.centers[batch.index][:, None]
        return starts + center, ends + center, normals
    middle = 0.5 * (starts + ends) + normals
    mapped = maps.all_to_pixels(batch.index, np.concatenate([starts, ends, middle], axis=1))
    a, b, tip = mapped[:, :CHUNKS], mapped[:, CHUNKS : 2 * CHUNKS], mapped[:, 2 * CHUNKS :]
    outward = tip - 0.5 * (a + b)
    along = b - a
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    across *= np.sign(np.sum(across * outward, axis=-1, keepdims=True))
    across /= np.maximum(np.hypot(across[..., 0], across[..., 1])[..., None], 1e-9)
    return a, b, across


def chunk_middles(family: Family, q: Floats) -> Floats:
    """Middles (CHUNKS, 2) of the chunks of an outline, local coordinates."""
    if family is CIRCLE:
        turn = (np.arange(CHUNKS) + 0.5) * 2.0 * math.pi / CHUNKS
        return np.stack([q[0] + q[2] * np.cos(turn), q[1] + q[2] * np.sin(turn)], axis=1)
    n = len(family.normals)
    corner = corners(family, q[None])[0]
    before = np.roll(corner, 1, axis=0)
    t = (np.arange(CHUNKS // n) + 0.5) / (CHUNKS // n)
    return np.asarray((before[:, None] + (corner - before)[:, None] * t[:, None]).reshape(-1, 2))


def corners(family: Family, q: Floats) -> Floats:
    """Corners (K, S, 2) of outlines q (K, P): corner k lies between side k and side k + 1 of the family's order."""
    after = _AFTER[len(family.normals)]
    turns = q[:, 2 + family.sizes :][:, family.turn_of] + family.normals
    reach = q[:, 2 + family.size_of]
    sin, cos, reach_2 = np.sin(turns), np.cos(turns), reach[:, after]
    sin_2, cos_2 = sin[:, after], cos[:, after]
    det = sin_2 * cos - cos_2 * sin
    det = np.where(np.abs(det) < 1e-6, 1e-6, det)
    x = (reach * sin_2 - reach_2 * sin) / det
    y = (reach_2 * cos - reach * cos_2) / det
    return q[:, None, :2] + np.stack([x, y], axis=2)


def side_distance(batch: Batch, dx: Floats, dy: Floats, chord: Floats) -> tuple[Floats, Floats]:
    """Signed distance (K, CHUNKS, D) from each sample's own side, and its derivatives (K, CHUNKS, 8).

    The samples of a chunk lie along its normal, so that they share their derivatives.
    """
    normal, reach = batch.geometry()
    n_x, n_y = normal[..., 0], normal[..., 1]
    distance = dx * n_x[..., None] + dy * n_y[..., None] - reach[..., None]
    if batch.round_.any():
        r = batch.round_
        # The mean distance of a chord's points is longer than its middle's.
        distance[r] = np.sqrt(dx[r] ** 2 + dy[r] ** 2 + chord[r][..., None] ** 2 / 12.0) - reach[r][..., None]
    jacobian = np.empty((*n_x.shape, PARAMETERS))
    moves = batch.moves[:, None]
    jacobian[..., 0], jacobian[..., 1] = -n_x * moves, -n_y * moves
    turning = np.where(batch.round_[:, None], 0.0, dy.mean(axis=2) * n_x - dx.mean(axis=2) * n_y)
    for i in range(3):
        jacobian[..., 2 + i] = np.where(batch.size_of == i, -1.0, 0.0)
        jacobian[..., 5 + i] = np.where(batch.turn_of == i, turning, 0.0)
    return distance, jacobian


def clear_of_corners(batch: Batch, local: Floats) -> NDArray[np.bool_]:
    """Samples whose distance to every other side is larger than the blur reaches."""
    clear = np.ones(local.shape[:3], bool)
    for family, rows, q in batch.by_family():
        if family is CIRCLE:
            continue
        turns = q[:, 2 + family.sizes :][:, family.turn_of] + family.normals
        cos, sin = np.cos(turns), np.sin(turns)
        limit = q[:, 2 + family.size_of] - _CORNER * 0.8 * batch.blur[rows, None]
        limit += q[:, :1] * cos + q[:, 1:2] * sin
        x, y = local[rows, :, :, 0], local[rows, :, :, 1]
        inside = np.ones(x.shape, bool)
        for i in range(len(family.normals)):
            c, s, most = (values[:, i, None, None] for values in (cos, sin, limit))
            other = _SIDE[len(family.normals)] != i
            inside &= (x * c + y * s < most) | ~other[:, None]
        clear[rows] = inside
    return clear

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
    for i, family in enumerate(batch.families):
        q = unpad(family, batch.q[i])
        if family is CIRCLE:
            turn = np.arange(CHUNKS + 1) * 2.0 * math.pi / CHUNKS
            # Moved out a little, a chord straddles its arc evenly.
            radius = q[2] * (1.0 + (math.pi / CHUNKS) ** 2 / 3.0)
            ring = np.stack([q[0] + radius * np.cos(turn), q[1] + radius * np.sin(turn)], axis=1)
            starts[i], ends[i] = ring[:-1], ring[1:]
            continue
        n = len(family.normals)
        corner = corners_in_order(family, q)
        margin = _CORNER * batch.blur[i]
        side = corner - np.roll(corner, 1, axis=0)
        length = np.maximum(np.hypot(side[:, 0], side[:, 1]), 1e-6)
        cut = np.minimum(margin / length, 0.3)
        pieces = CHUNKS // n
        t = cut[:, None] + (1.0 - 2.0 * cut[:, None]) * np.linspace(0.0, 1.0, pieces + 1)
        points = np.roll(corner, 1, axis=0)[:, None] + side[:, None] * t[..., None]
        starts[i] = points[:, :-1].reshape(-1, 2)
        ends[i] = points[:, 1:].reshape(-1, 2)
    normals, _ = batch.geometry()
    if maps.plane is None:
        center = maps.centers[batch.index][:, None]
        return starts + center, ends + center, normals
    a, b, tip = np.empty_like(starts), np.empty_like(starts), np.empty_like(starts)
    for i, k in enumerate(batch.index):
        middle = 0.5 * (starts[i] + ends[i]) + normals[i]
        mapped = maps.to_pixels(int(k), np.concatenate([starts[i], ends[i], middle]))
        a[i], b[i], tip[i] = mapped[:CHUNKS], mapped[CHUNKS : 2 * CHUNKS], mapped[2 * CHUNKS :]
    outward = tip - 0.5 * (a + b)
    along = b - a
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    across *= np.sign(np.sum(across * outward, axis=-1, keepdims=True))
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    return a, b, across


def chunk_middles(family: Family, q: Floats) -> Floats:
    """Middles (CHUNKS, 2) of the chunks of an outline, local coordinates."""
    if family is CIRCLE:
        turn = (np.arange(CHUNKS) + 0.5) * 2.0 * math.pi / CHUNKS
        return np.stack([q[0] + q[2] * np.cos(turn), q[1] + q[2] * np.sin(turn)], axis=1)
    n = len(family.normals)
    corner = corners_in_order(family, q)
    before = np.roll(corner, 1, axis=0)
    t = (np.arange(CHUNKS // n) + 0.5) / (CHUNKS // n)
    return np.asarray((before[:, None] + (corner - before)[:, None] * t[:, None]).reshape(-1, 2))


def corners_in_order(family: Family, q: Floats) -> Floats:
    """Corner k (S, 2) lies between side k and side k + 1 of the family's own order."""
    turns = q[2 + family.sizes :][family.turn_of] + family.normals
    reach = q[2 + family.size_of]
    following, reach_2 = np.roll(turns, -1), np.roll(reach, -1)
    det = np.sin(following - turns)
    det = np.where(np.abs(det) < 1e-6, 1e-6, det)
    x = (reach * np.sin(following) - reach_2 * np.sin(turns)) / det
    y = (reach_2 * np.cos(turns) - reach * np.cos(following)) / det
    return np.stack([q[0] + x, q[1] + y], axis=1)


def side_distance(batch: Batch, dx: Floats, dy: Floats, chord: Floats) -> tuple[Floats, Floats]:
    """Signed distance (K, CHUNKS, D) from each sample's own side, and its derivatives (K, 8, CHUNKS, D)."""
    normal, reach = batch.geometry()
    n_x = np.broadcast_to(normal[..., 0, None], dx.shape).copy()
    n_y = np.broadcast_to(normal[..., 1, None], dx.shape).copy()
    distance = dx * n_x + dy * n_y - reach[..., None]
    if batch.round_.any():
        r = batch.round_
        radius = np.maximum(np.hypot(dx[r], dy[r]), 1e-9)
        n_x[r], n_y[r] = dx[r] / radius, dy[r] / radius
        # The mean distance of a chord's points is longer than its middle's.
        distance[r] = np.sqrt(radius**2 + chord[r][..., None] ** 2 / 12.0) - reach[r][..., None]
    jacobian = np.zeros((len(dx), PARAMETERS, *dx.shape[1:]))
    moves = batch.moves[:, None, None]
    jacobian[:, 0], jacobian[:, 1] = -n_x * moves, -n_y * moves
    turning = np.where(batch.round_[:, None, None], 0.0, dy * n_x - dx * n_y)
    for i in range(3):
        jacobian[:, 2 + i] = np.where(batch.size_of == i, -1.0, 0.0)[..., None]
        jacobian[:, 5 + i] = (batch.turn_of == i)[..., None] * turning
    return distance, jacobian


def clear_of_corners(batch: Batch, local: Floats) -> NDArray[np.bool_]:
    """Samples whose distance to every other side is larger than the blur reaches."""
    clear = np.ones(local.shape[:3], bool)
    for i, family in enumerate(batch.families):
        if family is CIRCLE:
            continue
        q = unpad(family, batch.q[i])
        turns = q[2 + family.sizes :][family.turn_of] + family.normals
        planes = (local[i] - q[:2]) @ np.stack([np.cos(turns), np.sin(turns)]) - q[2 + family.size_of]
        side = _SIDE[len(family.normals)]
        planes[np.arange(CHUNKS)[:, None], np.arange(local.shape[2])[None], side[:, None]] = -np.inf
        clear[i] = planes.max(axis=2) < -_CORNER * 0.8 * batch.blur[i]
    return clear

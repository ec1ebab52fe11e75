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
_THREE = np.arange(3)
_SIDE = {n: np.repeat(np.arange(n), CHUNKS // n) for n in (3, 4, 6)}
_BEFORE = {n: np.arange(-1, n - 1) for n in (3, 4, 6)}
_AFTER = {n: np.arange(1, n + 1) % n for n in (3, 4, 6)}


@dataclass(slots=True, eq=False)
class Batch:
    """Outlines being refined; arrays have one row an object.

    Attributes:
        families: The family of each.
        index: ndarray of shape (K,): which object of the local maps each belongs to.
        q: ndarray of shape (K, PARAMETERS): padded parameters.
        blur: ndarray of shape (K,), px.
        base: ndarray of shape (K, CHUNKS): direction of each chunk's normal at turn 0, rad.
        size_of: ndarray of shape (K, CHUNKS): which parameter is the distance of each chunk's side from the centre.
        turn_of: ndarray of shape (K, CHUNKS): which parameter turns it.
        sizes: ndarray of shape (K, CHUNKS, 3): -1 for the size each chunk follows, else 0.
        turns: ndarray of shape (K, CHUNKS, 3): 1 for the turn it follows; 0 for circles.
        round_: ndarray of shape (K,), bool: circles.
        moves: ndarray of shape (K, 1): 1 where the centre is free, else 0.
        group: ndarray of shape (K,): how many chunks in a row move together.
        kinds: The rows of each family.
    """

    families: list[Family]
    index: NDArray[np.intp]
    q: Floats
    blur: Floats
    base: Floats
    size_of: NDArray[np.intp]
    turn_of: NDArray[np.intp]
    sizes: Floats
    turns: Floats
    round_: NDArray[np.bool_]
    moves: Floats
    group: NDArray[np.intp]
    kinds: list[tuple[Family, NDArray[np.intp]]]

    def geometry(self) -> tuple[Floats, Floats]:
        """Outward normals (K, CHUNKS, 2) and distances from the centre (K, CHUNKS) of every chunk's side."""
        rows = np.arange(len(self.q))[:, None]
        turn = self.base + np.where(self.round_[:, None], 0.0, self.q[rows, self.turn_of])
        normals = np.empty((*turn.shape, 2))
        normals[..., 0], normals[..., 1] = np.cos(turn), np.sin(turn)
        return normals, self.q[rows, self.size_of]

    def by_family(self) -> list[tuple[Family, NDArray[np.intp], Floats]]:
        """The outlines of each family: which rows they are, and their own parameters (K, P)."""
        return [(family, rows, self.q[rows][:, _own(family)]) for family, rows in self.kinds]

    def some(self, rows: NDArray[np.intp]) -> Batch:
        """A batch of some of the rows, with parameters of its own."""
        families = [self.families[i] for i in rows]
        return Batch(
            families, self.index[rows], self.q[rows], self.blur[rows], self.base[rows], self.size_of[rows],
            self.turn_of[rows], self.sizes[rows], self.turns[rows], self.round_[rows], self.moves[rows],
            self.group[rows], _kinds(families),
        )  # fmt: skip


def _own(family: Family) -> NDArray[np.intp]:
    """Places of a family's parameters among the padded ones."""
    return np.array([*range(2 + family.sizes), *range(5, 5 + family.turns)])


def _kinds(families: Sequence[Family]) -> list[tuple[Family, NDArray[np.intp]]]:
    rows: dict[Family, list[int]] = {}
    for i, family in enumerate(families):
        rows.setdefault(family, []).append(i)
    return [(family, np.array(which)) for family, which in rows.items()]


def unpad(family: Family, q: Floats) -> Floats:
    """A family's own parameters from the places that all families share."""
    return np.concatenate([q[: 2 + family.sizes], q[5 : 5 + family.turns]])


def batch_of(families: Sequence[Family], qs: Sequence[Floats], index: Sequence[int], blur: float) -> Batch:
    """Outlines as one batch; `index` says which object of the local maps each belongs to."""
    count = len(families)
    padded = np.zeros((count, PARAMETERS))
    base = np.empty((count, CHUNKS))
    size_of, turn_of = np.zeros((2, count, CHUNKS), np.intp)
    group = np.empty(count, np.intp)
    kinds = _kinds(families)
    for family, rows in kinds:
        padded[np.ix_(rows, _own(family))] = np.array([qs[i] for i in rows])
        group[rows] = CHUNKS if family.sizes == 1 else CHUNKS // len(family.normals)
        if family is CIRCLE:
            base[rows] = (np.arange(CHUNKS) + 0.5) * 2.0 * math.pi / CHUNKS
        else:
            side = _SIDE[len(family.normals)]
            base[rows], size_of[rows], turn_of[rows] = family.normals[side], family.size_of[side], family.turn_of[side]
    circles = np.array([f is CIRCLE for f in families], bool)
    return Batch(
        list(families), np.asarray(index, np.intp), padded, np.full(count, blur), base, 2 + size_of, 5 + turn_of,
        -(size_of[..., None] == _THREE).astype(np.float64),
        (turn_of[..., None] == _THREE) * ~circles[:, None, None] * 1.0,
        circles, np.array([[f.moves] for f in families], np.float64), group, kinds,
    )  # fmt: skip


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


def side_distance(batch: Batch, middle: Floats, chord: Floats) -> tuple[Floats, Floats]:
    """Signed distance (K, CHUNKS) of each chunk's middle from its side, and its derivatives (K, CHUNKS, PARAMETERS).

    The samples of a chunk lie along its normal, so that they share their derivatives.

    Args:
        batch: The outlines.
        middle: ndarray of shape (K, CHUNKS, 2), local coordinates.
        chord: ndarray of shape (K, CHUNKS): lengths of the chunks.
    """
    normal, reach = batch.geometry()
    n_x, n_y = normal[..., 0], normal[..., 1]
    dx, dy = middle[..., 0] - batch.q[:, :1], middle[..., 1] - batch.q[:, 1:2]
    distance = dx * n_x + dy * n_y - reach
    if batch.round_.any():
        # The mean distance of a chord's points is longer than its middle's.
        far = np.sqrt(dx**2 + dy**2 + chord**2 / 12.0) - reach
        distance = np.where(batch.round_[:, None], far, distance)
    jacobian = np.empty((*n_x.shape, PARAMETERS))
    jacobian[..., :2] = normal * -batch.moves[..., None]
    jacobian[..., 2:5] = batch.sizes
    jacobian[..., 5:] = batch.turns * (dy * n_x - dx * n_y)[..., None]
    return distance, jacobian


def clear_of_corners(batch: Batch, middle: Floats, outwards: Floats) -> tuple[Floats, Floats]:
    """How far inwards and outwards (K, CHUNKS) profiles reach before another side's edge blurs into them, px.

    Args:
        batch: The outlines.
        middle: ndarray of shape (K, CHUNKS, 2), local coordinates.
        outwards: ndarray of shape (K, CHUNKS, 2): how those change with 1 px along the profile.
    """
    low, high = np.full(middle.shape[:2], -np.inf), np.full(middle.shape[:2], np.inf)
    for family, rows, q in batch.by_family():
        if family is CIRCLE:
            continue
        turns = q[:, 2 + family.sizes :][:, family.turn_of] + family.normals
        normals = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        limit = q[:, 2 + family.size_of] - _CORNER * 0.8 * batch.blur[rows, None]
        room = limit[:, None] - (middle[rows] - q[:, None, :2]) @ normals
        rate = outwards[rows] @ normals
        own = np.arange(len(family.normals)) == _SIDE[len(family.normals)][:, None]
        rate = np.where(own | (np.abs(rate) < 1e-6), 1e-6, rate)
        ends = np.where(own, np.inf, room) / rate
        high[rows] = np.where(rate > 0.0, ends, np.inf).min(axis=2)
        low[rows] = np.where(rate < 0.0, ends, -np.inf).max(axis=2)
    return low, high

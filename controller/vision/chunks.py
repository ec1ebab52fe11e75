"""Outlines cut into chunks along their sides: all families at once, as rows of padded parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.vision.local_map import LocalMaps
from controller.vision.padded import KINDS, PARAMETERS, ROUND, Rows, padded
from controller.vision.profiles import CHUNKS
from controller.vision.shapes import Family

Floats = NDArray[np.float64]

_CORNER = 1.6
"""Samples closer than this many blurs to another side see a rounded corner, not an edge."""
_CUT = 0.3
"""At most this share of a side is cut off at either end."""
_CHUNK = np.arange(CHUNKS)
_MOST_SIDES = max(len(family.normals) for family in KINDS)


def _table(row: Callable[[Family], Any]) -> NDArray[Any]:
    """What belongs to each of `KINDS`."""
    return np.array([row(family) for family in KINDS])


def _each(family: Family) -> int:
    """Chunks of a side; all of a circle's are on one."""
    return CHUNKS // max(len(family.normals), 1)


def _of_side(family: Family, values: NDArray[Any], otherwise: float) -> NDArray[Any]:
    """What belongs to the side of each chunk."""
    return values[_CHUNK // _each(family)] if len(family.normals) else np.full(CHUNKS, otherwise)


def _sides(family: Family) -> NDArray[np.intp]:
    """The sides of a family, the first one again where others have more."""
    return np.where(np.arange(_MOST_SIDES) < max(len(family.normals), 1), np.arange(_MOST_SIDES), 0)


_STEP = 2.0 * math.pi / CHUNKS
_BASE = np.array([_of_side(f, f.normals, 0.0) for f in KINDS])
"""Direction of each chunk's normal at turn 0, rad."""
_BASE[ROUND] = (_CHUNK + 0.5) * _STEP
_SIZE_OF = np.array([2 + _of_side(f, f.size_of, 0) for f in KINDS], np.intp)
"""Which parameter is the distance of each chunk's side from the centre."""
_TURN_OF = np.array([5 + _of_side(f, f.turn_of, 0) for f in KINDS], np.intp)
"""Which parameter turns it: a circle's is always 0."""
_FOLLOWS = np.zeros((len(KINDS), CHUNKS, PARAMETERS))
"""-1 for the size that each chunk follows, 1 for its turn."""
np.put_along_axis(_FOLLOWS, _SIZE_OF[..., None], -1.0, axis=2)
np.put_along_axis(_FOLLOWS[:ROUND], _TURN_OF[:ROUND, :, None], 1.0, axis=2)
_MOVES = _table(lambda f: -1.0 if f.moves else 0.0)
_BEFORE = _table(lambda f: (_CHUNK - (_each(f) if len(f.normals) else 0)) % CHUNKS)
"""A chunk of the side before that of each chunk."""
_AFTER = _table(lambda f: (_CHUNK + (_each(f) if len(f.normals) else 0)) % CHUNKS)
_BEGIN = _table(lambda f: _CHUNK % _each(f) / _each(f))
"""Where on its side each chunk begins, share."""
_SHARE = _table(lambda f: 1.0 / _each(f))
_CHUNK_OF = _table(lambda f: _sides(f) * _each(f))
"""A chunk on each of the sides."""
_OWN_SIDE = _table(lambda f: _CHUNK[:, None] // _each(f) == _sides(f))
_TOGETHER = _table(lambda f: CHUNKS if f.sizes == 1 else _each(f))
"""How many chunks in a row move together when one of the sizes changes."""


@dataclass(slots=True, eq=False)
class Batch:
    """Outlines being refined; arrays have one row an object.

    Attributes:
        kind: ndarray of shape (K,): which of `padded.KINDS` each is.
        index: ndarray of shape (K,): which object of the local maps each belongs to.
        q: ndarray of shape (K, PARAMETERS): padded parameters.
        blur: ndarray of shape (K,), px.
    """

    kind: Rows
    index: Rows
    q: Floats
    blur: Floats

    @property
    def together(self) -> Rows:
        """How many chunks in a row move together (K,)."""
        return np.asarray(_TOGETHER[self.kind])

    def some(self, rows: Rows) -> Batch:
        """A batch of some of the rows, with parameters of its own."""
        return Batch(self.kind[rows], self.index[rows], self.q[rows], self.blur[rows])

    def geometry(self) -> tuple[Floats, Floats]:
        """Outward normals (K, CHUNKS, 2) and distances from the centre (K, CHUNKS) of every chunk's side."""
        own = np.arange(len(self.q))[:, None] * PARAMETERS
        turn = _BASE.take(self.kind, axis=0)
        turn += self.q.take(own + _TURN_OF.take(self.kind, axis=0))
        normals = np.empty((*turn.shape, 2))
        np.cos(turn, out=normals[..., 0])
        np.sin(turn, out=normals[..., 1])
        return normals, self.q.take(own + _SIZE_OF.take(self.kind, axis=0))


def batch_of(families: Sequence[Family], qs: Sequence[Floats], index: Sequence[int], blur: float) -> Batch:
    """Outlines as one batch; `index` says which object of the local maps each belongs to."""
    kind, q = padded(families, qs)
    return Batch(kind, np.asarray(index, np.intp), q, np.full(len(kind), blur))


def _corners(batch: Batch, normals: Floats, reach: Floats) -> tuple[Floats, Floats]:
    """Corners (K, CHUNKS, 2) before and after the side of each chunk, from the centre; of circles the middle."""
    rows = np.arange(len(reach))[:, None]
    before = _BEFORE[batch.kind]
    cos, sin = normals[..., 0], normals[..., 1]
    cos_1, sin_1, reach_1 = cos[rows, before], sin[rows, before], reach[rows, before]
    det = sin * cos_1 - cos * sin_1
    det = np.where(np.abs(det) < 1e-6, 1e-6, det)
    out = np.empty_like(normals)
    out[..., 0] = (reach_1 * sin - reach * sin_1) / det
    out[..., 1] = (reach * cos_1 - reach_1 * cos) / det
    return out, out[rows, _AFTER[batch.kind]]


def corners(batch: Batch) -> Floats:
    """Corners (K, S, 2) of polygons: corner k lies between side k and the one after it; those of few are repeated."""
    _, last = _corners(batch, *batch.geometry())
    return np.asarray(last[np.arange(len(last))[:, None], _CHUNK_OF[batch.kind]] + batch.q[:, None, :2])


def chunk_ends(batch: Batch, maps: LocalMaps, normals: Floats, reach: Floats) -> tuple[Floats, Floats, Floats]:
    """Start, end (K, CHUNKS, 2) and outward normal of every chunk, px, from the batch's `geometry`."""
    first, last = _corners(batch, normals, reach)
    side = last - first
    length = np.maximum(np.hypot(side[..., 0], side[..., 1]), 1e-6)
    cut = np.minimum(_CORNER * batch.blur[:, None] / length, _CUT)
    whole = 1.0 - 2.0 * cut
    starts = first + side * (cut + whole * _BEGIN[batch.kind])[..., None]
    ends = starts + side * (whole * _SHARE[batch.kind][:, None])[..., None]
    circles = np.flatnonzero(batch.kind == ROUND)
    if len(circles):
        turn = np.arange(CHUNKS + 1) * _STEP
        # Moved out a little, a chord straddles its arc evenly.
        radius = reach[circles, 0, None, None] * (1.0 + (math.pi / CHUNKS) ** 2 / 3.0)
        ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        starts[circles], ends[circles] = ring[:, :-1], ring[:, 1:]
    center = batch.q[:, None, :2]
    if maps.plane is None:
        center = center + maps.centers[batch.index][:, None]
        return starts + center, ends + center, normals
    middle = 0.5 * (starts + ends) + normals
    mapped = maps.all_to_pixels(batch.index, np.concatenate([starts, ends, middle], axis=1) + center)
    a, b, tip = mapped[:, :CHUNKS], mapped[:, CHUNKS : 2 * CHUNKS], mapped[:, 2 * CHUNKS :]
    outward = tip - 0.5 * (a + b)
    along = b - a
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    length = np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-9)
    across *= (np.sign(np.vecdot(across, outward)) / length)[..., None]
    return a, b, across


def middles(batch: Batch) -> Floats:
    """Middles (K, CHUNKS, 2) of the chunks of outlines, local coordinates."""
    normals, reach = batch.geometry()
    first, last = _corners(batch, normals, reach)
    at = _BEGIN[batch.kind] + 0.5 * _SHARE[batch.kind][:, None]
    straight = first + (last - first) * at[..., None]
    local = np.where((batch.kind == ROUND)[:, None, None], normals * reach[..., None], straight)
    return np.asarray(local + batch.q[:, None, :2])


def chunk_middles(family: Family, q: Floats) -> Floats:
    """Middles (CHUNKS, 2) of the chunks of one outline, local coordinates."""
    return np.asarray(middles(batch_of([family], [q], [0], 1.0))[0])


def side_distance(batch: Batch, middle: Floats, chord: Floats) -> tuple[Floats, Floats]:
    """Signed distance (K, CHUNKS) of each chunk's middle from its side, and its derivatives (K, CHUNKS, PARAMETERS).

    The samples of a chunk lie along its normal, so that they share their derivatives.

    Args:
        batch: The outlines.
        middle: ndarray of shape (K, CHUNKS, 2), local coordinates.
        chord: ndarray of shape (K, CHUNKS): lengths of the chunks.
    """
    normals, reach = batch.geometry()
    cos, sin = normals[..., 0], normals[..., 1]
    dx, dy = middle[..., 0] - batch.q[:, :1], middle[..., 1] - batch.q[:, 1:2]
    distance = dx * cos + dy * sin - reach
    circles = np.flatnonzero(batch.kind == ROUND)
    if len(circles):
        # The mean distance of a chord's points is longer than its middle's.
        x, y, wide = dx[circles], dy[circles], chord[circles]
        distance[circles] = np.sqrt(x * x + y * y + wide * wide / 12.0) - reach[circles]
    jacobian = _FOLLOWS[batch.kind]
    jacobian[..., :2] = normals * _MOVES[batch.kind][:, None, None]
    jacobian[..., 5:] *= (dy * cos - dx * sin)[..., None]
    return distance, jacobian


def clear_of_corners(
    batch: Batch, middle: Floats, outwards: Floats, normals: Floats, reach: Floats
) -> tuple[Floats, Floats]:
    """How far inwards and outwards (K, CHUNKS) profiles reach before another side's edge blurs into them, px.

    Args:
        batch: The outlines.
        middle: ndarray of shape (K, CHUNKS, 2), local coordinates.
        outwards: ndarray of shape (K, CHUNKS, 2): how those change with 1 px along the profile.
        normals: ndarray of shape (K, CHUNKS, 2), and
        reach: ndarray of shape (K, CHUNKS): the batch's `geometry`.
    """
    rows = np.arange(len(reach))[:, None]
    a_chunk = _CHUNK_OF[batch.kind]
    across = normals[rows, a_chunk].transpose(0, 2, 1)
    limit = reach[rows, a_chunk] - _CORNER * 0.8 * batch.blur[:, None]
    room = limit[:, None] - (middle - batch.q[:, None, :2]) @ across
    rate = outwards @ across
    own = _OWN_SIDE[batch.kind]
    rate = np.where(own | (np.abs(rate) < 1e-6), 1e-6, rate)
    ends = np.where(own, np.inf, room) / rate
    ahead = rate > 0.0
    return np.where(ahead, -np.inf, ends).max(axis=2), np.where(ahead, ends, np.inf).min(axis=2)

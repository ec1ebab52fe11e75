"""Sub-pixel refinement: the outline, blur and colours that explain the profiles across the edge best, and how well."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.vision.chunks import Batch, batch_of, middles, side_distance
from controller.vision.edge_model import State, fit, look
from controller.vision.local_map import LocalMaps
from controller.vision.padded import OWN, PARAMETERS, areas
from controller.vision.profiles import CHUNKS
from controller.vision.robust import median
from controller.vision.shapes import Family

Floats = NDArray[np.float64]

_KEPT = 0.9
"""Share of the visible chunks that count for the misfit: a neighbour or a nick may spoil the others."""
_LOOKS = 2
"""How often outlines are looked at, each time from where the last look led."""
_STEPS = 3
"""Gauss-Newton steps a look."""
_BELIEVED = 6.0
"""Strays up to so many px may be the same edge."""
_FURTHER = 1.5
"""How many times the step that strays ask for: an edge far away was measured with half of it out of reach."""
_PART = 0.6
"""Share of an outline that must be seen for its strays to tell where the rest may lie."""
_LEAST = 0.5
"""Smallest distance, px, of a side from the centre."""
_LOOSE = 1.0, 0.012
"""An edge this far from an outline, px and share of its size, is still its own."""
_BLANK, _BLANK_LEVELS = 5.0, 2.5
"""A chunk whose edge is less high, in its own deviations or in gray levels, shows none."""
_FOREIGN, _FOREIGN_NOISE = 0.4, 4.0
"""Just inside an outline a colour may differ from the object's by this share of the edge, and so many deviations."""
_PALE = 0.1
"""A chunk of less than this share of the typical contrast is faint."""
_AWAY = 2.0, 0.15
"""An outline that has moved farther than this, px and share of its size, is another one, ..."""
_GROWN = 0.6, 1.6
"""... and so is one whose area has changed by other ratios than these."""
_RIDGE = np.eye(PARAMETERS) * 1e-9
_NEAR = 0.5
"""How far, px, an outline may move on the profiles of one look: they were taken along its sides and corners as they
were before."""


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """What the pixels say about one outline.

    Attributes:
        q: Parameters in local coordinates.
        blur: Standard deviation of the edge's blur, px.
        contrast: Difference across the edge in units of the pixel noise.
        levels: The same in gray levels (root mean square over the channels).
        misfit: How far the outline strays from the fitted one beyond the noise, px (rms, trimmed).
        chi: Mean squared stray in units of its own deviation: tells rivals apart that both fit.
        visible: Share of the outline where an edge is to be seen.
        seen: ndarray of shape (CHUNKS,), dtype bool: where that is.
        blank: ndarray of shape (CHUNKS,), dtype bool: where inside and outside look the same.
        faint: Share of the outline that is blank, or of far less contrast than the rest.
        strays: ndarray of shape (CHUNKS,): how far it strays there, px, outwards positive.
    """

    q: Floats
    blur: float
    contrast: float
    levels: float
    misfit: float
    chi: float
    visible: float
    seen: NDArray[np.bool_]
    blank: NDArray[np.bool_]
    faint: float
    strays: Floats


def refine(
    image: NDArray[np.uint8],
    noise: Floats,
    families: Sequence[Family],
    qs: Sequence[Floats],
    maps: LocalMaps,
    index: Sequence[int],
    blur: float,
    known: Sequence[float] | None = None,
) -> list[Refined | None]:
    """Outlines refined on the pixels; None for one that runs away or leaves nothing to see.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8.
        noise: Covariance of the pixel noise, (3, 3).
        families: Family of each outline.
        qs: Start of each, local coordinates, within a few pixels of the truth.
        maps: The local coordinates.
        index: Which object of `maps` each outline belongs to.
        blur: Expected blur, px.
        known: Shares of them that are known to be seen elsewhere: one that shows no more at the first look is dropped.
    """
    if not families:
        return []
    batch = batch_of(families, qs, index, blur)
    start = batch.q.copy()
    size = np.sqrt(np.maximum(areas(batch.kind, batch.q), 1.0))
    out: list[Refined | None] = [None] * len(families)
    rows = np.arange(len(families))
    for _ in range(_LOOKS):
        at = batch.some(rows)
        reach = np.minimum(np.maximum(4.0, 4.0 * at.blur), np.maximum(3.0, 0.3 * size[rows]))
        # Outlines that run away leave the range of numbers; `_verdicts` drops them.
        with np.errstate(over="ignore", invalid="ignore"):
            state = fit(look(image, noise, at, maps, size[rows], reach), at, _STEPS)
        batch.q[rows], batch.blur[rows] = at.q, at.blur
        far = _travelled(at, state) > _NEAR
        far |= np.minimum(4.0 * at.blur, 0.3 * size[rows]) > 1.15 * reach
        for i, item in enumerate(_verdicts(at, state, start[rows], size[rows], noise)):
            k = int(rows[i])
            out[k] = item
            if known is not None and (item is None or item.visible <= known[k]):
                out[k], far[i] = None, False
        rows = rows[far]
        if not len(rows):
            break
    return out


def refine_on(
    image: NDArray[np.uint8],
    noise: Floats,
    families: Sequence[Family],
    found: Sequence[Refined],
    maps: LocalMaps,
    index: Sequence[int],
    blur: float,
    *,
    restarts: int,
    enough: float,
    hasty: bool,
) -> list[Refined]:
    """Outlines with hidden parts, moved on by what their strays ask for: the most visible of some restarts.

    Where a whole side was found elsewhere (at a shadow's end, say), a step goes a few px at most.

    Args:
        image: As for `refine`, like the next.
        noise: See there.
        families: See there.
        found: Where to go on from.
        maps: As for `refine`, like the next.
        index: See there.
        blur: See there.
        restarts: How many steps.
        enough: Share of an outline that is enough to be seen.
        hasty: A step that shows no more of it at its first look is given up.
    """
    best = list(found)
    latest = dict(enumerate(found))
    for _ in range(restarts):
        latest = {i: item for i, item in latest.items() if open_sided(item, enough)}
        rows = list(latest)
        if not rows:
            break
        own = [families[i] for i in rows]
        moved = _moved(own, list(latest.values()))
        known = [best[i].visible for i in rows]
        results = refine(image, noise, own, moved, maps, [index[i] for i in rows], blur, known if hasty else None)
        # A step that shows no more of it leads nowhere.
        latest = {
            i: item for i, item in zip(rows, results, strict=True)
            if item is not None and item.visible > best[i].visible
        }  # fmt: skip
        best = [latest.get(i, item) for i, item in enumerate(best)]
    return best


def open_sided(item: Refined, enough: float) -> bool:
    """Whether part of an outline was found, but less than is enough."""
    return _PART < item.visible < enough


def _moved(families: Sequence[Family], items: Sequence[Refined]) -> list[Floats]:
    """Parameters after the step that the strays of all chunks ask for, which reach further than the fit does."""
    batch = batch_of(families, [item.q for item in items], range(len(items)), 1.0)
    _, jacobian = side_distance(batch, middles(batch), np.zeros((len(items), CHUNKS)))
    stray = np.array([item.strays for item in items])
    use = ~np.array([item.blank for item in items]) & (np.abs(stray) < _BELIEVED)
    use &= use.sum(axis=1, keepdims=True) >= CHUNKS // 2
    turned = jacobian.transpose(0, 2, 1) * use[:, None]
    normal = turned @ jacobian
    normal += (np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1.0) * _RIDGE
    step = np.linalg.solve(normal, -(turned @ np.where(use, stray, 0.0)[..., None]))[..., 0]
    batch.q += _FURTHER * step
    return [q[OWN[kind]] for q, kind in zip(batch.q, batch.kind.tolist(), strict=True)]


def _travelled(batch: Batch, state: State) -> Floats:
    """How far (K,), px, outlines have moved since the pixels were looked at; infinite for lost ones."""
    far = np.abs(state.distance).max(axis=1)
    return np.where(np.isfinite(far), far, np.inf)


def _verdicts(batch: Batch, state: State, start: Floats, size: Floats, noise: Floats) -> list[Refined | None]:
    """Per object: misfit and visibility from the profiles that remain."""
    evidence, around = state.evidence, state.around
    information = state.information
    error = 1.0 / np.maximum(information, 1e-9)
    # The linear estimate saturates a blur away from the outline; the area under the profile does not.
    height = np.maximum(around, 1e-6).astype(np.float32)
    plain = ((state.unlit - evidence.value / height[..., None]) * evidence.free).sum(axis=2) * evidence.spacing[:, None]
    stray = np.where(np.abs(state.stray) < 0.5 * batch.blur[:, None], state.stray, plain)
    loose = np.maximum(_LOOSE[0], _LOOSE[1] * size)[:, None]
    level = math.sqrt(float(noise.trace()) / 3.0)
    energy = np.vecdot(evidence.weight * state.unlit, state.unlit)
    blank = (around * np.sqrt(energy) < _BLANK) | (around * level < _BLANK_LEVELS)
    # Inside its rim an object has one colour; where it has not, the outline cuts across something.
    deep = evidence.free * (state.unlit < 0.05)
    count = np.maximum(deep.sum(axis=2), 1e-9)
    inside = np.abs(np.vecdot(deep, evidence.value) / count)
    foreign = inside > _FOREIGN * np.abs(around) + _FOREIGN_NOISE / np.sqrt(count * evidence.lines)
    seen = ~blank & ~foreign & (np.abs(stray) < loose)
    contrast = median(around, 1)
    faint = (blank | (around < _PALE * contrast[:, None])).sum(axis=1) / CHUNKS
    squared = stray * stray
    misfit = np.sqrt(np.maximum(_trimmed(squared - error, seen & (information > 0.0)), 0.0))
    chi = _trimmed(squared * information, seen)
    moved = np.hypot(*(batch.q[:, :2] - start[:, :2]).T)
    lost = ~np.isfinite(batch.q).all(axis=1) | (moved > _AWAY[0] + _AWAY[1] * size)
    with np.errstate(invalid="ignore"):
        grown = areas(batch.kind, batch.q) / size**2
        lost |= ~((grown > _GROWN[0]) & (grown < _GROWN[1])) | (batch.geometry()[1] <= _LEAST).any(axis=1)
    figures = np.stack([batch.blur, contrast, misfit, chi, seen.sum(axis=1) / CHUNKS, faint], axis=1).tolist()
    return [
        None if gone else Refined(
            q=batch.q[i, OWN[kind]], blur=own[0], contrast=own[1], levels=own[1] * level, misfit=own[2], chi=own[3],
            visible=own[4], faint=own[5], seen=seen[i], blank=blank[i], strays=stray[i],
        )
        for i, (kind, gone, own) in enumerate(zip(batch.kind.tolist(), lost.tolist(), figures, strict=True))
    ]  # fmt: skip


def _trimmed(values: Floats, use: NDArray[np.bool_]) -> Floats:
    """Mean (K,) of the lowest _KEPT of the used values of each row; infinite for rows without any."""
    ordered = np.sort(np.where(use, values, np.inf), axis=1)
    count = use.sum(axis=1)
    kept = np.maximum(np.rint(_KEPT * count), 1)
    inside = np.arange(values.shape[1]) < kept[:, None]
    return np.asarray(np.where(inside, ordered, 0.0).sum(axis=1) / kept)

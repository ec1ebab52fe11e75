"""Sub-pixel refinement: the outline, blur and colours that explain the profiles across the edge best.

Across its outline an object looks like I = B + (F - B) Phi(-d / s): d the signed distance, s the blur, Phi the
normal distribution, F a plane over the object, B the surroundings, free for every chunk of the outline, because
shadows, neighbours and side faces end where they like. Gauss-Newton over shape and blur, with B eliminated and
Tukey weights, on all objects at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from controller.vision.chunks import (
    PARAMETERS,
    Batch,
    batch_of,
    chunk_ends,
    chunk_middles,
    clear_of_corners,
    side_distance,
    unpad,
)
from controller.vision.local_map import LocalMaps
from controller.vision.profiles import CHUNKS, Profiles, sample
from controller.vision.shapes import Family, area

Floats = NDArray[np.float64]

_KEPT = 0.9
"""Share of the visible chunks that count for the misfit: a neighbour or a nick may spoil the others."""


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
        seen: ndarray of shape (CHUNKS,), dtype bool: where an edge is to be seen.
        blank: ndarray of shape (CHUNKS,), dtype bool: where inside and outside look the same.
        faint: ndarray of shape (CHUNKS,), dtype bool: blank, or of far less contrast than the rest.
        strays: ndarray of shape (CHUNKS,): how far it strays there, px, outwards positive.
        inside_colour: ndarray of shape (3,): mean colour just inside, BGR levels.
    """

    q: Floats
    blur: float
    contrast: float
    levels: float
    misfit: float
    chi: float
    seen: NDArray[np.bool_]
    blank: NDArray[np.bool_]
    faint: NDArray[np.bool_]
    strays: Floats
    inside_colour: Floats

    @property
    def visible(self) -> float:
        """Share of the outline where an edge is to be seen."""
        return float(self.seen.mean())


def pixel_noise(image: NDArray[np.uint8]) -> Floats:
    """Covariance (3, 3) of the pixel noise, from differences of neighbours on a sample of rows."""
    height, width = image.shape[:2]
    if width < 4:
        return np.eye(3)
    rows = image[:: max(1, height // 40)].astype(np.float32)
    # The second difference is blind to slopes; its variance is 6 times the noise's.
    second = (rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:])[:, :: max(1, width // 100)].reshape(-1, 3)
    scale = np.maximum(1.4826 * np.median(np.abs(second), axis=0), 0.5)
    kept = second[(np.abs(second) < 3.5 * scale).all(axis=1)].astype(np.float64)
    covariance = kept.T @ kept / max(len(kept), 1) / 6.0
    # Rounding alone has a variance of 1/12; compression hides noise in flat blocks.
    return np.asarray(covariance + np.eye(3) * 0.3)


def refine(
    image: NDArray[np.uint8],
    noise: Floats,
    families: Sequence[Family],
    qs: Sequence[Floats],
    maps: LocalMaps,
    index: Sequence[int],
    blur: float,
    *,
    restarts: int,
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
        restarts: How often an outline with hidden parts may move on by what its strays ask for, a few px each.
    """
    found = _refine(image, noise, families, qs, maps, index, blur)
    # Where a whole side was found elsewhere (at a shadow's end, say), go on from there.
    latest = dict(enumerate(found))
    for _ in range(restarts):
        again = {i: item for i, item in latest.items() if item is not None and 0.6 < item.visible < 0.95}
        rows = list(again)
        moved = [_moved(families[i], item) for i, item in again.items()]
        results = _refine(image, noise, [families[i] for i in rows], moved, maps, [index[i] for i in rows], blur)
        latest = dict(zip(rows, results, strict=True))
        for i, item in latest.items():
            best = found[i]
            if item is not None and best is not None and item.visible > best.visible:
                found[i] = item
    return found


def _moved(family: Family, item: Refined) -> Floats:
    """Parameters after the step that the strays of all chunks ask for, which reach further than the fit does."""
    batch = batch_of([family], [item.q], [0], item.blur)
    points = chunk_middles(family, item.q)
    dx, dy = (points[None, :, i, None] - batch.q[0, i] for i in (0, 1))
    _, jacobian = side_distance(batch, dx, dy, np.zeros((1, CHUNKS)))
    rows = jacobian[0]
    use = ~item.blank & (np.abs(item.strays) < 6.0)
    if use.sum() < CHUNKS // 2:
        return item.q
    step = np.linalg.lstsq(rows[use], -item.strays[use], rcond=1e-6)[0]
    # An edge that lies s away was measured with half of it outside the profile's reach.
    return unpad(family, batch.q[0] + 1.5 * step)


def _refine(
    image: NDArray[np.uint8],
    noise: Floats,
    families: Sequence[Family],
    qs: Sequence[Floats],
    maps: LocalMaps,
    index: Sequence[int],
    blur: float,
) -> list[Refined | None]:
    """One start of `refine`."""
    if not families:
        return []
    batch = batch_of(families, qs, index, blur)
    size = np.array([math.sqrt(max(float(area(f, q[None])[0]), 1.0)) for f, q in zip(families, qs, strict=True)])
    start = batch.q.copy()
    reach = np.minimum(np.maximum(4.5, 4.0 * batch.blur), np.maximum(3.0, 0.3 * size))
    _rounds(image, noise, batch, maps, size, reach, 3, last=False)
    reach = np.minimum(np.maximum(4.0, 4.0 * batch.blur), np.maximum(3.0, 0.3 * size))
    state = _rounds(image, noise, batch, maps, size, reach, 2)
    assert state is not None
    return _verdicts(batch, state, start, size, noise)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Where the fit stands; arrays (K, CHUNKS, D) or (K, CHUNKS), in units of the noise of one pixel."""

    rest: Floats
    free: Floats
    weight: Floats
    bell: Floats
    unlit: Floats
    lines: Floats
    around: Floats
    inner: Floats
    value: Floats
    spacing: Floats


def _rounds(
    image: NDArray[np.uint8],
    noise: Floats,
    batch: Batch,
    maps: LocalMaps,
    size: Floats,
    reach: Floats,
    rounds: int,
    *,
    last: bool = True,
) -> _State | None:
    """Sample once, then some Gauss-Newton steps; changes `batch.q` and `batch.blur`.

    Returns:
        Where the fit stands after the last step, or None if `last` says that nobody asks.
    """
    starts, ends, normals = chunk_ends(batch, maps)
    columns = int(np.clip(2 * math.ceil(float(reach.max())) + 1, 11, 41))
    profiles = sample(image, starts, ends, normals, reach, columns)
    local = maps.many_to_local(batch.index, profiles.pixels)
    chord = np.linalg.norm(ends - starts, axis=2)
    # One pixel's worth of noise for every px^2: samples nearer to each other than that share theirs.
    spacing = np.minimum(2.0 * reach / (columns - 1), 1.0)
    lines = np.minimum(np.maximum(chord, 0.25), profiles.lines) * spacing[:, None]
    root = np.sqrt(lines)[..., None]
    free = (profiles.inside & clear_of_corners(batch, local)).astype(np.float64)
    value, inner = _contrasts(profiles, local, free, noise, size)
    weight = free
    for step in range(rounds + last):
        dx = local[..., 0] - batch.q[:, None, None, 0]
        dy = local[..., 1] - batch.q[:, None, None, 1]
        distance, jacobian = side_distance(batch, dx, dy, chord)
        blur = batch.blur[:, None, None]
        z = distance / blur
        unlit = ndtr(z)
        bell = np.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * blur)
        scaled = np.sqrt(weight) * root
        dark, seen = unlit * scaled, value * scaled
        energy = np.maximum(_dot(dark, dark), 1e-9)
        around = _dot(dark, seen) / energy
        rest = (value - around[..., None] * unlit) * root * free
        state = _State(rest, free, weight, bell, unlit, lines, around, inner, value, 2.0 * reach / (columns - 1))
        if step == rounds:
            return state
        if step > 0:
            spread = np.maximum(1.0, 1.4826 * np.median(np.abs(rest).reshape(len(rest), -1), axis=1))
            ratio = np.minimum(np.abs(rest) / (6.0 * spread[:, None, None]), 1.0)
            weight = free * (1.0 - ratio**2) ** 2 * _agreement(state, batch.group)[..., None]
            scaled = np.sqrt(weight) * root
            dark = unlit * scaled
            energy = np.maximum(_dot(dark, dark), 1e-9)
        slope = around[..., None] * bell * scaled
        wider = -slope * z
        target = (value - around[..., None] * unlit) * scaled
        # B of every chunk is eliminated: only what is perpendicular to it can move the outline.
        along, across, off = _dot(dark, slope), _dot(dark, wider), _dot(dark, target)
        moves = _dot(slope, slope) - along * along / energy
        mixed = _dot(slope, wider) - along * across / energy
        blurs = _dot(wider, wider) - across * across / energy
        normal = np.empty((len(rest), PARAMETERS + 1, PARAMETERS + 1))
        turned = jacobian.transpose(0, 2, 1)
        normal[:, :-1, :-1] = turned @ (jacobian * moves[..., None])
        normal[:, :-1, -1] = normal[:, -1, :-1] = (turned @ mixed[..., None])[..., 0]
        normal[:, -1, -1] = blurs.sum(axis=1)
        asked = np.empty((len(rest), PARAMETERS + 1, 1))
        asked[:, :-1] = turned @ (_dot(slope, target) - along * off / energy)[..., None]
        asked[:, -1, 0] = (_dot(wider, target) - across * off / energy).sum(axis=1)
        trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
        normal += np.eye(PARAMETERS + 1) * (1e-9 * trace + 1e-9)
        change = np.nan_to_num(np.linalg.solve(normal, asked)[..., 0])
        batch.q += np.clip(change[:, :PARAMETERS], -1.5, 1.5)
        swing = np.clip(change[:, PARAMETERS], -0.4 * batch.blur, 0.6 * batch.blur)
        batch.blur = np.clip(batch.blur + swing, 0.35, 20.0)
    return None


def _dot(a: Floats, b: Floats) -> Floats:
    """Scalar products (K, CHUNKS) of profiles."""
    return np.asarray(np.vecdot(a, b))


def _strays(state: _State) -> tuple[Floats, Floats]:
    """How far the edge of each chunk lies outside the outline (K, CHUNKS), px, and that figure's information."""
    w = state.weight * state.lines[..., None]
    slope = state.around[..., None] * state.bell
    weighted = w * slope
    information = _dot(weighted, slope)
    deviation = _dot(weighted, state.rest / np.sqrt(state.lines)[..., None])
    return deviation / np.maximum(information, 1e-9), information


def _agreement(state: _State, group: NDArray[np.intp]) -> Floats:
    """Tukey's weight (K, CHUNKS) of chunks by how far they stray from the others that move with them.

    Contacts with neighbours stray far; a whole side of a rectangle may, as long as it has not been found.

    Args:
        state: Where the fit stands.
        group: ndarray of shape (K,): how many chunks in a row move together.
    """
    stray, information = _strays(state)
    apart = np.empty_like(stray)
    for size in np.unique(group):
        rows = group == size
        split = stray[rows].reshape(int(rows.sum()), -1, size)
        apart[rows] = np.abs(split - np.median(split, axis=2, keepdims=True)).reshape(-1, CHUNKS)
    spread = 1.4826 * np.median(apart, axis=1, keepdims=True)
    limit = 4.0 * np.maximum(spread, 0.04) + 3.0 / np.sqrt(np.maximum(information, 1e-9))
    weight = (1.0 - np.minimum(apart / limit, 1.0) ** 2) ** 2
    # Not quite nothing: the surroundings of a chunk are still to be estimated.
    return np.asarray(np.maximum(weight, 1e-4))


def _contrasts(
    profiles: Profiles, local: Floats, free: Floats, noise: Floats, size: Floats
) -> tuple[Floats, Floats]:
    """Profiles relative to the object's own colour, along each chunk's contrast, in units of the noise.

    The object's colour is a plane fitted to the inner third of all profiles; what lies outside may differ from
    chunk to chunk in any direction (table, shadow, side face, neighbour), so that each has its own projection.

    Returns:
        value (K, CHUNKS, D), 0 inside and positive outside; inner colour (K, 3), levels.
    """
    count, _, columns = profiles.values.shape[:3]
    third = columns // 3
    inside = profiles.values[:, :, :third].reshape(count, -1, 3)
    usable = free[:, :, :third].reshape(count, -1) + 1e-6
    xy = local / size[:, None, None, None]
    plane = np.concatenate([np.ones((*xy.shape[:3], 1)), xy], axis=3)
    basis = plane[:, :, :third].reshape(count, -1, 3)
    middle = np.median(inside, axis=1)
    rest = inside - middle[:, None]
    face = np.zeros((count, 3, 3))
    for _ in range(2):
        far = np.sqrt(np.sum(rest * rest, axis=2))
        limit = np.maximum(4.0 * np.median(far, axis=1), 3.0)[:, None]
        w = usable * (1.0 - np.minimum(far / limit, 1.0) ** 2) ** 2
        weighted = basis * w[..., None]
        normal = weighted.transpose(0, 2, 1) @ basis + 1e-6 * np.eye(3)
        face = np.linalg.solve(normal, weighted.transpose(0, 2, 1) @ inside)
        rest = inside - basis @ face
    relative = profiles.values - plane @ face[:, None]
    outer = relative[:, :, -third:].mean(axis=2)
    direction = np.linalg.solve(noise, outer.reshape(-1, 3).T).T.reshape(outer.shape)
    length = np.sqrt(np.maximum(np.sum(outer * direction, axis=2), 1e-12))
    return np.einsum("kcdi,kci->kcd", relative, direction / length[..., None]), middle


def _verdicts(batch: Batch, state: _State, start: Floats, size: Floats, noise: Floats) -> list[Refined | None]:
    """Per object: misfit and visibility from the profiles that remain."""
    stray, information = _strays(replace(state, weight=state.free))
    error = 1.0 / np.maximum(information, 1e-9)
    # The linear estimate saturates a blur away from the outline; the area under the profile does not.
    share = (state.unlit - state.value / np.maximum(state.around, 1e-6)[..., None]) * state.free
    plain = share.sum(axis=2) * state.spacing[:, None]
    stray = np.where(np.abs(stray) < 0.5 * batch.blur[:, None], stray, plain)
    loose = np.maximum(1.0, 0.012 * size)[:, None]
    level = math.sqrt(float(noise.trace()) / 3.0)
    energy = np.einsum("kcd,kcd->kc", state.free * state.lines[..., None], state.unlit**2)
    blank = (state.around * np.sqrt(energy) < 5.0) | (state.around * level < 2.5)
    # Inside its rim an object has one colour; where it has not, the outline cuts across something.
    deep = state.free * (state.unlit < 0.05)
    count = np.maximum(deep.sum(axis=2), 1e-9)
    inside = np.abs(np.sum(deep * state.value, axis=2) / count)
    foreign = inside > 0.4 * np.abs(state.around) + 4.0 / np.sqrt(count * state.lines)
    seen = ~blank & ~foreign & (np.abs(stray) < loose)
    contrast = np.median(state.around, axis=1)
    faint = blank | (state.around < 0.1 * contrast[:, None])
    out: list[Refined | None] = []
    for i, family in enumerate(batch.families):
        q = unpad(family, batch.q[i])
        if not np.isfinite(q).all() or (q[2 : 2 + family.sizes] <= 0.5).any():
            out.append(None)
            continue
        moved = math.hypot(*(q[:2] - start[i, :2]))
        grown = float(area(family, q[None])[0]) / size[i] ** 2
        if moved > 0.15 * size[i] + 2.0 or not 0.6 < grown < 1.6:
            out.append(None)
            continue
        excess = np.sort((stray[i] ** 2 - error[i])[seen[i] & (information[i] > 0.0)])
        kept = excess[: max(1, round(_KEPT * len(excess)))] if len(excess) else np.array([np.inf])
        misfit = math.sqrt(max(float(kept.mean()), 0.0))
        ratio = np.sort((stray[i] ** 2 * information[i])[seen[i]])
        chi = float(ratio[: max(1, round(_KEPT * len(ratio)))].mean()) if len(ratio) else math.inf
        out.append(
            Refined(
                q, float(batch.blur[i]), float(contrast[i]), float(contrast[i]) * level, misfit, chi,
                seen[i], blank[i], faint[i], stray[i], state.inner[i],
            )
        )  # fmt: skip
    return out

"""What blurred edges look like, and the Gauss-Newton steps that bring outlines onto them, all objects at once.

Across its outline an object looks like I = B + (F - B) Phi(-d / s): d the signed distance, s the blur, Phi the
normal distribution, F a plane over the object, B the surroundings, free for every chunk of the outline, because
shadows, neighbours and side faces end where they like. Shape and blur are sought, B is eliminated, Tukey weights
keep out what does not belong to the edge.

A sample enters by its distance from the side of its chunk: moving the outline moves a chunk's samples alike, so that
a step needs the pixels of the first look only, as long as it is short.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.vision.chunks import Batch, chunk_ends, clear_of_corners, side_distance
from controller.vision.local_map import LocalMaps
from controller.vision.padded import PARAMETERS, Rows
from controller.vision.profiles import CHUNKS, Floats32, Profiles, sample
from controller.vision.robust import median, tukey

Floats = NDArray[np.float64]

_SLOPE = np.float32(0.2316419)
_TAIL = np.array([0.319381530, -0.356563782, 1.781477937, -1.821255978, 1.330274429], np.float32)
_PEAK = np.float32(1.0 / math.sqrt(2.0 * math.pi))
_SETTLED = 0.03
"""Outlines that a step has moved by less, px, and changed by less in blur, share, are done: every step brings them a
tenth of the last one's way."""
_FAR = 100.0
"""px: any farther is as far."""
_CHUNK = np.arange(CHUNKS)
_RIDGE = np.eye(PARAMETERS + 1) * 1e-9
_UPRIGHT = 1e-6 * np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the pixels around K outlines show; values in units of the noise of one pixel.

    Attributes:
        value: ndarray of shape (K, CHUNKS, D), dtype float32: 0 inside the object, positive outside.
        free: ndarray of shape (K, CHUNKS, D), dtype float32: 0 where another side or the picture's end disturbs.
        weight: ndarray of shape (K, CHUNKS, D), dtype float32: `free` times the pixels each sample stands for.
        offset: ndarray of shape (K, CHUNKS, D), dtype float32: distance from the chunk's middle, local units.
        middle: ndarray of shape (K, CHUNKS, 2): the chunks' middles, local coordinates.
        chord: ndarray of shape (K, CHUNKS): their lengths, px.
        lines: ndarray of shape (K, CHUNKS): pixels that each sample stands for.
        spacing: ndarray of shape (K,): of the samples, px.
    """

    value: Floats32
    free: Floats32
    weight: Floats32
    offset: Floats32
    middle: Floats
    chord: Floats
    lines: Floats
    spacing: Floats


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Where a fit stands.

    Attributes:
        evidence: What it was fitted to.
        distance: ndarray of shape (K, CHUNKS): of the chunks' middles from their sides, local units.
        unlit: ndarray of shape (K, CHUNKS, D), dtype float32: the model's share of the surroundings.
        around: ndarray of shape (K, CHUNKS): height of each chunk's edge.
        stray: ndarray of shape (K, CHUNKS): how far the edge lies outside the outline, by the unweighted profile.
        information: ndarray of shape (K, CHUNKS): that figure's inverse variance.
    """

    evidence: Evidence
    distance: Floats
    unlit: Floats32
    around: Floats
    stray: Floats
    information: Floats


def look(
    image: NDArray[np.uint8], noise: Floats, batch: Batch, maps: LocalMaps, size: Floats, reach: Floats
) -> Evidence:
    """Sample the profiles of outlines.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8.
        noise: Covariance of its pixel noise, (3, 3).
        batch: The outlines.
        maps: Their local coordinates.
        size: ndarray of shape (K,): root of their areas.
        reach: ndarray of shape (K,): how far to look to either side, px.
    """
    normals_, reach_ = batch.geometry()
    starts, ends, normals = chunk_ends(batch, maps, normals_, reach_)
    columns = min(max(2 * math.ceil(float(reach.max())) + 1, 11), 41)
    profiles = sample(image, starts, ends, normals, reach, columns)
    if maps.plane is None:
        middle, outwards = profiles.middle - maps.centers[batch.index][:, None], normals
        offset = profiles.offset
    else:
        both = np.concatenate([profiles.middle, profiles.middle + normals], axis=1)
        local = maps.many_to_local(batch.index, both)
        middle, outwards = local[:, :CHUNKS], local[:, CHUNKS:] - local[:, :CHUNKS]
        rate = np.vecdot(outwards, normals_)
        offset = profiles.offset * rate.astype(np.float32)[..., None]
    low, high = clear_of_corners(batch, middle, outwards, normals_, reach_)
    free = profiles.inside & (profiles.offset > low[..., None]) & (profiles.offset < high[..., None])
    along = ends - starts
    chord = np.hypot(along[..., 0], along[..., 1])
    spacing = 2.0 * reach / (columns - 1)
    # One pixel's worth of noise for every px^2: samples nearer to each other than that share theirs.
    lines = np.minimum(np.maximum(chord, 0.25), profiles.pixels) * np.minimum(spacing, 1.0)[:, None]
    free_ = free.astype(np.float32)
    value = _contrasts(profiles, middle, free_, noise, size)
    weight = free_ * lines.astype(np.float32)[..., None]
    return Evidence(value, free_, weight, offset, middle, chord, lines, spacing)


def _contrasts(profiles: Profiles, middle: Floats, free: Floats32, noise: Floats, size: Floats) -> Floats32:
    """Profiles relative to the object's own colour, along each chunk's contrast, in units of the noise.

    The object's colour is a plane fitted to the inner third of all profiles; what lies outside may differ from
    chunk to chunk in any direction (table, shadow, side face, neighbour), so that each has its own projection.

    Returns:
        ndarray of shape (K, CHUNKS, D), 0 inside and positive outside.
    """
    count, _, columns = profiles.values.shape[:3]
    third = columns // 3
    inside = profiles.values[:, :, :third].reshape(count, -1, 3)
    usable = free[:, :, :third].reshape(count, -1) + np.float32(1e-6)
    # The plane slopes along the outline; across the few px of a profile it is level.
    at = (middle / size[:, None, None]).astype(np.float32)
    plane = np.concatenate([np.ones((*at.shape[:2], 1), np.float32), at], axis=2)
    basis = np.repeat(plane, third, axis=1)
    rest = inside - median(inside, 1)[:, None]
    face = np.zeros((count, 3, 3), np.float32)
    for _ in range(2):
        far = np.sqrt(np.vecdot(rest, rest))
        limit = np.maximum(4.0 * median(far, 1), 3.0)[:, None]
        w = usable * tukey(far / limit)
        weighted = (basis * w[..., None]).transpose(0, 2, 1)
        normal = weighted @ basis + _UPRIGHT
        face = np.linalg.solve(normal, weighted @ inside).astype(np.float32)
        rest = inside - basis @ face
    relative = profiles.values - (plane @ face)[:, :, None]
    outer = relative[:, :, -third:].mean(axis=2)
    direction = outer @ np.linalg.inv(noise)
    length = np.sqrt(np.maximum(np.vecdot(outer, direction), 1e-12))
    toward = (direction / length[..., None]).astype(np.float32)
    return np.asarray(np.vecdot(relative, toward[:, :, None]), np.float32)


def fit(evidence: Evidence, batch: Batch, steps: int) -> State:
    """Gauss-Newton steps over shape and blur, `steps` at most; changes `batch.q` and `batch.blur`.

    Returns:
        Where the fit stands after the last step.
    """
    weight = evidence.weight
    for step in range(steps + 1):
        distance, jacobian = side_distance(batch, evidence.middle, evidence.chord)
        sharpness = (1.0 / batch.blur).astype(np.float32)[:, None, None]
        z = (evidence.offset + distance.astype(np.float32)[..., None]) * sharpness
        unlit, bell = _normal(z)
        bell *= sharpness
        if step > 0:
            weight = _weights(evidence, weight, unlit, bell, batch.together)
        if step == steps:
            around, _ = _edge_heights(weight, unlit, evidence.value)
            shift: Floats = np.zeros(weight.shape[:2])
            break
        dark, slope, wider = weight * unlit, weight * bell, z * bell
        bent = weight * wider
        energy = np.maximum(_dot(dark, unlit), 1e-9)
        around = _dot(dark, evidence.value) / energy
        # B of every chunk is eliminated: only what is perpendicular to it can move the outline.
        along, across = _dot(slope, unlit), -_dot(dark, wider)
        target = evidence.value - around.astype(np.float32)[..., None] * unlit
        gain = around * around
        moves = gain * (_dot(slope, bell) - along * along / energy)
        mixed = -gain * (_dot(slope, wider) + along * across / energy)
        blurs = gain * (_dot(bent, wider) - across * across / energy)
        normal = np.empty((len(distance), PARAMETERS + 1, PARAMETERS + 1))
        asked = np.empty((len(distance), PARAMETERS + 1, 1))
        turned = jacobian.transpose(0, 2, 1)
        normal[:, :-1, :-1] = turned @ (jacobian * moves[..., None])
        normal[:, :-1, -1] = normal[:, -1, :-1] = (turned @ mixed[..., None])[..., 0]
        normal[:, -1, -1] = blurs.sum(axis=1)
        asked[:, :-1] = turned @ (around * _dot(slope, target))[..., None]
        asked[:, -1, 0] = (-around * _dot(bent, target)).sum(axis=1)
        normal += (np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1.0) * _RIDGE
        change = np.linalg.solve(normal, asked)[..., 0]
        np.copyto(change, 0.0, where=~np.isfinite(change))
        move, swing = np.minimum(np.maximum(change[:, :PARAMETERS], -1.5), 1.5), change[:, PARAMETERS]
        swing = np.minimum(np.maximum(swing, -0.4 * batch.blur), 0.6 * batch.blur)
        settled = bool((np.abs(swing) < _SETTLED * batch.blur).all())
        batch.q += move
        batch.blur = np.minimum(np.maximum(batch.blur + swing, 0.35), 20.0)
        if step > 0 and settled:
            # So small a step changes the distances by their derivatives, and nothing else.
            shift = (jacobian @ move[..., None])[..., 0]
            if float(np.abs(shift).max()) < _SETTLED:
                break
    stray, information = _strays(evidence, evidence.weight, around, unlit, bell)
    return State(evidence, distance + shift, unlit, around, stray + shift, information)


def _normal(z: Floats32) -> tuple[Floats32, Floats32]:
    """The normal distribution, good to 2e-7, and its density.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, 26.2.17.
    """
    density = np.exp(z * z * np.float32(-0.5))
    density *= _PEAK
    t = 1.0 / (np.abs(z) * _SLOPE + np.float32(1.0))
    series = t * _TAIL[4]
    for factor in _TAIL[3::-1]:
        series += factor
        series *= t
    series *= density
    return np.where(z < 0.0, series, np.float32(1.0) - series), density


def _dot(a: Floats32, b: Floats32) -> Floats:
    """Scalar products (K, CHUNKS) of profiles."""
    return np.asarray(np.vecdot(a, b), np.float64)


def _edge_heights(weight: Floats32, unlit: Floats32, value: Floats32) -> tuple[Floats, Floats]:
    """Height (K, CHUNKS) of each chunk's edge, and its information."""
    dark = weight * unlit
    energy = np.maximum(_dot(dark, unlit), 1e-9)
    return _dot(dark, value) / energy, energy


def _weights(
    evidence: Evidence, weight: Floats32, unlit: Floats32, bell: Floats32, together: Rows
) -> Floats32:
    """Weights (K, CHUNKS, D) without what strays, from those of the step before."""
    around, _ = _edge_heights(weight, unlit, evidence.value)
    root = np.sqrt(evidence.lines).astype(np.float32)[..., None]
    rest = np.abs((evidence.value - around.astype(np.float32)[..., None] * unlit) * (root * evidence.free))
    spread = np.maximum(1.0, 1.4826 * median(rest.reshape(len(rest), -1), 1))
    kept = tukey(rest / (6.0 * spread[:, None, None]))
    stray, information = _strays(evidence, weight, around, unlit, bell)
    agreement = _agreement(stray, information, together).astype(np.float32)
    return np.asarray(evidence.weight * kept * agreement[..., None], np.float32)


def _strays(
    evidence: Evidence, weight: Floats32, around: Floats, unlit: Floats32, bell: Floats32
) -> tuple[Floats, Floats]:
    """How far the edge of each chunk lies outside the outline (K, CHUNKS), and that figure's information."""
    slope = weight * bell
    information = around * around * _dot(slope, bell)
    deviation = around * (_dot(slope, evidence.value) - around * _dot(slope, unlit))
    return deviation / np.maximum(information, 1e-9), information


def _agreement(stray: Floats, information: Floats, together: Rows) -> Floats:
    """Tukey's weight (K, CHUNKS) of chunks by how far they stray from the others that move with them.

    Contacts with neighbours stray far; a whole side of a rectangle may, as long as it has not been found.

    Args:
        stray: ndarray of shape (K, CHUNKS).
        information: ndarray of shape (K, CHUNKS).
        together: ndarray of shape (K,): how many chunks in a row move together.
    """
    # Raised by more than any stray from group to group, all groups of a row are sorted at once.
    group = _CHUNK // together[:, None]
    raised = np.fmin(np.fmax(stray, -_FAR), _FAR) + 4.0 * _FAR * group
    ordered = np.sort(raised, axis=1)
    first, rows = group * together[:, None], np.arange(len(stray))[:, None]
    low, high = first + ((together - 1) // 2)[:, None], first + (together // 2)[:, None]
    apart = np.abs(raised - 0.5 * (ordered[rows, low] + ordered[rows, high]))
    limit = 4.0 * np.maximum(1.4826 * median(apart, 1), 0.04)[:, None] + 3.0 / np.sqrt(np.maximum(information, 1e-9))
    # Not quite nothing: the surroundings of a chunk are still to be estimated.
    return np.asarray(np.maximum(tukey(apart / limit), 1e-4))

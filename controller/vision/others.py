"""Objects of no known shape: regions that nothing explains, with a sharp edge all around."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.profiles import sample
from controller.vision.proposals import Region
from controller.vision.scene import boxes

Floats = NDArray[np.float64]

_POINTS = 96
_COLUMNS = 17
_SAME_STRENGTH = 0.75
"""What is left of a region is part of the object when it is at least this strong, against its known pieces."""
_ON = 4.0
"""Points nearer than this, px, to an outline lie on it: two cues differ by a blur."""
_RAGGED = 1.3
"""How much longer an outline may be than its region's boundary: what jumps from edge to edge is texture or glare.

Objects on photographs reach 1.24.
"""
_SEEN = 0.85
"""Share of the outline that must be seen as a sharp edge."""


@dataclass(frozen=True, slots=True, eq=False)
class Other:
    """An object of no known shape.

    Attributes:
        outline: ndarray of shape (N, 2), px.
        score: Confidence in [0, 1].
        levels: Contrast, levels.
        pieces: Which known outlines are only pieces of it.
    """

    outline: Floats
    score: float
    levels: float
    pieces: frozenset[int]


def other_objects(
    image: NDArray[np.uint8],
    noise: Floats,
    regions: Sequence[Region],
    factor: int,
    known: Sequence[Floats],
    hidden: Sequence[int],
    blur: float,
    minimum_contrast: float,
    smallest: float,
    *,
    whole: Sequence[int],
    strength: Callable[[Floats], Floats] | None,
) -> list[Other]:
    """Objects that no known outline explains.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8.
        noise: Covariance of its pixel noise.
        regions: The proposed regions.
        factor: How many times smaller the searched image is.
        known: Outlines already accepted, px.
        hidden: Which of them are pieces of one colour with something else.
        blur: Typical blur of the frame's edges, px; 0 when nothing tells.
        minimum_contrast: Smallest step believed, levels.
        smallest: Smallest width worth reporting, px.
        whole: Which of `known` are certainly no pieces: what sticks out beside them is a shadow or a side face,
            unless it is as strong as they are.
        strength: How far the picture differs from the table at points (N, 2), px; None where side faces show.
    """
    candidates = [
        (item.contour.astype(np.float64) * factor + (factor - 1) / 2.0, item.core)
        for item in sorted(regions, key=lambda item: item.area)
        if item.cue in ("level", "chroma") and item.area * factor**2 >= 0.5 * smallest**2
    ]
    if not candidates:
        return []
    middles = np.array([outline.mean(axis=0) for outline in known]).reshape(-1, 2)
    low, high = np.hsplit(boxes(known), 2)
    areas = [abs(float(cv2.contourArea(outline.astype(np.float32)))) for outline in known]
    certain = set(whole)
    kept: list[tuple[Floats, set[int], bool]] = []
    for contour, core in candidates:
        polygon = contour.astype(np.float32)
        covered = abs(float(cv2.contourArea(polygon)))
        around = (middles >= polygon.min(axis=0)) & (middles <= polygon.max(axis=0))
        inside = [int(i) for i in np.flatnonzero(around.all(axis=1)) if _contains(polygon, middles[i])]
        total = sum(areas[i] for i in inside)
        joined = _aligned([known[i] for i in inside if i in hidden])
        if total > 0.85 * covered and not joined:
            continue
        rest = core and bool(inside) and strength is not None and _as_strong(strength, polygon, known, inside)
        if any(i in certain for i in inside) and not rest:
            continue
        if not core and total > 0.3 * covered:
            continue
        middle = _middle(polygon)
        over = [int(i) for i in np.flatnonzero(((low <= middle) & (high >= middle)).all(axis=1))]
        if any(i not in inside and _contains(known[i].astype(np.float32), middle) for i in over):
            continue
        kept.append((contour, set(inside), rest))
    if not kept:
        return []
    outlines, seen, sharp, levels = _on_edges(image, noise, [contour for contour, _, _ in kept], blur, minimum_contrast)
    chosen: list[Other] = []
    order = sorted(zip(outlines, seen, sharp, kept, levels, strict=True), key=lambda item: _place(item[0], item[2]))
    for outline, edge, strict, (contour, pieces, rest), contrast in order:
        polygon = outline.astype(np.float32)
        # Where the picture ends there is no edge to be seen.
        height, width = image.shape[:2]
        end = 3.0 * factor
        within = (outline > end).all(axis=1) & (outline[:, 0] < width - end) & (outline[:, 1] < height - end)
        share = float(edge[within].mean()) if within.sum() > _POINTS // 3 else 0.0
        if pieces:
            # What sticks out beyond known shapes must be sharp by itself: a shadow is not.
            free = _away(outline, [known[i] for i in pieces])
            sharp_share = float(strict[free].mean()) if free.sum() > 4 else 0.0
            # Of one strength with the rest, as the head of a bolt, or without an edge to it, a known shape is a piece:
            # the rest may be rough.
            rough = sharp_share if not rest or pieces & certain else float(edge[free].mean()) if free.sum() > 4 else 0.0
            share = min(share, max(sharp_share, _SEEN if rough > 0.6 and (rest or pieces <= set(hidden)) else 0.0))
        own = abs(float(cv2.contourArea(polygon)))
        if _length(outline) > _RAGGED * _length(_even(contour)):
            continue
        if share < _SEEN or min(cv2.minAreaRect(polygon)[1]) < 0.55 * smallest or own < 0.5 * smallest**2:
            continue
        # Two cues may both propose it.
        if any(_within(outline, o) > 0.5 or _within(o, outline) > 0.5 for o in (other.outline for other in chosen)):
            continue
        chosen.append(Other(outline, 0.5 + 0.5 * (share - _SEEN) / (1.0 - _SEEN), contrast, frozenset(pieces)))
    return chosen


def _as_strong(
    strength: Callable[[Floats], Floats], polygon: NDArray[np.float32], known: Sequence[Floats], inside: list[int]
) -> bool:
    """Whether what known outlines leave of a region differs from the table as much as they do: no shadow of theirs."""
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    x, y = np.meshgrid(*(np.linspace(a, b, 24) for a, b in zip(low, high, strict=True)))
    grid = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    grid = np.array([point for point in grid if cv2.pointPolygonTest(polygon, point.tolist(), True) > 3.0])
    if not len(grid):
        return False
    away = np.ones(len(grid), bool)
    for i in inside:
        outline = known[i].astype(np.float32)
        away &= np.array([cv2.pointPolygonTest(outline, point.tolist(), True) < -3.0 for point in grid])
    values = strength(grid)
    if away.sum() < 0.1 * len(grid) or away.all():
        return False
    return float(np.median(values[away])) > _SAME_STRENGTH * float(np.median(values[~away]))


def _place(outline: Floats, strict: NDArray[np.bool_]) -> tuple[bool, float]:
    """Of outlines of one thing those that are sharp nearly everywhere come first, the largest of them before all.

    What lies within an object, its glints and dark sides, is sharp as well; a shadow around it is not.
    """
    share = float(strict.mean())
    clear = share > 0.9 * _SEEN
    return not clear, -abs(float(cv2.contourArea(outline.astype(np.float32)))) if clear else -share


def _away(points: Floats, outlines: list[Floats]) -> NDArray[np.bool_]:
    """Which points are more than 4 px from all outlines."""
    polygons = [outline.astype(np.float32) for outline in outlines]
    return np.array(
        [all(abs(cv2.pointPolygonTest(p, (float(x), float(y)), True)) > 4.0 for p in polygons) for x, y in points]
    )


def _aligned(outlines: list[Floats]) -> bool:
    """Whether two four-sided outlines lie along the same directions, as the arms of an L do."""
    turns = []
    for outline in outlines:
        if len(outline) == 4:
            side = outline[1] - outline[0]
            turns.append(math.degrees(math.atan2(side[1], side[0])) % 90.0)
    return any(
        min(abs(a - b), 90.0 - abs(a - b)) < 3.0 for i, a in enumerate(turns) for b in turns[i + 1 :]
    )


def _length(outline: Floats) -> float:
    """Length of a closed outline (N, 2)."""
    side = np.roll(outline, -1, axis=0) - outline
    return float(np.hypot(side[:, 0], side[:, 1]).sum())


def _within(outline: Floats, other: Floats) -> float:
    """Share of an outline's points that lie in or on another outline, which may be concave."""
    polygon = other.astype(np.float32)
    low, high = polygon.min(axis=0) - _ON, polygon.max(axis=0) + _ON
    near = outline[((outline >= low) & (outline <= high)).all(axis=1)]
    inside = sum(cv2.pointPolygonTest(polygon, (float(x), float(y)), True) > -_ON for x, y in near)
    return inside / len(outline)


def _contains(polygon: NDArray[np.float32], point: Floats) -> bool:
    return cv2.pointPolygonTest(polygon, (float(point[0]), float(point[1])), False) > 0.0


def _middle(polygon: NDArray[np.float32]) -> Floats:
    return np.asarray(polygon.mean(axis=0), np.float64)


def _on_edges(
    image: NDArray[np.uint8], noise: Floats, contours: list[Floats], blur: float, minimum_contrast: float
) -> tuple[list[Floats], list[NDArray[np.bool_]], list[NDArray[np.bool_]], list[float]]:
    """Contours moved onto the nearest edge, where there is one and where a sharp one, and their contrasts, levels."""
    count = len(contours)
    points = np.stack([_even(contour) for contour in contours])
    ahead, back = np.roll(points, -1, axis=1), np.roll(points, 1, axis=1)
    tangent = ahead - back
    tangent /= np.maximum(np.linalg.norm(tangent, axis=2, keepdims=True), 1e-9)
    normal = np.stack([tangent[..., 1], -tangent[..., 0]], axis=2)
    areas = 0.5 * np.sum(points[..., 0] * ahead[..., 1] - ahead[..., 0] * points[..., 1], axis=1)
    normal *= np.sign(areas)[:, None, None]
    window = np.full(count, max(5.0, 4.0 * blur))
    half = 0.25 * (ahead - back)
    profiles = sample(image, points - half, points + half, normal, window, _COLUMNS)
    values = profiles.values @ np.linalg.inv(np.linalg.cholesky(noise)).T
    spacing = 2.0 * window[0] / (_COLUMNS - 1)
    slope = np.linalg.norm(values[:, :, 2:] - values[:, :, :-2], axis=3) / (2.0 * spacing)
    step = values[:, :, :4].mean(axis=2) - values[:, :, -4:].mean(axis=2)
    height = np.linalg.norm(step, axis=2)
    best = slope.argmax(axis=2)
    top = slope.max(axis=2)
    # The steepest slope of an edge of blur s and height h is h / (s sqrt(2 pi)).
    width = height / np.maximum(top * math.sqrt(2.0 * math.pi), 1e-9)
    level = math.sqrt(float(noise.trace()) / 3.0)
    clear = height * np.sqrt(profiles.pixels) > 6.0
    clear &= height * level > minimum_contrast
    if blur <= 0.0:
        blur = float(np.median(width[clear])) if clear.any() else 1.0
    seen = clear & (width < 2.2 * max(blur, 0.7) + 0.6)
    sharp = clear & (width < 1.5 * max(blur, 0.7) + 0.4)
    at = (best + 1 - (_COLUMNS - 1) / 2.0) * spacing
    at = np.where(seen, at, 0.0)
    at = np.median(np.stack([np.roll(at, i, axis=1) for i in (-2, -1, 0, 1, 2)]), axis=0)
    moved = points + at[..., None] * normal
    return list(moved), list(seen), list(sharp), [float(v) for v in np.median(height, axis=1) * level]


def _even(contour: Floats) -> Floats:
    """The contour smoothed a little and sampled at _POINTS equal distances."""
    if len(contour) > 12:
        contour = 0.25 * np.roll(contour, 1, axis=0) + 0.5 * contour + 0.25 * np.roll(contour, -1, axis=0)
    side = np.roll(contour, -1, axis=0) - contour
    length = np.maximum(np.linalg.norm(side, axis=1), 1e-9)
    ends = np.cumsum(length)
    at = np.arange(_POINTS) / _POINTS * ends[-1]
    which = np.searchsorted(ends, at, side="right").clip(0, len(contour) - 1)
    return np.asarray(contour[which] + side[which] * ((at - ends[which] + length[which]) / length[which])[:, None])

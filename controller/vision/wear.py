"""What the strays of an outline from its fitted shape tell: wear and noise are irregular, another shape is not.

A worn coin and an octagon leave a circle equally far. The coin does so at random, the octagon eight times a turn,
an ellipse twice. A chipped tile leaves its square here and there, a trapezoid along whole sides, a rounded square
at all corners alike.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.profiles import CHUNKS
from controller.vision.refine import Refined
from controller.vision.shapes import CIRCLE, Family

Floats = NDArray[np.float64]

_HARMONICS = np.arange(CHUNKS // 2 + 1)
_TURNS = (np.arange(CHUNKS) + 0.5) * 2.0 * math.pi / CHUNKS
_WAVES = np.exp(1j * np.multiply.outer(_HARMONICS, _TURNS))
_FOLDS = {2: 0.85, 3: 0.75, 4: 0.6, 5: 0.65, 6: 0.55, 7: 0.6, 8: 0.45}
"""Share of the strays' variance that may repeat so many times a turn.

Irregular outlines of coins, sweets and rings reach 0.76 for two, 0.6 for five and 0.5 for the others; an ellipse has
0.95 for two.
"""
_PLAIN = 0.7
"""The same share for an outline that fits well: nothing but the pattern is left."""
_SIDEWISE = 0.5
_ROUND_SHARE = 0.65
"""Share of an outline that must lie on a circle; glints and dark sides take the rest."""
_WIDEST_BITE = math.radians(100.0)


def another_shape(family: Family, refined: Refined, size: float) -> bool:
    """Whether the strays follow the pattern of another shape: an ellipse, an octagon, a trapezoid.

    Args:
        family: The fitted shape's.
        refined: What the pixels say.
        size: Root of the outline's area, local units.
    """
    # Also what strays too far to count as seen belongs to the pattern.
    seen = refined.seen | (~refined.blank & (np.abs(refined.strays) < 0.03 * size))
    if seen.sum() < CHUNKS // 2:
        return True
    if family is CIRCLE:
        return _patterned(refined.strays, seen)
    strays = np.where(seen, refined.strays - refined.strays[seen].mean(), 0.0)
    return _sidewise(strays, len(family.normals)) > _SIDEWISE * float(np.sum(strays**2)) + 1e-12


def round_outline(points: Floats, slack: float) -> tuple[Floats, float] | None:
    """Centre and radius, px, of the disc that an outline is, bites and dents aside; None when it is none.

    Args:
        points: ndarray of shape (N, 2), px, evenly spaced along the outline.
        slack: How far, px, edges may lie from the circle besides the share of its radius that wear takes.
    """
    hull = cv2.convexHull(points.astype(np.float32))[:, 0]
    (x, y), reach = cv2.minEnclosingCircle(hull)
    center, radius = np.array([x, y], np.float64), 0.97 * reach
    for step in range(8):
        away = points - center
        length = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)
        # Bites lie inside: the scale narrows from a tenth of the radius.
        width = max(0.1 * radius * 0.75**step, 0.02 * radius + slack)
        weight = (1.0 - np.minimum(np.abs(length - radius) / (2.0 * width), 1.0) ** 2) ** 2
        basis = np.column_stack([away / length[:, None], np.ones(len(points))])
        normal = basis.T @ (basis * weight[:, None]) + 1e-6 * np.eye(3)
        change = np.linalg.solve(normal, basis.T @ (weight * (length - radius)))
        center, radius = center + change[:2], radius + float(change[2])
        if not 0.6 * reach < radius < 1.1 * reach:
            return None
    away = points - center
    strays = np.hypot(away[:, 0], away[:, 1]) - radius
    near = np.abs(strays) < 0.03 * radius + 0.5 * slack
    turns = np.arctan2(away[:, 1], away[:, 0])
    seen = np.sort(turns[near])
    if near.mean() < _ROUND_SHARE or (strays > 0.05 * radius + slack).mean() > 0.05:
        return None
    gaps = np.diff(np.concatenate([seen, seen[:1] + 2.0 * math.pi]))
    if gaps.max() > _WIDEST_BITE:
        return None
    # The same harmonics as of a fitted outline, on the part that is seen.
    bins = np.floor((turns + math.pi) / (2.0 * math.pi) * CHUNKS).astype(int) % CHUNKS
    count = np.bincount(bins[near], minlength=CHUNKS)
    mean = np.bincount(bins[near], strays[near], CHUNKS) / np.maximum(count, 1)
    regular = float(np.sqrt(np.mean(mean[count > 0] ** 2))) > 0.01 * radius and _patterned(mean, count > 0)
    return None if regular else (center, radius)


def _patterned(strays: Floats, seen: NDArray[np.bool_]) -> bool:
    """Whether what leaves a circle repeats itself around it, as the sides of a polygon or an ellipse do."""
    strays = np.where(seen, strays - strays[seen].mean(), 0.0)
    power = _power(strays)
    return any(_repeated(power, fold) > most * float(power.sum()) for fold, most in _FOLDS.items())


def _power(strays: Floats) -> Floats:
    """Power in every harmonic from 0 to half the number of chunks, of what is common: a contact strays far but once."""
    common = _common(strays)
    power = 2.0 * np.abs(_WAVES @ common) ** 2
    power[-1] *= 0.5
    return np.asarray(power)


def _common(strays: Floats) -> Floats:
    """Strays with those that are far larger than most cut short."""
    limit = 2.5 * float(np.median(np.abs(strays)))
    kept = np.clip(strays, -limit, limit) if limit > 0.0 else strays
    return np.asarray(kept - kept.mean())


def _repeated(power: Floats, fold: int) -> float:
    """Power in a harmonic and its next two multiples, where sampling by chunks folds them to."""
    multiples = {min(k * fold % CHUNKS, -k * fold % CHUNKS) for k in (1, 2, 3)} if fold > 2 else set(range(2, 13, 2))
    return float(sum(power[k] for k in multiples if k))


def many_sided(refined: Refined) -> bool:
    """Whether what leaves a circle, little as it is, repeats itself four to eight times around it."""
    seen = refined.seen
    strays = np.where(seen, refined.strays - refined.strays[seen].mean(), 0.0)
    # chi measures strays in units of their own deviation.
    deviation = math.sqrt(float(np.sort(strays**2)[: round(0.9 * CHUNKS)].mean()) / max(refined.chi, 1e-9))
    if float(np.sqrt(np.mean(_common(strays) ** 2))) < 1.5 * deviation:
        return False
    power = _power(strays)
    # What the fit has down-weighted of an octagon's corners leaks into the neighbouring harmonics.
    if power[8] == power.max() and float(power[7:10].sum()) > 0.55 * float(power.sum()):
        return True
    return any(_repeated(power, fold) > _PLAIN * float(power.sum()) for fold in range(4, 8))


def _sidewise(strays: Floats, sides: int) -> float:
    """Sum of squares that straight lines along every side and one bend common to all sides explain."""
    length = CHUNKS // sides
    along = np.linspace(-1.0, 1.0, length)
    bend = along**2 - np.mean(along**2)
    rows = strays.reshape(sides, length)
    slopes = rows @ along / np.sum(along**2)
    bends = float(np.mean(rows @ bend)) / float(np.sum(bend**2))
    return float(np.sum(slopes**2) * np.sum(along**2) + sides * bends**2 * np.sum(bend**2))

"""Sub-pixel refinement: the outline, blur and colours that explain the pixels along the edge best.

Near its edge an object looks like I = B + (F - B) Phi(-d / s): d the signed distance from the outline, s the blur,
Phi the normal distribution, F a plane over the object, B a slowly varying ring around it. Gauss-Newton over all
of them at once, on every pixel of a band, with Tukey weights, comes close to the Cramer-Rao bound.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from controller.vision.local_map import LocalMaps
from controller.vision.shapes import Family, area, signed_distance, vertices

Floats = NDArray[np.float64]

_BINS = 24
_CORNER = 1.6
"""Pixels whose two nearest sides are closer than this many blurs see a rounded corner, not an edge."""


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """What the pixels say about one outline.

    Attributes:
        q: Parameters in local coordinates.
        blur: Standard deviation of the edge's blur, px.
        contrast: Difference across the edge in units of the pixel noise.
        levels: The same in gray levels (root mean square over the channels).
        misfit: How far the true outline strays from the fitted one beyond the noise, px (rms).
        visible: Share of the outline where an edge is to be seen.
        seen: ndarray of shape (_BINS,), dtype bool: the same by direction from the centre.
    """

    q: Floats
    blur: float
    contrast: float
    levels: float
    misfit: float
    visible: float
    seen: NDArray[np.bool_]


def pixel_noise(image: NDArray[np.uint8]) -> Floats:
    """Covariance (3, 3) of the pixel noise, from differences of neighbours on a sample of rows."""
    height, width = image.shape[:2]
    rows = image[:: max(1, height // 60)].astype(np.float64)
    if width < 4:
        return np.eye(3)
    # The second difference is blind to slopes; its variance is 6 times the noise's.
    second = (rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:])[:, :: max(1, width // 160)].reshape(-1, 3)
    scale = np.maximum(1.4826 * np.median(np.abs(second), axis=0), 0.5)
    kept = second[(np.abs(second) < 3.5 * scale).all(axis=1)]
    covariance = kept.T @ kept / max(len(kept), 1) / 6.0
    # Rounding to levels alone has a variance of 1/12; compression hides the noise in flat blocks.
    return np.asarray(covariance + np.eye(3) * 0.3)


def refine(
    image: NDArray[np.uint8], noise: Floats, family: Family, q: Floats, maps: LocalMaps, k: int, blur: float
) -> Refined | None:
    """The outline refined on the pixels of `image`, or None when it runs away or leaves nothing to see.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8.
        noise: Covariance of the pixel noise, (3, 3).
        family: Its family.
        q: Start, local coordinates, within a few pixels of the truth.
        maps: The local coordinates.
        k: Which object of `maps`.
        blur: Expected blur, px.
    """
    start = q.copy()
    size = math.sqrt(float(area(family, q[None])[0]))
    fit: _Fit | None = None
    for _ in range(3):
        band = min(max(3.0, 3.0 * blur), max(3.0, 0.3 * size))
        pixels, values = _band(image, family, q, maps, k, band)
        if len(values) < 30:
            return None
        fit = _fit(family, q, maps.to_local(k, pixels), values, noise, blur, size)
        if fit is None:
            return None
        q = fit.q
        wanted = min(max(3.0, 3.0 * fit.blur), max(3.0, 0.3 * size))
        settled = abs(wanted - band) < 0.35 * band
        blur = fit.blur
        if settled:
            break
    assert fit is not None
    moved = math.hypot(q[0] - start[0], q[1] - start[1])
    grown = float(area(family, q[None])[0]) / size**2
    if moved > 0.15 * size + 2.0 or not 0.6 < grown < 1.6:
        return None
    return fit.refined()


def _band(
    image: NDArray[np.uint8], family: Family, q: Floats, maps: LocalMaps, k: int, band: float
) -> tuple[Floats, Floats]:
    """Pixels (N, 2) within about `band` of the outline and their colours (N, 3)."""
    outline = maps.to_pixels(k, vertices(family, q))
    height, width = image.shape[:2]
    margin = int(band) + 3
    low = np.floor(outline.min(axis=0)).astype(int) - margin
    high = np.ceil(outline.max(axis=0)).astype(int) + margin + 1
    x0, y0 = max(0, low[0]), max(0, low[1])
    x1, y1 = min(width, high[0]), min(height, high[1])
    if x1 - x0 < 3 or y1 - y0 < 3:
        return np.empty((0, 2)), np.empty((0, 3))
    mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
    points = np.rint((outline - (x0, y0)) * 16).astype(np.int32)
    cv2.polylines(mask, [points[:, None]], True, 1, thickness=2 * math.ceil(band) + 1, shift=4)
    ys, xs = np.nonzero(mask)
    pixels = np.stack([xs + x0, ys + y0], axis=1).astype(np.float64)
    return pixels, image[y0:y1, x0:x1][ys, xs].astype(np.float64)


@dataclass(slots=True, eq=False)
class _Fit:
    q: Floats
    blur: float
    contrast: float
    levels: float
    rest: Floats
    good: NDArray[np.bool_]
    inside: Floats
    value: Floats
    turn: Floats

    def refined(self) -> Refined:
        squared = np.sort(self.rest[self.good] ** 2)
        trimmed = float(squared[: max(1, int(0.97 * len(squared)))].mean()) / 0.84
        edge = math.sqrt(self.blur**2 + 1.0 / 12.0)
        misfit = 2.5 * edge * math.sqrt(max(trimmed - 1.0, 0.0)) / max(self.contrast, 1e-6)
        seen, present = self._seen(math.sqrt(max(trimmed, 1.0)))
        visible = float(seen[present].mean()) if present.any() else 0.0
        return Refined(self.q, self.blur, self.contrast, self.levels, misfit, visible, seen)

    def _seen(self, noise: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """By direction: whether an edge of the right sign stands out of the noise, and whether one could."""
        turn = np.floor((self.turn / (2.0 * math.pi) % 1.0) * _BINS).astype(np.intp) % _BINS
        turn, inside, value = turn[self.good], self.inside[self.good], self.value[self.good]
        n = np.maximum(np.bincount(turn, minlength=_BINS), 1)
        mean_i = np.bincount(turn, inside, _BINS) / n
        mean_v = np.bincount(turn, value, _BINS) / n
        var = np.bincount(turn, inside**2, _BINS) / n - mean_i**2
        cov = np.bincount(turn, inside * value, _BINS) / n - mean_i * mean_v
        present = var * n > 0.3
        step = cov / np.maximum(var, 1e-6)
        error = noise / np.sqrt(np.maximum(var * n, 1e-6))
        return np.asarray(step > np.maximum(3.0 * error, 0.12 * self.contrast)), np.asarray(present)


def _fit(
    family: Family, q: Floats, points: Floats, values: Floats, noise: Floats, blur: float, size: float
) -> _Fit | None:
    distance, _, _ = (item[0] for item in signed_distance(family, q[None], points[None]))
    inner, outer = values[distance < -1.2 * blur], values[distance > 1.2 * blur]
    if len(inner) < 8 or len(outer) < 8:
        return None
    difference = np.median(inner, axis=0) - np.median(outer, axis=0)
    direction = np.linalg.solve(noise, difference)
    contrast = math.sqrt(max(float(difference @ direction), 1e-12))
    value = values @ (direction / contrast)
    x, y = points[:, 0] / size, points[:, 1] / size
    turn = np.arctan2(y - q[1] / size, x - q[0] / size)
    ring = np.stack([np.ones_like(x), np.cos(turn), np.sin(turn), np.cos(2 * turn), np.sin(2 * turn)])
    face = np.stack([np.ones_like(x), x, y])
    q = q.copy()
    count = len(face) + len(ring)
    weight = np.ones(len(value))
    rest, inside = value, value
    good = np.ones(len(value), bool)
    colours: Floats | None = None
    for step in range(5):
        distance, jacobian, gap = (item[0] for item in signed_distance(family, q[None], points[None]))
        z = -distance / blur
        inside = ndtr(z)
        bell = np.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * blur)
        good = gap > _CORNER * blur
        if good.sum() < 20:
            return None
        linear = np.concatenate([face * inside, ring * (1.0 - inside)])
        used = weight * good
        if colours is None:
            colours = _solve(linear * used, linear, value)
        rest = value - colours @ linear
        if step > 0:
            scale = max(1.0, 1.4826 * float(np.median(np.abs(rest[good]))))
            ratio = np.minimum(np.abs(rest) / (5.0 * scale), 1.0)
            used = good * (1.0 - ratio**2) ** 2
        jump = colours[:3] @ face - colours[3:] @ ring
        slope = -jump * bell
        rows = np.concatenate([linear, slope * jacobian.T, (slope * z)[None]])
        change = _solve(rows * used, rows, rest)
        colours = colours + change[:count]
        parameters = family.parameters
        q[:] += np.clip(change[count : count + parameters], -2.0, 2.0)
        blur = float(np.clip(blur + np.clip(change[-1], -0.4 * blur, 0.6 * blur), 0.35, 20.0))
        weight = used
        if not np.isfinite(q).all():
            return None
    levels = float(np.sqrt(np.mean(difference**2)))
    return _Fit(q, blur, contrast, levels, rest, good, inside, value, turn)


def _solve(weighted: Floats, rows: Floats, target: Floats) -> Floats:
    normal = weighted @ rows.T
    trace = np.trace(normal) / len(normal)
    normal[np.diag_indices_from(normal)] += 1e-7 * trace + 1e-12
    return np.asarray(np.linalg.solve(normal, weighted @ target))

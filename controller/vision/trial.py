"""Hypotheses tried on the pixels, and what of a frame the good ones explain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.fitting import Hypothesis
from controller.vision.refine import Refined, refine
from controller.vision.scene import Judged, Scene, whole
from controller.vision.shapes import area, vertices
from controller.vision.silhouette import feet

Floats = NDArray[np.float64]

_THIN = 0.55
"""Short side of the smallest object over its width: the smallest circle and a slim rectangle of its area."""


def tried(scene: Scene, wanted: list[Hypothesis], blur: float) -> list[Judged]:
    """Hypotheses refined, those with a visible outline."""
    settings, maps = scene.settings, scene.maps
    refined = refine(
        scene.image, scene.noise, [h.family for h in wanted], [h.q for h in wanted], maps,
        # Where side faces show, the rim beside a top face is looked at on purpose instead.
        [h.region for h in wanted], blur, restarts=0 if scene.sides else 3,
    )  # fmt: skip
    kept: list[tuple[Hypothesis, Refined, Floats]] = []
    for h, r in zip(wanted, refined, strict=True):
        if r is None or r.visible < settings.visible or r.levels < settings.minimum_contrast or r.contrast < 1.0:
            continue
        outline = maps.to_pixels(h.region, vertices(h.family, r.q))
        if not np.isfinite(outline).all() or _width(outline) < _THIN * settings.smallest_px:
            continue
        kept.append((h, r, outline))
    out = []
    for (h, r, outline), slack in zip(kept, _slack(scene, [outline for _, _, outline in kept]), strict=True):
        covered = float(area(h.family, r.q[None])[0])
        allowed = settings.misfit_px + settings.misfit_share * math.sqrt(covered) + slack
        (x0, y0), (x1, y1) = outline.min(axis=0), outline.max(axis=0)
        out.append(Judged(h, r, r.misfit / allowed, outline, covered, (float(x0), float(y0), float(x1), float(y1))))
    return out


def typical_blur(judged: Sequence[Judged], otherwise: float) -> float:
    """Median blur of the outlines that fit, px."""
    good = [item.refined.blur for item in judged if item.badness < 1.0]
    return float(np.median(good)) if good else otherwise


def _width(outline: Floats) -> float:
    """Short side of the minimum-area rectangle, px."""
    return float(min(cv2.minAreaRect(outline.astype(np.float32))[1]))


def _slack(scene: Scene, outlines: list[Floats]) -> list[float]:
    """Misfit, px, that side faces seen as a narrow rim beside each top face may cause."""
    if not scene.sides or scene.plane is None:
        return [0.0] * len(outlines)
    below = feet(outlines, scene.plane, 2.0 * scene.plane.height)
    shifts = [math.hypot(*(low - top).mean(axis=0)) for top, low in zip(outlines, below, strict=True)]
    return [min(0.4, 0.06 * shift) if math.isfinite(shift) else 0.0 for shift in shifts]


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """Outlines that need no further guess: polygons, and their boxes (K, 2) low and high; all px."""

    polygons: list[NDArray[np.float32]]
    low: Floats
    high: Floats
    factor: int

    def explains(self, rectangle: Sequence[int]) -> bool:
        """Whether what fills a rectangle (x, y, w, h) of the searched image is one of the outlines, not much more."""
        if not self.polygons:
            return False
        x, y, w, h = (float(v) * self.factor for v in rectangle)
        middle = (x + 0.5 * w, y + 0.5 * h)
        for i in np.flatnonzero(((self.low <= middle) & (self.high >= middle)).all(axis=1)):
            if cv2.pointPolygonTest(self.polygons[i], middle, False) > 0.0:
                size = self.high[i] - self.low[i]
                return w * h < 1.6 * float(size[0] * size[1]) + 8.0 * self.factor * float(size.sum())
        return False


def settled(judged: Sequence[Judged], factor: int) -> Settled:
    """The outlines that are seen completely and fit well; `factor` is how many times smaller the searched image is."""
    outlines = [item.outline for item in judged if whole(item)]
    low = np.array([o.min(axis=0) for o in outlines]).reshape(-1, 2)
    high = np.array([o.max(axis=0) for o in outlines]).reshape(-1, 2)
    return Settled([o.astype(np.float32) for o in outlines], low, high, factor)

"""Which of the refined outlines stay: the better of rivals, no patches of table, no shadows, no octagons."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.chunks import chunk_middles
from controller.vision.refine import refine
from controller.vision.scene import Judged, Scene, neighbours, sampled, shared
from controller.vision.shapes import CIRCLE, OCTAGON
from controller.vision.silhouette import reaches

Floats = NDArray[np.float64]

_TORN = 0.13
"""Share of an outline that may run elsewhere without a neighbour to blame."""
_TABLE = 2.3
"""Median strength, in standard deviations of the table, below which a face looks like the table (1.5 is typical)."""


def select(scene: Scene, judged: list[Judged]) -> list[Judged]:
    """The best of what overlaps.

    Of nested outlines that fit equally well the outer one is the object and the inner one a hole or a print;
    where side faces show it is the other way round, unless the inner one is much smaller: the inner one is the top.
    """
    good = [item for item in judged if item.badness <= 1.0 and not _table_like(scene, item)]
    blurs = [item.refined.blur for item in good]
    if blurs:
        # Shadows and glare have softer edges than the objects of the same frame.
        softest = 1.7 * float(np.median(blurs)) + 0.4
        good = [item for item in good if item.refined.blur <= softest]

    meets = neighbours(good)
    stays = [
        not any(_rival(item, good[j]) for j in np.flatnonzero(meet)) for item, meet in zip(good, meets, strict=True)
    ]
    good = [item for item, stay in zip(good, stays, strict=True) if stay]
    meets = meets[stays][:, stays]

    def rank(item: Judged) -> float:
        return max(item.badness, 0.6) + 2.0 * (1.0 - item.refined.visible)

    chosen: list[int] = []
    for i in sorted(range(len(good)), key=lambda i: (rank(good[i]), -good[i].area)):
        item, best = good[i], i
        if scene.sides:
            inner = [
                j
                for j in np.flatnonzero(meets[i]).tolist()
                if 0.5 * item.area < good[j].area < 0.97 * item.area
                and rank(good[j]) < rank(item) + 0.3
                and shared(item, good[j]) > 0.9
            ]
            best = min(inner, key=lambda j: rank(good[j]), default=i)
        if not any(meets[best, j] and shared(good[best], good[j]) > 0.15 for j in chosen):
            chosen.append(best)
    accepted = [good[i] for i in chosen]
    accepted = _without_octagons(scene, accepted)
    if scene.sides:
        return _without_shadows(scene, accepted)
    accepted = [item for item in accepted if not _strays(scene, item, accepted)]
    typical = float(np.median(blurs)) if blurs else 0.0
    return [item for item in accepted if not _shadow_strip(scene, item, accepted, typical)]


def _shadow_strip(scene: Scene, item: Judged, accepted: list[Judged], blur: float) -> bool:
    """Whether an outline is a strip of shadow along a larger object: the table's colour, darker, and softer."""
    if item.refined.blur < 1.12 * blur or not _shadow_like(scene, item):
        return False
    points = [(float(x), float(y)) for x, y in sampled(item.outline)]
    larger = [other.outline.astype(np.float32) for other in accepted if other.area > item.area]
    return any(np.mean([cv2.pointPolygonTest(o, point, True) > -4.0 for point in points]) > 0.12 for o in larger)


def _without_octagons(scene: Scene, accepted: list[Judged]) -> list[Judged]:
    """Outlines without the circles that an octagon explains better; only circles with some misfit are asked."""
    suspects = [item for item in accepted if item.hypothesis.family is CIRCLE and item.refined.chi > 3.0]
    starts = []
    for item in suspects:
        turns = (np.arange(len(item.refined.strays)) + 0.5) * 2.0 * math.pi / len(item.refined.strays)
        # Corners stick out of the circle; normals lie half way between them.
        corner = float(np.angle(np.sum(item.refined.strays * item.refined.seen * np.exp(8j * turns)))) / 8.0
        q = np.array([*item.refined.q[:2], 0.973 * item.refined.q[2], corner + math.pi / 8.0])
        starts.append(replace(item.hypothesis, family=OCTAGON, q=q))
    refined = refine(
        scene.image, scene.noise, [h.family for h in starts], [h.q for h in starts], scene.maps,
        [h.region for h in starts],
        float(np.median([item.refined.blur for item in suspects])) if suspects else 1.0,
        restarts=0,
    )  # fmt: skip
    octagons = {
        id(item)
        for item, r in zip(suspects, refined, strict=True)
        if r is not None and r.visible > 0.8 and r.chi < 0.5 * item.refined.chi
    }
    return [item for item in accepted if id(item) not in octagons]


def _strays(scene: Scene, item: Judged, accepted: list[Judged]) -> bool:
    """Whether an outline leaves its shape where no neighbour is to blame: a nut with a bolt in it, a torn edge."""
    off = ~item.refined.seen & ~item.refined.blank
    if off.mean() < _TORN:
        return False
    k, family, q = item.hypothesis.region, item.hypothesis.family, item.refined.q
    points = scene.maps.to_pixels(k, chunk_middles(family, q)[off])
    near = 4.0 + 0.1 * math.sqrt(item.area)
    others = [other.outline.astype(np.float32) for other in accepted if other is not item]
    alone = [
        all(cv2.pointPolygonTest(outline, (float(x), float(y)), True) < -near for outline in others) for x, y in points
    ]
    return sum(alone) > _TORN * len(off)


def _rival(item: Judged, other: Judged) -> bool:
    """Whether another family explains the same outline better."""
    if other is item or other.hypothesis.family is item.hypothesis.family or abs(other.area / item.area - 1.0) > 0.2:
        return False
    return other.refined.chi < item.refined.chi and shared(item, other) > 0.85


def _table_like(scene: Scene, item: Judged) -> bool:
    """Whether the rim inside an outline looks like the table: a patch of table between objects."""
    difference = scene.strengths(sampled(item.outline), 0.85)
    return float(np.median(np.sqrt(np.vecdot(difference, difference)))) < _TABLE


def _shadow_like(scene: Scene, item: Judged) -> bool:
    """Whether the rim inside an outline is the table's colour, only darker."""
    rim = np.median(scene.strengths(sampled(item.outline), 0.85), axis=0)
    table = scene.white.whitener @ scene.white.table_colour
    length = max(float(np.linalg.norm(table)), 1e-9)
    along = float(rim @ table) / length
    across = float(np.linalg.norm(rim - along * table / length))
    return across < 4.0 + 0.1 * abs(along) and -0.7 * length < along < 0.0


def _without_shadows(scene: Scene, accepted: list[Judged]) -> list[Judged]:
    """Outlines that are not the rest of a shadow beside the upright part that casts it."""
    # A patch of table between parts has the table's colour in its middle, and shadow or side faces around.
    dim = [_shadow_like(scene, item) or has_hole(scene, item.outline) for item in accepted]
    if scene.plane is None or not any(dim):
        return accepted
    upright = [item.outline for item, shadow in zip(accepted, dim, strict=True) if not shadow]
    casters = [hull.astype(np.float32) for hull in reaches(upright, scene.plane)]

    def beside(item: Judged) -> bool:
        points = [(float(x), float(y)) for x, y in sampled(item.outline)]
        return any(
            np.mean([cv2.pointPolygonTest(caster, point, True) > -4.0 for point in points]) > 0.12 for caster in casters
        )

    return [item for item, shadow in zip(accepted, dim, strict=True) if not (shadow and beside(item))]


def has_hole(scene: Scene, outline: Floats) -> bool:
    """Whether the table shows through the middle of an object."""
    differences = scene.strengths(sampled(outline), 0.85, 0.05, 0.15, 0.25, 0.35)
    strength = np.sqrt(np.vecdot(differences, differences))
    rim = len(strength) // 5
    own = float(np.median(strength[:rim]))
    return own > 6.0 and float(np.mean(strength[rim:] < max(3.0, 0.3 * own))) > 0.4

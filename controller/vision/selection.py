"""Which of the refined outlines stay: the better of rivals, no patches of table, prints, shadows or stains."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.chunks import chunk_middles
from controller.vision.robust import median
from controller.vision.scene import CLOSE, Judged, Scene, neighbours, outside, sampled, shared
from controller.vision.shapes import CIRCLE
from controller.vision.silhouette import reaches
from controller.vision.small import SMALL, looks_more_like
from controller.vision.wear import another_shape, many_sided

Floats = NDArray[np.float64]

WORN = 4.0
"""How many times the misfit allowed by the recipe a worn outline may have."""
_SURROUNDED = 0.4
"""Share of the surroundings of a part that must be table, shadow or other parts."""
_FILLED, _ALONE, _ALONE_POLYGON = 0.93, 0.85, 0.97
"""Shares of a worn part's rim that must be no table, and of its surroundings that must be.

A polygon's surroundings must be nearly all: where one side goes on, it is the shank of a bolt.
"""
_MORE = 0.06
"""Share of its surroundings that may be as strong as the part itself: more is a piece of something larger."""
_TORN = 0.13
"""Share of an outline that may run elsewhere without a neighbour to blame."""
_CLEARLY = 0.9
"""Share of an outline that must be seen where its contrast is near the smallest: texture makes four sides of five."""
_PIECE = 0.4
"""An outline within a well-fitting one that has no more than this share of its area is a piece of it: the top face of
a leaning silhouette has half."""
_TABLE = 2.3
"""Median strength, in standard deviations of the table, below which a face looks like the table (1.5 is typical)."""


def select(scene: Scene, judged: list[Judged]) -> list[Judged]:
    """The best of what overlaps.

    Of nested outlines that fit equally well the outer one is the object and the inner one a hole or a print;
    where side faces show it is the other way round, unless the inner one is much smaller: the inner one is the top.
    """
    table = _table_like(scene, judged).tolist()
    good = [item for item, plain in zip(judged, table, strict=True) if not plain and _believable(scene, item)]
    blurs, typical = [item.refined.blur for item in good], 0.0
    if blurs:
        # Shadows and glare have softer edges than the objects of the same frame.
        typical = float(median(np.array(blurs), 0))
        good = [item for item in good if item.refined.blur <= 1.7 * typical + 0.4]

    meets = neighbours(np.array([item.box for item in good]).reshape(-1, 4))
    stays = [
        not any(_rival(scene, item, good[j]) for j in meet) for item, meet in zip(good, meets, strict=True)
    ]
    if scene.sides:
        # A piece of a top face, cut off by a print, must not outrank the whole, if that is well seen and fits.
        seen = [item.badness <= CLOSE and item.refined.visible >= scene.settings.visible for item in good]
        for i, item in enumerate(good):
            around = [j for j in meets[i] if seen[j] and item.area < _PIECE * good[j].area]
            stays[i] = stays[i] and not any(shared(item, good[j]) > 0.9 for j in around)
    else:
        # A print or glint must not outrank the object it lies on.
        for i, item in enumerate(good):
            on = [j for j in meets[i] if good[j].area > 4.0 * item.area]
            if stays[i] and any(shared(item, good[j]) > 0.5 for j in on):
                stays[i] = _lies_on_table(scene, item, [])

    def rank(item: Judged) -> float:
        return max(item.badness, 0.6) + 2.0 * (1.0 - item.refined.visible)

    chosen: list[int] = []
    taken: set[int] = set()
    for i in sorted(np.flatnonzero(stays).tolist(), key=lambda i: (rank(good[i]), -good[i].area)):
        item, best = good[i], i
        if scene.sides:
            inner = [
                j
                for j in meets[i]
                if stays[j] and 0.5 * item.area < good[j].area < 0.97 * item.area
                and rank(good[j]) < rank(item) + 0.3
                and shared(item, good[j]) > 0.9
            ]
            best = min(inner, key=lambda j: rank(good[j]), default=i)
        if best not in taken and not any(j in taken and shared(good[best], good[j]) > 0.15 for j in meets[best]):
            chosen.append(best)
            taken.add(best)
    accepted = [good[i] for i in chosen]
    if scene.sides:
        return _without_shadows(scene, accepted)
    accepted = [item for item in accepted if not _strays(scene, item, accepted)]
    accepted = [item for item in accepted if _lies_on_table(scene, item, accepted)]
    return [item for item in accepted if not _shadow_strip(scene, item, accepted, typical)]


def _shadow_strip(scene: Scene, item: Judged, accepted: list[Judged], blur: float) -> bool:
    """Whether an outline is a strip of shadow along a larger object: the table's colour, darker, and softer."""
    if item.refined.blur < 1.12 * blur or not _shadow_like(scene, [item], 0.85)[0]:
        return False
    points = [(float(x), float(y)) for x, y in item.rim]
    larger = [other.outline.astype(np.float32) for other in accepted if other.area > item.area]
    return any(np.mean([cv2.pointPolygonTest(o, point, True) > -4.0 for point in points]) > 0.12 for o in larger)


def _believable(scene: Scene, item: Judged) -> bool:
    """Whether an outline is its shape, though perhaps a worn one."""
    height, width = scene.image.shape[:2]
    (x0, y0, x1, y1), end = item.box, 1.0
    cut = x0 < -end or y0 < -end or x1 > width - 1 + end or y1 > height - 1 + end
    if cut and not scene.sides and not stands_alone(scene, item.outline):
        return False
    if item.refined.visible < _CLEARLY and item.refined.levels < 1.5 * scene.settings.minimum_contrast:
        return False
    family = item.hypothesis.family
    round_ = family is CIRCLE
    if round_ and item.badness > 0.25 and item.refined.chi > 3.0 and many_sided(item.refined):
        return False
    strays = not round_ and item.badness > 0.5 and item.refined.visible < 0.95
    if strays and not scene.sides and not filled(scene, item.outline):
        return False  # the table shows in a corner: an L
    if item.badness <= 1.0:
        return True
    worn = item.badness < (WORN if round_ else 0.4 * WORN) and item.refined.visible > (0.7 if round_ else 0.92)
    alone = _ALONE if round_ else _ALONE_POLYGON
    worn = worn and not another_shape(family, item.refined, math.sqrt(item.area))
    return worn and stands_alone(scene, item.outline, alone)


def _lies_on_table(scene: Scene, item: Judged, accepted: list[Judged]) -> bool:
    """Whether an outline is surrounded by table, shadow and other objects: no print, glint or hole of something."""
    if scene.regions[item.hypothesis.region].cue == "alone":
        return True
    points = outside([item.outline], [3.0 + 2.0 * scene.factor + 2.0 * item.refined.blur])[0, 0]
    difference = scene.differences(points)
    strength = np.sqrt(np.vecdot(difference, difference))
    rim = scene.strengths(item.rim, 0.85)
    own = float(np.median(np.sqrt(np.vecdot(rim, rim))))
    height, width = scene.image.shape[:2]
    good = strength < max(2.0 * scene.settings.level, 0.25 * own)
    good |= shaded(scene, difference)
    good |= (points < 0.0).any(axis=1) | (points[:, 0] > width - 1) | (points[:, 1] > height - 1)
    if good.mean() > _SURROUNDED:
        return True
    others = [other.outline.astype(np.float32) for other in accepted if other is not item]
    rest = [(float(x), float(y)) for x, y in points[~good]]
    covered = sum(any(cv2.pointPolygonTest(o, point, False) > 0.0 for o in others) for point in rest)
    return bool(good.sum() + covered > _SURROUNDED * len(points))


def filled(scene: Scene, outline: Floats) -> bool:
    """Whether all that lies just inside an outline differs from the table."""
    difference = scene.strengths(sampled(outline), 0.93, 0.8)
    return bool(np.mean(np.sqrt(np.vecdot(difference, difference)) > scene.settings.level) > _FILLED)


def stands_alone(scene: Scene, outline: Floats, least: float = _ALONE) -> bool:
    """Whether an outline separates something that fills it from the table around it."""
    difference = scene.strengths(sampled(outline), 0.93, 0.8)
    strength = np.sqrt(np.vecdot(difference, difference))
    filled = strength > scene.settings.level
    points = outside([outline], [3.0 + 3.0 * scene.factor])[0, 0]
    height, width = scene.image.shape[:2]
    beyond_frame = (points < 0.0).any(axis=1) | (points[:, 0] > width - 1) | (points[:, 1] > height - 1)
    around = np.where(beyond_frame[:, None], 0.0, scene.differences(points))
    faint = max(2.0 * scene.settings.level, 0.3 * float(np.median(strength)))
    beyond = np.sqrt(np.vecdot(around, around))
    table = (beyond < faint) | (shaded(scene, around) & (beyond < 0.5 * float(np.median(strength))))
    more = beyond > 0.6 * float(np.median(strength))
    return bool(filled.mean() > _FILLED and table.mean() >= least and more.mean() < _MORE)


def stains(accepted: Sequence[Judged], others: Sequence[tuple[float, float]]) -> set[int]:
    """Which outlines are stains or crumbs beside real parts: far fainter than larger things, and vague or tiny.

    Args:
        accepted: All outlines of known shape.
        others: Areas, px^2, and contrasts, levels, of objects of no known shape.
    """
    known = [(abs(float(cv2.contourArea(item.outline.astype(np.float32)))), item.refined.levels) for item in accepted]
    sizes, levels = np.array([*known, *others]).reshape(-1, 2).T
    largest, clearest = sizes.max(initial=0.0), levels.max(initial=0.0)
    blurs = np.array([item.refined.blur for item in accepted])
    out = set()
    for i, item in enumerate(accepted):
        # Nothing is a stain that is not faint or small.
        if sizes[i] == largest or (levels[i] > 0.35 * clearest and sizes[i] > 0.1 * largest):
            continue
        larger = sizes > sizes[i]
        faint, small = levels[i] / float(np.median(levels[larger])), sizes[i] / float(np.median(sizes[larger]))
        soft = len(blurs) > 1 and blurs[i] > 1.4 * float(np.median(np.delete(blurs, i)))
        vague = soft or item.refined.visible < 0.95
        if faint < 0.06 or (faint < 0.1 and vague) or (small < 0.06 and faint < 0.35) or (small < 0.1 and soft):
            out.add(i)
    return out


def shaded(scene: Scene, difference: Floats) -> NDArray[np.bool_]:
    """Which whitened differences (N, 3) are the table's colour, only darker."""
    table = scene.white.whitener @ scene.white.table_colour
    length = max(float(np.linalg.norm(table)), 1e-9)
    along = difference @ table / length
    rest = difference - along[:, None] * (table / length)
    across = np.sqrt(np.vecdot(rest, rest))
    return np.asarray((across < 4.0 + 0.1 * np.abs(along)) & (-0.7 * length < along) & (along < 0.0))


def _strays(scene: Scene, item: Judged, accepted: list[Judged]) -> bool:
    """Whether an outline leaves its shape where no neighbour is to blame: a nut with a bolt in it, a torn edge."""
    if 1.0 - item.refined.visible < _TORN:
        return False
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


def _rival(scene: Scene, item: Judged, other: Judged) -> bool:
    """Whether another family explains the same outline better."""
    if other.hypothesis.family is item.hypothesis.family or abs(other.area / item.area - 1.0) > 0.2:
        return False
    if shared(item, other) <= 0.85:
        return False
    if max(item.area, other.area) < SMALL**2:
        return looks_more_like(scene, item, other)
    return other.refined.chi < item.refined.chi


def _table_like(scene: Scene, items: Sequence[Judged]) -> NDArray[np.bool_]:
    """Whether the rims (K,) inside outlines look like the table: patches of table between objects."""
    if not items:
        return np.zeros(0, bool)
    difference = scene.strengths(rims(items), 0.85)
    return np.asarray(median(np.sqrt(np.vecdot(difference, difference)), 1) < _TABLE)


def _shadow_like(scene: Scene, items: Sequence[Judged], share: float) -> NDArray[np.bool_]:
    """Whether the insides of outlines (K,), shrunk to a share, are the table's colour, only darker."""
    return shaded(scene, median(scene.strengths(rims(items), share), 1))


def _without_shadows(scene: Scene, accepted: list[Judged]) -> list[Judged]:
    """Outlines that are not the rest of a shadow beside the upright part that casts it."""
    if scene.plane is None or not accepted:
        return accepted
    # A patch of table between parts has the table's colour in its middle, and shadow or side faces around.
    holes = has_hole(scene, rims(accepted))
    dim = (holes | _shadow_like(scene, accepted, 0.85) | _shadow_like(scene, accepted, 0.4)).tolist()
    if not any(dim):
        return accepted
    upright = [item.outline for item, shadow in zip(accepted, dim, strict=True) if not shadow]
    casters = [hull.astype(np.float32) for hull in reaches(upright, scene.plane)]

    def beside(item: Judged) -> bool:
        points = [(float(x), float(y)) for x, y in item.rim]
        return any(
            np.mean([cv2.pointPolygonTest(caster, point, True) > -4.0 for point in points]) > 0.12 for caster in casters
        )

    return [item for item, shadow in zip(accepted, dim, strict=True) if not (shadow and beside(item))]


def has_hole(scene: Scene, rim: Floats) -> NDArray[np.bool_]:
    """Whether the table shows through the middles of objects (K,) with rims (K, N, 2), px."""
    if not len(rim):
        return np.zeros(0, bool)
    differences = scene.strengths(rim, 0.85, 0.05, 0.15, 0.25, 0.35)
    strength = np.sqrt(np.vecdot(differences, differences))
    outer = strength.shape[1] // 5
    own = median(strength[:, :outer], 1)
    clear = (strength[:, outer:] < np.maximum(3.0, 0.3 * own)[:, None]).mean(axis=1)
    return np.asarray((own > 6.0) & (clear > 0.4))


def rims(items: Sequence[Judged]) -> Floats:
    """Points (K, 32, 2) along outlines, px."""
    return np.array([item.rim for item in items]).reshape(-1, 32, 2)

"""Which outlines are believed, what they are called, and which of overlapping ones stay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from controller.geometry import PlaneMap
from controller.vision.background import Whitened
from controller.vision.fitting import Hypothesis
from controller.vision.local_map import LocalMaps
from controller.vision.others import other_objects
from controller.vision.proposals import Region
from controller.vision.recipe import Precise
from controller.vision.refine import Refined, chunk_middles, refine
from controller.vision.shapes import CIRCLE, OCTAGON, RECTANGLE, TRIANGLE, area, vertices
from controller.vision.silhouette import foot, measure, reach
from controller.vision.timing import Stopwatch

Floats = NDArray[np.float64]

_THIN = 0.55
"""Short side of the smallest object over its width: the smallest circle and a slim rectangle of its area."""
_TORN = 0.13
"""Share of an outline that may run elsewhere without a neighbour to blame."""
_TABLE = 2.3
"""Median strength, in standard deviations of the table, below which a face looks like the table (1.5 is typical)."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """One judged outline, in pixels of the frame.

    Attributes:
        shape: Verdict.
        score: Confidence in [0, 1].
        face: ndarray of shape (N, 2), px: the fitted shape's corners (a circle sampled): an object's top face.
        outline: ndarray of shape (M, 2), px: the outer outline; the face's, unless side faces show as well.
        center: (2,), px: the outline's centroid.
        diameter: A circle's diameter, px; None for anything else.
        flags: As for `Detection`.
    """

    shape: Shape
    score: float
    face: Floats
    outline: Floats
    center: Floats
    diameter: float | None
    flags: frozenset[str]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """All that is known about a frame when its outlines are judged.

    Attributes:
        image: ndarray of shape (H, W, 3), dtype uint8.
        noise: Covariance of its pixel noise, (3, 3).
        white: The searched image's difference from the table.
        factor: How many times smaller that is.
        maps: Local coordinates of every region.
        regions: The regions.
        plane: The plane shapes are decided in, or None.
        settings: The recipe's.
    """

    image: NDArray[np.uint8]
    noise: Floats
    white: Whitened
    factor: int
    maps: LocalMaps
    regions: Sequence[Region]
    plane: PlaneMap | None
    settings: Precise

    @property
    def sides(self) -> bool:
        """Whether side faces may show: shapes are decided on a plane above the table."""
        return self.plane is not None and self.plane.height > 0.0

    def strengths(self, outline: Floats, share: float) -> Floats:
        """Whitened difference from the table (N, 3) at points of the outline shrunk to `share` about its middle."""
        middle = outline.mean(axis=0)
        points = ((middle + share * (outline - middle)) - (self.factor - 1) / 2.0) / self.factor
        rows, columns = self.white.difference.shape[:2]
        x = np.clip(np.rint(points[:, 0]).astype(np.intp), 0, columns - 1)
        y = np.clip(np.rint(points[:, 1]).astype(np.intp), 0, rows - 1)
        return np.asarray(self.white.difference[y, x], np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A refined outline, px, with its misfit over what is allowed and its area in local units."""

    hypothesis: Hypothesis
    refined: Refined
    badness: float
    outline: Floats
    area: float
    box: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """Outlines that need no further guess: polygons, and their boxes (K, 2) low and high, px."""

    polygons: list[NDArray[np.float32]]
    low: Floats
    high: Floats


def settled(judged: Sequence[Judged]) -> Settled:
    """The outlines that are seen completely and fit well."""
    outlines = [item.outline for item in judged if _whole(item)]
    low = np.array([o.min(axis=0) for o in outlines]).reshape(-1, 2)
    high = np.array([o.max(axis=0) for o in outlines]).reshape(-1, 2)
    return Settled([o.astype(np.float32) for o in outlines], low, high)


def explained(region: Region, done: Settled, factor: int) -> bool:
    """Whether a region is covered by a settled outline and not much larger than it."""
    x, y, w, h = (float(v) * factor for v in cv2.boundingRect(region.contour))
    middle = (x + 0.5 * w, y + 0.5 * h)
    for i in np.flatnonzero(((done.low <= middle) & (done.high >= middle)).all(axis=1)):
        if cv2.pointPolygonTest(done.polygons[i], middle, False) > 0.0:
            size = done.high[i] - done.low[i]
            return w * h < 1.6 * float(size[0] * size[1]) + 8.0 * factor * float(size.sum())
    return False


def judge(scene: Scene, judged: list[Judged], watch: Stopwatch) -> list[Found]:
    """The objects among the refined outlines."""
    accepted = _select(scene, judged)
    found = [_found(scene, item) for item in accepted]
    watch.lap("judge")
    if scene.settings.others:
        blur = float(np.median([item.refined.blur for item in accepted])) if accepted else 1.0
        hidden = [i for i, item in enumerate(accepted) if _merged(scene, item)]
        others, merged = other_objects(
            scene.image, scene.noise, scene.regions, scene.factor, [item.face for item in found], hidden, blur,
            scene.settings.minimum_contrast, scene.settings.smallest_px,
            whole=[i for i, item in enumerate(accepted) if scene.sides or _whole(item)],
        )  # fmt: skip
        found = [item for i, item in enumerate(found) if i not in merged]
        found = [item for item in found if not any(_part_of(item, outline) for outline, _ in others)]
        for outline, score in others:
            flags = _border(outline, scene.image.shape)
            found.append(Found(Shape.OTHER, score, outline, outline, _centroid(outline), None, flags))
        watch.lap("others")
    if scene.sides and scene.plane is not None:
        found = _with_sides(scene.image, scene.noise, found, scene.plane)
        watch.lap("sides")
    return found


def _part_of(item: Found, outline: Floats) -> bool:
    """Whether a small shape lies on or in a larger object: a print, a hole, a glint."""
    polygon = outline.astype(np.float32)
    small = abs(cv2.contourArea(item.face.astype(np.float32))) < 0.5 * abs(cv2.contourArea(polygon))
    return small and cv2.pointPolygonTest(polygon, (float(item.center[0]), float(item.center[1])), False) > 0.0


def refined_outlines(scene: Scene, fits: list[list[Hypothesis]]) -> list[Judged]:
    """Hypotheses refined on the pixels, the second best of a region only where the best is not good."""
    maps = scene.maps
    judged: list[Judged] = []
    tried: list[Hypothesis] = []
    blur = 1.0
    for rank in (0, 1):
        wanted = []
        done = {j.hypothesis.region for j in judged if j.badness < 0.7}
        if rank and not scene.sides:
            clear = settled(judged)
            done |= {i for i, item in enumerate(scene.regions) if explained(item, clear, scene.factor)}
        for options in sorted((o for o in fits if len(o) > rank), key=lambda o: o[rank].cost):
            h = options[rank]
            if h.inliers < 0.6 or h.region in done or h.cost > 1.8 * options[0].cost + 0.05:
                continue
            if any(_same(h, other, maps) for other in tried):
                continue
            tried.append(h)
            wanted.append(h)
        judged += _judged(scene, wanted, blur)
        good = [j.refined.blur for j in judged if j.badness < 1.0]
        blur = float(np.median(good)) if good else blur
    if scene.sides:
        judged += _judged(scene, [_top_within(scene, j) for j in judged if j.badness < 1.0], blur)
    return judged


def _judged(scene: Scene, wanted: list[Hypothesis], blur: float) -> list[Judged]:
    """Hypotheses refined, those with a visible outline."""
    settings, maps = scene.settings, scene.maps
    refined = refine(
        scene.image, scene.noise, [h.family for h in wanted], [h.q for h in wanted], maps,
        # Where side faces show, the rim beside a top face is looked at on purpose instead.
        [h.region for h in wanted], blur, restarts=0 if scene.sides else 3,
    )  # fmt: skip
    out = []
    for h, r in zip(wanted, refined, strict=True):
        if r is None or r.visible < settings.visible or r.levels < settings.minimum_contrast or r.contrast < 1.0:
            continue
        outline = maps.to_pixels(h.region, vertices(h.family, r.q))
        if not np.isfinite(outline).all() or _width(outline) < _THIN * settings.smallest_px:
            continue
        covered = float(area(h.family, r.q[None])[0])
        allowed = settings.misfit_px + settings.misfit_share * math.sqrt(covered) + _slack(scene, outline)
        (x0, y0), (x1, y1) = outline.min(axis=0), outline.max(axis=0)
        out.append(Judged(h, r, r.misfit / allowed, outline, covered, (float(x0), float(y0), float(x1), float(y1))))
    return out


def _width(outline: Floats) -> float:
    """Short side of the minimum-area rectangle, px."""
    return float(min(cv2.minAreaRect(outline.astype(np.float32))[1]))


def _top_within(scene: Scene, item: Judged) -> Hypothesis:
    """Where the top face would be if an outline were the silhouette of a part with visible sides."""
    assert scene.plane is not None
    k, family, q = item.hypothesis.region, item.hypothesis.family, item.refined.q.copy()
    below = foot(item.outline, scene.plane, 2.0 * scene.plane.height)
    inwards = (scene.maps.to_local(k, below) - scene.maps.to_local(k, item.outline)).mean(axis=0)
    q[:2] -= 0.5 * inwards
    if family is CIRCLE:
        q[2] -= 0.25 * float(np.linalg.norm(inwards))
    else:
        turns = q[2 + family.sizes :][family.turn_of] + family.normals
        facing = np.abs(np.cos(turns) * inwards[0] + np.sin(turns) * inwards[1])
        for size in range(family.sizes):
            q[2 + size] -= 0.5 * float(facing[family.size_of == size].mean())
    q[2 : 2 + family.sizes] = np.maximum(q[2 : 2 + family.sizes], 2.0)
    return Hypothesis(k, family, q, item.hypothesis.cost, item.hypothesis.inliers, item.hypothesis.size)


def _slack(scene: Scene, outline: Floats) -> float:
    """Misfit, px, that side faces seen as a narrow rim beside the top face may cause."""
    if not scene.sides or scene.plane is None:
        return 0.0
    shift = float(np.linalg.norm((foot(outline, scene.plane, 2.0 * scene.plane.height) - outline).mean(axis=0)))
    return min(0.4, 0.06 * shift) if math.isfinite(shift) else 0.0


def _same(a: Hypothesis, b: Hypothesis, maps: LocalMaps) -> bool:
    """Whether two hypotheses speak of the same outline."""
    if a.family is not b.family or abs(a.size / b.size - 1.0) > 0.03:
        return False
    apart = maps.centers[a.region] + a.q[:2] - maps.centers[b.region] - b.q[:2]
    return bool(np.abs(apart).sum() < 0.03 * a.size + 0.5)


def _select(scene: Scene, judged: list[Judged]) -> list[Judged]:
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

    good = [item for item in good if not any(_rival(item, other) for other in good)]

    def rank(item: Judged) -> float:
        return max(item.badness, 0.6) + 2.0 * (1.0 - item.refined.visible)

    accepted: list[Judged] = []
    for item in sorted(good, key=lambda j: (rank(j), -j.area)):
        chosen = item
        if scene.sides:
            inner = [
                other
                for other in good
                if 0.5 * item.area < other.area < 0.97 * item.area
                and rank(other) < rank(item) + 0.3
                and _shared(item, other) > 0.9
            ]
            chosen = min(inner, key=rank, default=item)
        if not any(_shared(chosen, other) > 0.15 for other in accepted):
            accepted.append(chosen)
    accepted = _without_octagons(scene, accepted)
    if scene.sides:
        return _without_shadows(scene, accepted)
    return [item for item in accepted if not _strays(scene, item, accepted)]


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
        id(item) for item, r in zip(suspects, refined, strict=True) if r is not None and r.chi < 0.5 * item.refined.chi
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
    return other.refined.chi < item.refined.chi and _shared(item, other) > 0.85


def _table_like(scene: Scene, item: Judged) -> bool:
    """Whether the rim inside an outline looks like the table: a patch of table between objects."""
    strength = np.linalg.norm(scene.strengths(_sampled(item.outline), 0.85), axis=1)
    return float(np.median(strength)) < _TABLE


def _shadow_like(scene: Scene, item: Judged) -> bool:
    """Whether the rim inside an outline is the table's colour, only darker."""
    rim = np.median(scene.strengths(_sampled(item.outline), 0.85), axis=0)
    table = scene.white.whitener @ scene.white.table_colour
    length = max(float(np.linalg.norm(table)), 1e-9)
    along = float(rim @ table) / length
    across = float(np.linalg.norm(rim - along * table / length))
    return across < 4.0 + 0.1 * abs(along) and -0.7 * length < along < 0.0


def _without_shadows(scene: Scene, accepted: list[Judged]) -> list[Judged]:
    """Outlines that are not the rest of a shadow beside the upright part that casts it."""
    # A patch of table between parts has the table's colour in its middle, and shadow or side faces around.
    dim = [_shadow_like(scene, item) or _has_hole(scene, item.outline) for item in accepted]
    casters = [
        reach(item.outline, scene.plane).astype(np.float32)
        for item, shadow in zip(accepted, dim, strict=True)
        if not shadow and scene.plane is not None
    ]

    def beside(item: Judged) -> bool:
        points = [(float(x), float(y)) for x, y in _sampled(item.outline)]
        return any(
            np.mean([cv2.pointPolygonTest(caster, point, True) > -4.0 for point in points]) > 0.12 for caster in casters
        )

    return [item for item, shadow in zip(accepted, dim, strict=True) if not (shadow and beside(item))]


def _sampled(outline: Floats, count: int = 32) -> Floats:
    """`count` points at equal distances along a closed outline."""
    side = np.roll(outline, -1, axis=0) - outline
    length = np.maximum(np.linalg.norm(side, axis=1), 1e-9)
    ends = np.cumsum(length)
    at = (np.arange(count) + 0.5) / count * ends[-1]
    which = np.searchsorted(ends, at).clip(0, len(outline) - 1)
    return np.asarray(outline[which] + side[which] * ((at - ends[which] + length[which]) / length[which])[:, None])


def _whole(item: Judged) -> bool:
    """Whether an outline is seen so completely and fits so well that it is no piece of something larger."""
    return item.badness < 0.3 and item.refined.visible > 0.95 and item.refined.faint.sum() <= 1


def _merged(scene: Scene, item: Judged) -> bool:
    """Whether part of an outline runs through one colour: a piece cut out of something larger."""
    return scene.regions[item.hypothesis.region].cue == "split" and float(item.refined.faint.mean()) > 0.08


def _shared(a: Judged, b: Judged) -> float:
    """`_overlap` of two outlines, after a look at their boxes."""
    (ax0, ay0, ax1, ay1), (bx0, by0, bx1, by1) = a.box, b.box
    if ax1 < bx0 or bx1 < ax0 or ay1 < by0 or by1 < ay0:
        return 0.0
    return _overlap(a.outline, b.outline)


def _overlap(a: Floats, b: Floats) -> float:
    """Area shared by two convex outlines over the smaller one's."""
    if (a.max(axis=0) < b.min(axis=0)).any() or (b.max(axis=0) < a.min(axis=0)).any():
        return 0.0
    pa, pb = a.astype(np.float32), b.astype(np.float32)
    common, _ = cv2.intersectConvexConvex(pa, pb)
    return float(common) / max(1.0, min(abs(cv2.contourArea(pa)), abs(cv2.contourArea(pb))))


def _found(scene: Scene, item: Judged) -> Found:
    k, family, q = item.hypothesis.region, item.hypothesis.family, item.refined.q
    verdict = family.shape
    diameter = None
    if family is RECTANGLE and max(q[2], q[3]) / min(q[2], q[3]) < scene.settings.square_aspect:
        verdict = Shape.SQUARE
    center = vertices(family, q).mean(axis=0) if family is TRIANGLE else q[:2]
    if family is CIRCLE:
        diameter = 2.0 * float(q[2])
        if scene.plane is not None:
            diameter = 2.0 * math.sqrt(abs(cv2.contourArea(item.outline.astype(np.float32))) / math.pi)
    score = float(np.clip(1.0 - 0.35 * item.badness**2, 0.0, 1.0) * min(1.0, item.refined.visible / 0.95))
    flags = _border(item.outline, scene.image.shape)
    if _has_hole(scene, item.outline):
        flags |= {"hole"}
    return Found(
        verdict, score, item.outline, item.outline, scene.maps.to_pixels(k, center[None])[0], diameter, flags
    )


def _border(outline: Floats, shape: tuple[int, ...]) -> frozenset[str]:
    low, high = outline.min(axis=0), outline.max(axis=0)
    cut = (low < 0.5).any() or high[0] > shape[1] - 1.5 or high[1] > shape[0] - 1.5
    return frozenset({"cut_by_border"} if cut else ())


def _has_hole(scene: Scene, outline: Floats) -> bool:
    """Whether the table shows through the middle of an object."""
    around = _sampled(outline)
    own = float(np.median(np.linalg.norm(scene.strengths(around, 0.85), axis=1)))
    middle = np.concatenate([np.linalg.norm(scene.strengths(around, s), axis=1) for s in (0.05, 0.15, 0.25, 0.35)])
    return own > 6.0 and float(np.mean(middle < max(3.0, 0.3 * own))) > 0.4


def _with_sides(image: NDArray[np.uint8], noise: Floats, found: list[Found], plane: PlaneMap) -> list[Found]:
    """Objects with their visible side faces as part of the outline, and without those faces as objects."""
    areas = [abs(cv2.contourArea(item.face.astype(np.float32))) for item in found]
    order = sorted(range(len(found)), key=lambda i: -areas[i])
    kept: list[Found] = []
    reaches: list[Floats] = []
    for i in order:
        item = found[i]
        if any(_overlap(item.face, other) > 0.6 for other in reaches):
            continue
        kept.append(item)
        reaches.append(reach(item.face, plane))
    outlines = measure(image, noise, [item.face for item in kept], plane)
    return [
        replace(item, outline=outline, center=_centroid(outline), diameter=None)
        for item, outline in zip(kept, outlines, strict=True)
    ]


def _centroid(outline: Floats) -> Floats:
    """Centroid of a polygon of shape (N, 2)."""
    m = cv2.moments((outline - outline[0]).astype(np.float32))
    if abs(m["m00"]) < 1e-9:
        return np.asarray(outline.mean(axis=0))
    return np.asarray(np.array([m["m10"], m["m01"]]) / m["m00"] + outline[0])

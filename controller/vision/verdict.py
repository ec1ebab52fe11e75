"""From fitted outlines to objects: refined, selected, named, completed by what has no known shape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from controller.geometry import PlaneMap
from controller.vision.fitting import Hypothesis
from controller.vision.others import other_objects
from controller.vision.proposals import Region
from controller.vision.refine import Refined, refine
from controller.vision.scene import Found, Judged, Scene, overlap, whole
from controller.vision.selection import has_hole, select
from controller.vision.shapes import CIRCLE, RECTANGLE, TRIANGLE, area, vertices
from controller.vision.silhouette import feet, measure, reaches
from controller.vision.timing import Stopwatch

Floats = NDArray[np.float64]

_THIN = 0.55
"""Short side of the smallest object over its width: the smallest circle and a slim rectangle of its area."""


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """Outlines that need no further guess: polygons, and their boxes (K, 2) low and high, px."""

    polygons: list[NDArray[np.float32]]
    low: Floats
    high: Floats


def settled(judged: Sequence[Judged]) -> Settled:
    """The outlines that are seen completely and fit well."""
    outlines = [item.outline for item in judged if whole(item)]
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
    accepted = select(scene, judged)
    found = [_found(scene, item) for item in accepted]
    watch.lap("judge")
    if scene.settings.others:
        blur = float(np.median([item.refined.blur for item in accepted])) if accepted else 1.0
        hidden = [i for i, item in enumerate(accepted) if _merged(scene, item)]
        others, merged = other_objects(
            scene.image, scene.noise, scene.regions, scene.factor, [item.face for item in found], hidden, blur,
            scene.settings.minimum_contrast, scene.settings.smallest_px,
            whole=[i for i, item in enumerate(accepted) if scene.sides or whole(item)],
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
    # Centre, size and family of what was tried.
    tried = np.empty((2 * len(fits), 4))
    count = 0
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
            row = np.array([*(maps.centers[h.region] + h.q[:2]), h.size, h.family.parameters])
            if _same(row, tried[:count]):
                continue
            tried[count] = row
            count += 1
            wanted.append(h)
        judged += _judged(scene, wanted, blur)
        good = [j.refined.blur for j in judged if j.badness < 1.0]
        blur = float(np.median(good)) if good else blur
    if scene.sides:
        good_ones = [j for j in judged if j.badness < 1.0]
        assert scene.plane is not None
        below = feet([j.outline for j in good_ones], scene.plane, 2.0 * scene.plane.height)
        tops = [_top_within(scene, j, low) for j, low in zip(good_ones, below, strict=True)]
        judged += _judged(scene, tops, blur)
    return judged


def _judged(scene: Scene, wanted: list[Hypothesis], blur: float) -> list[Judged]:
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


def _width(outline: Floats) -> float:
    """Short side of the minimum-area rectangle, px."""
    return float(min(cv2.minAreaRect(outline.astype(np.float32))[1]))


def _top_within(scene: Scene, item: Judged, below: Floats) -> Hypothesis:
    """Where the top face would be if an outline with that foot were the silhouette of a part with visible sides."""
    k, family, q = item.hypothesis.region, item.hypothesis.family, item.refined.q.copy()
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


def _slack(scene: Scene, outlines: list[Floats]) -> list[float]:
    """Misfit, px, that side faces seen as a narrow rim beside each top face may cause."""
    if not scene.sides or scene.plane is None:
        return [0.0] * len(outlines)
    below = feet(outlines, scene.plane, 2.0 * scene.plane.height)
    shifts = [math.hypot(*(low - top).mean(axis=0)) for top, low in zip(outlines, below, strict=True)]
    return [min(0.4, 0.06 * shift) if math.isfinite(shift) else 0.0 for shift in shifts]


def _same(row: Floats, others: Floats) -> bool:
    """Whether one of the others (N, 4), each a centre, a size and its family's parameters, is the same outline."""
    x, y, size, family = others.T
    near = np.abs(row[0] - x) + np.abs(row[1] - y) < 0.03 * row[2] + 0.5
    return bool((near & (family == row[3]) & (np.abs(row[2] / size - 1.0) <= 0.03)).any())


def _merged(scene: Scene, item: Judged) -> bool:
    """Whether part of an outline runs through one colour: a piece cut out of something larger."""
    return scene.regions[item.hypothesis.region].cue == "split" and float(item.refined.faint.mean()) > 0.08


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
    if has_hole(scene, item.outline):
        flags |= {"hole"}
    return Found(
        verdict, score, item.outline, item.outline, scene.maps.to_pixels(k, center[None])[0], diameter, flags
    )


def _border(outline: Floats, shape: tuple[int, ...]) -> frozenset[str]:
    low, high = outline.min(axis=0), outline.max(axis=0)
    cut = (low < 0.5).any() or high[0] > shape[1] - 1.5 or high[1] > shape[0] - 1.5
    return frozenset({"cut_by_border"} if cut else ())


def _with_sides(image: NDArray[np.uint8], noise: Floats, found: list[Found], plane: PlaneMap) -> list[Found]:
    """Objects with their visible side faces as part of the outline, and without those faces as objects."""
    areas = [abs(cv2.contourArea(item.face.astype(np.float32))) for item in found]
    order = sorted(range(len(found)), key=lambda i: -areas[i])
    hulls = reaches([item.face for item in found], plane)
    chosen: list[int] = []
    for i in order:
        if not any(overlap(found[i].face, hulls[j]) > 0.6 for j in chosen):
            chosen.append(i)
    kept = [found[i] for i in chosen]
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

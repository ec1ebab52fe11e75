"""The second tier: competing guesses for what is faint, shadowed, touching, seen from the side or hidden in part.

Every cue proposes regions; edges are looked for along rays from within them, every family is fitted to those, and
the plausible fits are refined on the pixels. Regions that remain open are cut at their necks and tried again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.background import Whitened
from controller.vision.fitting import Hypothesis, edges_of, fit_all
from controller.vision.local_map import LocalMaps, joined, local_maps
from controller.vision.profiles import bilinear
from controller.vision.proposals import FAINT, Region, split_necks
from controller.vision.rays import DIRECTIONS, find_edges, radial_profiles
from controller.vision.scene import Judged, Scene, all_sampled, whole
from controller.vision.shapes import CIRCLE, area
from controller.vision.silhouette import to_feet
from controller.vision.timing import Stopwatch
from controller.vision.trial import HALF_SEEN, THIN, Settled, lies_on, settled, tried, typical_blur

Floats = NDArray[np.float64]

_COPY = 0.02
"""Regions whose boxes differ by less than this share of their size show the same; among those of one round three times
this, but a shadow beside an object may move a box by no more."""

_FAINT = 0.75
"""Share of the smallest contrast that a region's boundary must have to be worth a closer look: it is rough."""
_BESIDE = 3.0
"""How far from a boundary, px of the searched image, its sides are looked at: beyond the blur."""
_AGREED = 0.6
"""Share of the rays whose edges a fit must explain, unless it is the best around what may be a silhouette."""
_GOOD = 0.7
"""Badness of a region's best fit up to which its second best is not tried."""
_WORSE, _WORSE_BY = 1.8, 0.05
"""How many times the cost of a region's best fit, and how much more, the second best may have."""
_SAME = 0.03
"""Share of their size by which the places and sizes of outlines differ that are one."""
_NECKED = 0.93
"""Area over the hull's, below which a region may be several touching parts."""
_HEAPED = 0.3
"""Share of a region that several settled outlines fill when it is these parts and what lies between them."""


def open_objects(
    scene: Scene, regions: list[Region], clear: list[Judged], smallest: float, watch: Stopwatch
) -> tuple[Scene, list[Judged]]:
    """Outlines of what the first tier left open.

    Args:
        scene: The frame, with the regions of the first tier.
        regions: Where further objects may be.
        clear: What the first tier found.
        smallest: Smallest area, px of the searched image.
        watch: Books the stages.

    Returns:
        The scene with all regions, and the outlines.
    """
    if not regions:
        return scene, []
    shape = scene.white.difference.shape
    share = _COPY if scene.sides else 3.0 * _COPY
    regions = [item for item in regions if not _sliver(item, scene.settings.smallest_px / scene.factor)]
    regions = _distinct(_stepped(scene, regions), shape, _COPY)
    # First what stands out clearly; the costlier guesses only where that left something open.
    plain = [
        (item.core and (scene.sides or item.cue == "level")) or (scene.sides and item.cue == "zone")
        for item in regions
    ]
    first = _distinct([item for item, use in zip(regions, plain, strict=True) if use], shape, share)
    later = [item for item, use in zip(regions, plain, strict=True) if not use]
    blur = typical_blur(clear, 1.0)
    scene, first, judged = _round(scene, first, blur, [], watch)
    done = settled([*clear, *judged], scene)
    # A part that touches a larger one may lie within what that seems to explain.
    open_ = [
        item for item, known in zip(first, done.explained(first), strict=True)
        if item.cue != "zone" and (item.convex < _NECKED or not known)
    ]  # fmt: skip
    pieces = _stepped(scene, [piece for item in open_ for piece in split_necks(item, smallest)])
    pieces = _unknown(_distinct([*_unknown(later, done), *pieces], shape, share), done)
    heaps = [item for item in pieces if scene.sides and done.fills(item, _HEAPED)]
    pieces = [item for item in pieces if item not in heaps]
    certain = [item for item in judged if whole(item)]
    scene, _, more = _round(scene, pieces, typical_blur([*clear, *judged], blur), certain, watch)
    return scene.with_regions([*scene.regions, *heaps], scene.maps), [*judged, *more]


def _unknown(regions: Sequence[Region], done: Settled) -> list[Region]:
    """The regions that settled outlines leave open."""
    return [item for item, known in zip(regions, done.explained(regions), strict=True) if not known]


def _round(
    scene: Scene, regions: list[Region], blur: float, certain: Sequence[Judged], watch: Stopwatch
) -> tuple[Scene, list[Region], list[Judged]]:
    """Regions fitted and refined; returns the scene with those that could be measured, these, and their outlines."""
    if not regions:
        return scene, [], []
    regions, maps, fits = _fits(regions, scene, watch)
    before = len(scene.regions)
    fits = [[replace(h, region=h.region + before) for h in options] for options in fits]
    scene = scene.with_regions([*scene.regions, *regions], joined(scene.maps, maps))
    judged = _refined(scene, fits, blur, certain)
    watch.lap("refine")
    return scene, regions, judged


def _fits(
    regions: list[Region], scene: Scene, watch: Stopwatch
) -> tuple[list[Region], LocalMaps, list[list[Hypothesis]]]:
    """The regions that can be measured, their local coordinates, and the fits around each."""
    white, factor, plane = scene.white, scene.factor, scene.plane
    centers = np.array([_center(item.contour) for item in regions])
    radii = radial_profiles([item.contour for item in regions], centers)
    usable = np.asarray(np.isfinite(radii).all(axis=1))
    if plane is not None:
        # Beyond the horizon of the plane there is nothing to measure.
        usable &= np.isfinite(plane.to_plane(centers * factor + (factor - 1) / 2.0)).all(axis=1)
    regions = [item for item, use in zip(regions, usable, strict=True) if use]
    centers, radii = centers[usable], radii[usable]
    if not regions:
        return [], local_maps(np.empty((0, 2)), np.empty(0), plane), []
    window = np.maximum(3.0, 0.35 * radii.mean(axis=1))
    # A shadow's edge is gray: only around what hardly stands out does every gray step count.
    within = (centers[:, None] + 0.6 * radii[..., None] * DIRECTIONS).astype(np.float32)
    inside = bilinear(white.difference, within[..., 0], within[..., 1])
    faint = np.median(np.sqrt(np.vecdot(inside, inside)), axis=1) < FAINT * scene.settings.level
    units = np.where(faint[:, None, None], white.fine, np.eye(3))
    edges, weight = find_edges(white.difference, units, centers, radii, window)
    watch.lap("rays")
    full = centers * factor + (factor - 1) / 2.0
    maps = local_maps(full, (radii.max(axis=1) + 6.0) * factor * 1.3, plane)
    count, rays, choices = weight.shape
    flat = edges.reshape(count, rays * choices, 2) * factor + (factor - 1) / 2.0
    local = maps.all_to_local(flat).reshape(count, rays, choices, 2)
    around = maps.all_to_local((centers[:, None] + radii[..., None] * DIRECTIONS) * factor + (factor - 1) / 2.0)
    fits = fit_all(around, edges_of(local, weight), factor)
    watch.lap("fit")
    return regions, maps, fits


def _stepped(scene: Scene, regions: list[Region]) -> list[Region]:
    """Those with some contrast at their boundaries."""
    if not regions:
        return []
    clear = _steps(scene.white, regions) > _FAINT * scene.settings.minimum_contrast
    return [item for item, use in zip(regions, clear.tolist(), strict=True) if use]


def _sliver(item: Region, smallest: float) -> bool:
    """Whether a hull of edges is a piece of one edge: narrower than objects whose smallest width is given, px."""
    return item.cue == "edge" and min(cv2.minAreaRect(item.contour)[1]) + 1.0 < THIN * smallest


def _steps(white: Whitened, regions: Sequence[Region]) -> Floats:
    """How far (K,), gray levels, the picture differs from one side to the other along most of each boundary.

    The blocks of a compressed picture have sharp sides, which stand out where all else is flat, but of few levels.
    """
    points = all_sampled([item.contour.astype(np.float64) for item in regions], 48)
    along = np.roll(points, -1, axis=1) - np.roll(points, 1, axis=1)
    across = np.stack([along[..., 1], -along[..., 0]], axis=2)
    across /= np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-9)[..., None]
    # No farther than to the middle of what is small.
    apart = np.minimum(_BESIDE, 0.4 * np.sqrt([max(item.area, 1.0) for item in regions]))[:, None, None]
    sides = [(points + sign * apart * across).astype(np.float32) for sign in (-1.0, 1.0)]
    one, other = (bilinear(white.difference, side[..., 0], side[..., 1]) for side in sides)
    levels = (one - other) @ np.linalg.inv(white.whitener).T
    return np.asarray(np.quantile(np.sqrt(np.mean(levels * levels, axis=2)), 0.75, axis=1))


def _refined(
    scene: Scene, fits: list[list[Hypothesis]], blur: float, certain: Sequence[Judged]
) -> list[Judged]:
    """Hypotheses refined on the pixels, the second best of a region only where the best is not good.

    Where side faces show, what is fitted may be the silhouette of a part: its top face is tried as well.

    Args:
        scene: The frame.
        fits: The hypotheses of each region.
        blur: Expected blur, px.
        certain: Outlines found before that need no further guess.
    """
    judged: list[Judged] = []
    tried_before = _Tried(scene.maps)
    for rank in (0, 1):
        done = {j.hypothesis.region for j in judged if j.badness < _GOOD}
        if rank and not scene.sides:
            clear = settled(judged, scene)
            done |= set(np.flatnonzero(clear.explained(scene.regions)).tolist())
        options = sorted((o for o in fits if len(o) > rank and o[rank].region not in done), key=lambda o: o[rank].cost)
        wanted = [
            o[rank] for o in options
            if _plausible(scene, o, rank) and not _lies(scene.maps, o[rank], certain) and tried_before.first(o[rank])
        ]  # fmt: skip
        if scene.sides:
            cores = [h for h in wanted if scene.regions[h.region].core]
            tops = [*_tops(scene, cores), *_tops_within(scene, judged, certain)]
            wanted += [top for top in tops if tried_before.first(top)]
        judged += tried(scene, wanted, blur, certain)
        blur = typical_blur(judged, blur)
    return judged


def _plausible(scene: Scene, options: Sequence[Hypothesis], rank: int) -> bool:
    """Whether one of the fits around a region explains enough of its edges to be worth a look at the pixels."""
    h, region = options[rank], scene.regions[options[rank].region]
    leans = scene.sides and rank == 0 and region.core and region.cue == "level"
    agreed = HALF_SEEN if leans else _AGREED
    return h.inliers >= agreed and h.cost <= _WORSE * options[0].cost + _WORSE_BY


class _Tried:
    """Outlines that were tried already."""

    def __init__(self, maps: LocalMaps) -> None:
        self._maps = maps
        self._known: list[tuple[float, float, Hypothesis]] = []

    def first(self, h: Hypothesis) -> bool:
        """Whether a hypothesis is not one of them; then it is from now on."""
        if self.knows(h):
            return False
        self._known.append((*(self._maps.centers[h.region] + h.q[:2]).tolist(), h))
        return True

    def knows(self, h: Hypothesis) -> bool:
        """Whether a hypothesis is one of them. No top face is its own silhouette."""
        x, y = (self._maps.centers[h.region] + h.q[:2]).tolist()
        for x0, y0, other in self._known:
            own = h.region == other.region and h.top != other.top
            near = abs(x - x0) + abs(y - y0) < _SAME * h.size + 0.5
            if near and not own and h.family is other.family and abs(h.size - other.size) <= _SAME * other.size:
                return True
        return False


def _tops_within(scene: Scene, judged: Sequence[Judged], certain: Sequence[Judged]) -> list[Hypothesis]:
    """The top faces of refined outlines that may be silhouettes of parts of which side faces show."""
    certain = [*certain, *(j for j in judged if whole(j))]
    # Infinitely bad is what is seen by half: where its sides begin, a silhouette has hardly an edge.
    inner = [j for j in judged if j.hypothesis.top]
    silhouettes = [
        replace(j.hypothesis, q=j.refined.q, size=math.sqrt(j.area)) for j in judged
        if (whole(j) or ((j.badness < 1.0 or math.isinf(j.badness)) and not lies_on(*_middle(j), j.area, certain)))
        and not any(_coincide(j, top) for top in inner)
    ]  # fmt: skip
    tops, faces = _tops(scene, silhouettes), _Tried(scene.maps)
    for top in tops:
        faces.first(top)
    # What lies where another outline has its top face is that face.
    return [top for top, outline in zip(tops, silhouettes, strict=True) if not faces.knows(outline)]


def _coincide(a: Judged, b: Judged) -> bool:
    """Whether two outlines are the same but for the accuracy of either."""
    off = max(abs(one - other) for one, other in zip(a.box, b.box, strict=True))
    return a.hypothesis.family is b.hypothesis.family and off < _SAME * math.sqrt(a.area) + 0.5


def _lies(maps: LocalMaps, h: Hypothesis, certain: Sequence[Judged]) -> bool:
    """`lies_on` of a hypothesis."""
    if not certain:
        return False
    x, y = maps.to_pixels(h.region, h.q[None, :2])[0].tolist()
    return lies_on(x, y, h.size**2, certain)


def _middle(item: Judged) -> tuple[float, float]:
    """Middle of an outline's box, px."""
    x0, y0, x1, y1 = item.box
    return 0.5 * (x0 + x1), 0.5 * (y0 + y1)


def _tops(scene: Scene, silhouettes: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Where the top faces would be if outlines were the silhouettes of parts with visible sides."""
    if not silhouettes or scene.plane is None:
        return []
    centers = np.array([h.q[:2] for h in silhouettes])
    inwards = to_feet(centers, scene.maps, np.array([h.region for h in silhouettes], np.intp), scene.plane)
    return [_top_within(h, shift) for h, shift in zip(silhouettes, inwards, strict=True)]


def _top_within(silhouette: Hypothesis, inwards: Floats) -> Hypothesis:
    """The top face within a silhouette; `inwards` (2,) is how far the foot lies from it, local units."""
    family, q = silhouette.family, silhouette.q.copy()
    q[:2] -= 0.5 * inwards
    if family is CIRCLE:
        q[2] -= 0.25 * float(np.linalg.norm(inwards))
    else:
        turns = q[2 + family.sizes :][family.turn_of] + family.normals
        facing = np.abs(np.cos(turns) * inwards[0] + np.sin(turns) * inwards[1])
        for size in range(family.sizes):
            q[2 + size] -= 0.5 * float(facing[family.size_of == size].mean())
    q[2 : 2 + family.sizes] = np.maximum(q[2 : 2 + family.sizes], 2.0)
    return replace(silhouette, q=q, size=math.sqrt(float(area(family, q[None])[0])), top=True)


def _center(contour: NDArray[np.float32]) -> Floats:
    m = cv2.moments(cv2.convexHull(contour))
    if m["m00"] < 1e-6:
        return np.asarray(contour.mean(axis=0), np.float64)
    return np.array([m["m10"] / m["m00"], m["m01"] / m["m00"]])


def _distinct(regions: list[Region], shape: tuple[int, ...], share: float) -> list[Region]:
    """Regions without near copies of one another, and without those whose box is more than four fifths of the frame.

    Copies are regions whose boxes differ by less than half a pixel and a share of their size, and their areas by no
    more than that: a small part may touch a larger one within its box.
    """
    kept: list[Region] = []
    seen = np.empty((len(regions), 5))
    limit = 0.8 * shape[0] * shape[1]
    for item in regions:
        x, y, w, h = cv2.boundingRect(item.contour)
        if w * h > limit:
            continue
        tolerance = share * max(w, h) + 0.5
        box = np.array([x, y, x + w, y + h, item.area / (0.5 * (w + h))], float)
        if kept and bool((np.abs(seen[: len(kept)] - box).max(axis=1) < tolerance).any()):
            continue
        seen[len(kept)] = box
        kept.append(item)
    return kept

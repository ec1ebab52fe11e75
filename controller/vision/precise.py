"""The recipe `precise`: propose regions, find edges, fit shapes, refine the plausible ones, judge."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from controller.geometry import PlaneMap
from controller.vision.background import whiten
from controller.vision.local_map import LocalMaps, local_maps
from controller.vision.proposals import Region, propose, split_necks
from controller.vision.rays import DIRECTIONS, find_edges, radial_profile
from controller.vision.recipe import Precise
from controller.vision.refine import Refined, pixel_noise, refine
from controller.vision.shapes import (
    CIRCLE,
    FAMILIES,
    HEXAGON,
    RECTANGLE,
    TRIANGLE,
    Family,
    area,
    edge_residuals,
    fit_edges,
    from_polygon,
    vertices,
)
from controller.vision.silhouette import measure, reach
from controller.vision.timing import Stopwatch

Floats = NDArray[np.float64]


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


def search(
    image: NDArray[np.uint8],
    settings: Precise,
    *,
    plane: PlaneMap | None = None,
    background: NDArray[np.uint8] | None = None,
    region: NDArray[np.uint8] | None = None,
    trace: dict[str, NDArray[np.generic]] | None = None,
    watch: Stopwatch,
) -> list[Found]:
    """Objects in an image; see `detect` for the arguments."""
    factor = reduction(image.shape)
    small = _small(image, factor)
    empty = None if background is None else _small(background, factor)
    mask = None
    if region is not None:
        mask = cv2.resize(region, small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    watch.lap("reduce")
    white = whiten(small, np.asarray(mask) if mask is not None else None, empty)
    watch.lap("background")
    smallest = 0.5 * (settings.smallest_px / factor) ** 2
    regions, maps_ = propose(white, settings.level, smallest)
    if trace is not None:
        trace.update(maps_)
    pieces = [piece for item in regions if item.cue != "edge" for piece in split_necks(item, smallest)]
    if mask is not None:
        pieces, regions = _within(pieces, np.asarray(mask)), _within(regions, np.asarray(mask))
    regions = _distinct(regions + pieces, small.shape)
    watch.lap("propose")
    if not regions:
        return []
    centers = np.array([_center(item.contour) for item in regions])
    radii = np.stack([radial_profile(item.contour, c) for item, c in zip(regions, centers, strict=True)])
    usable = np.isfinite(radii).all(axis=1)
    if plane is not None:
        # Beyond the horizon of the plane there is nothing to measure.
        near = centers * factor + (factor - 1) / 2.0
        usable &= np.isfinite(plane.to_plane(near)).all(axis=1)
    regions = [item for item, use in zip(regions, usable, strict=True) if use]
    if not regions:
        return []
    centers, radii = centers[usable], radii[usable]
    extent = radii.max(axis=1)
    edges, weight = find_edges(white.difference, centers, radii, np.maximum(3.0, 0.35 * radii.mean(axis=1)))
    watch.lap("rays")
    full = centers * factor + (factor - 1) / 2.0
    maps = local_maps(full, (extent + 6.0) * factor * 1.3, plane)
    count, rays, choices = weight.shape
    flat = edges.reshape(count, rays * choices, 2) * factor + (factor - 1) / 2.0
    local = maps.all_to_local(flat).reshape(count, rays, choices, 2)
    hulls = [
        maps.to_local(i, cv2.convexHull(item.contour)[:, 0].astype(np.float64) * factor + (factor - 1) / 2.0)
        for i, item in enumerate(regions)
    ]
    fits = _fit_all(hulls, local, weight, factor)
    watch.lap("fit")
    noise = pixel_noise(image)
    image = without_spikes(image, noise)
    found = _judge(image, settings, regions, fits, maps, noise)
    watch.lap("refine")
    if plane is not None and plane.height > 0.0:
        found = _with_sides(image, noise, found, plane)
        watch.lap("sides")
    return found


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
    return np.array([m["m10"], m["m01"]]) / m["m00"] + outline[0]


def reduction(shape: tuple[int, ...]) -> int:
    """How many times smaller the searched image is: small objects need every pixel of a small frame."""
    pixels = shape[0] * shape[1]
    return 1 if pixels < 500_000 else 2 if pixels < 16_000_000 else 4


def _small(image: NDArray[np.uint8], factor: int) -> NDArray[np.float32]:
    clean = cv2.medianBlur(image, 3) if min(image.shape[:2]) >= 3 else image
    if factor > 1:
        size = (image.shape[1] // factor, image.shape[0] // factor)
        clean = cv2.resize(clean[: size[1] * factor, : size[0] * factor], size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(clean.astype(np.float32), (0, 0), 1.0), np.float32)


def without_spikes(image: NDArray[np.uint8], noise: Floats) -> NDArray[np.uint8]:
    """The image with impulses replaced by their neighbourhood's median; the image itself when it has none."""
    limit = max(40.0, 8.0 * math.sqrt(float(noise.trace()) / 3.0))
    rows = image[: image.shape[0] // 24 * 24].reshape(-1, 24, *image.shape[1:])[:, :3].reshape(-1, *image.shape[1:])
    spikes = cv2.absdiff(rows, cv2.medianBlur(rows, 3)).max(axis=2) > limit
    # Corners of objects and print also change under a median, but on fewer than one pixel in a thousand.
    if spikes.mean() < 2e-3:
        return image
    clean = np.asarray(cv2.medianBlur(image, 3), np.uint8)
    mask = (cv2.absdiff(image, clean).max(axis=2) > limit).astype(np.uint8)
    return np.asarray(cv2.copyTo(clean, mask, image.copy()), np.uint8)


def _center(contour: NDArray[np.float32]) -> Floats:
    m = cv2.moments(cv2.convexHull(contour))
    if m["m00"] < 1e-6:
        return np.asarray(contour.mean(axis=0), np.float64)
    return np.array([m["m10"] / m["m00"], m["m01"] / m["m00"]])


def _within(regions: list[Region], mask: NDArray[np.uint8]) -> list[Region]:
    """Regions whose bounding box has its middle in the mask."""
    out = []
    for item in regions:
        x, y, w, h = cv2.boundingRect(item.contour)
        row, column = min(max(y + h // 2, 0), mask.shape[0] - 1), min(max(x + w // 2, 0), mask.shape[1] - 1)
        if mask[row, column]:
            out.append(item)
    return out


def _distinct(regions: list[Region], shape: tuple[int, ...]) -> list[Region]:
    """Regions without near copies of one another, and without those that fill most of the frame."""
    kept: list[Region] = []
    seen: list[tuple[float, float, float, float]] = []
    limit = 0.5 * shape[0] * shape[1]
    for item in regions:
        x, y, w, h = cv2.boundingRect(item.contour)
        if w * h > limit:
            continue
        box = (float(x), float(y), float(x + w), float(y + h))
        tolerance = 0.06 * max(w, h) + 0.5
        if any(max(abs(a - b) for a, b in zip(box, other, strict=True)) < tolerance for other in seen):
            continue
        seen.append(box)
        kept.append(item)
    return kept


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    region: int
    family: Family
    q: Floats
    cost: float
    inliers: float
    size: float


def _fit_all(hulls: list[Floats], edges: Floats, weight: Floats, factor: int) -> list[list[_Hypothesis]]:
    """For every region, its fits to all families, best first."""
    starts: dict[Shape, list[Floats]] = {shape: [] for shape in FAMILIES}
    for hull in hulls:
        for shape, start in _starts(hull).items():
            starts[shape].append(start)
    relative = weight / np.maximum(np.median(weight[:, :, 0], axis=1), 1e-9)[:, None, None]
    relative = np.where(weight > 0.0, np.clip(relative, 0.0, 1.0), 0.0)
    out: list[list[_Hypothesis]] = [[] for _ in hulls]
    for family in FAMILIES.values():
        q = np.array(starts[family.shape])
        size = np.sqrt(np.maximum(area(family, q), 1.0))
        scale = np.maximum(0.5 * factor, 0.008 * size)
        q = fit_edges(family, q, edges, relative, scale)
        distance, strength = edge_residuals(family, q, edges, relative)
        size = np.sqrt(np.maximum(area(family, q), 1.0))
        tolerance = np.maximum(0.7 * factor, 0.02 * size)[:, None]
        near = np.abs(distance) < tolerance
        valid = strength > 0.15
        inliers = np.mean(near & valid, axis=1)
        clipped = np.where(valid, np.minimum(np.abs(distance), tolerance), tolerance)
        cost = np.sqrt(np.mean(clipped**2, axis=1)) / tolerance[:, 0]
        for i in range(len(hulls)):
            if np.isfinite(q[i]).all():
                out[i].append(_Hypothesis(i, family, q[i], float(cost[i]), float(inliers[i]), float(size[i])))
    for hypotheses in out:
        hypotheses.sort(key=lambda h: h.cost)
    return out


def _starts(hull: Floats) -> dict[Shape, Floats]:
    """Rough parameters of every family for one convex outline."""
    points = hull.astype(np.float32)
    (cx, cy), (w, h), turn = cv2.minAreaRect(points)
    m = cv2.moments(points)
    covered = max(m["m00"], 1.0)
    center = np.array([m["m10"], m["m01"]]) / m["m00"] if m["m00"] > 1e-6 else hull.mean(axis=0)
    rectangle = np.array([cx, cy, max(w, 1.0) / 2, max(h, 1.0) / 2, math.radians(turn)])
    circle = np.array([*center, math.sqrt(covered / math.pi)])
    # The sixth harmonic of the support function points at the sides' normals.
    reach = (hull - center) @ DIRECTIONS.T
    support = reach.max(axis=0)
    turns = np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0])
    phase = np.angle(np.sum(support * np.exp(6j * turns)))
    hexagon = np.array([*center, math.sqrt(covered / (2.0 * math.sqrt(3.0))), phase / 6.0 + math.pi / 6.0])
    # Three far corners of the hull: the farthest from the centre, from that, and from the line between both.
    first = hull[np.argmax(np.sum((hull - center) ** 2, axis=1))]
    second = hull[np.argmax(np.sum((hull - first) ** 2, axis=1))]
    along = second - first
    third = hull[np.argmax(np.abs((hull[:, 0] - first[0]) * along[1] - (hull[:, 1] - first[1]) * along[0]))]
    triangle = from_polygon(np.stack([first, second, third]))
    return {CIRCLE.shape: circle, HEXAGON.shape: hexagon, RECTANGLE.shape: rectangle, TRIANGLE.shape: triangle}


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    hypothesis: _Hypothesis
    refined: Refined
    badness: float
    outline: Floats


def _judge(
    image: NDArray[np.uint8],
    settings: Precise,
    regions: list[Region],
    fits: list[list[_Hypothesis]],
    maps: LocalMaps,
    noise: Floats,
) -> list[Found]:
    judged: list[_Judged] = []
    blur = 1.0
    tried: list[_Hypothesis] = []
    for rank in (0, 1):
        wanted = []
        done = {j.hypothesis.region for j in judged if j.badness < 0.7}
        for options in sorted((o for o in fits if len(o) > rank), key=lambda o: o[rank].cost):
            h = options[rank]
            if h.inliers < 0.6 or h.region in done or h.cost > 1.8 * options[0].cost + 0.05:
                continue
            if any(_same(h, other, maps) for other in tried):
                continue
            tried.append(h)
            wanted.append(h)
        refined = refine(
            image, noise, [h.family for h in wanted], [h.q for h in wanted], maps, [h.region for h in wanted], blur
        )
        for h, r in zip(wanted, refined, strict=True):
            if r is None or r.visible < settings.visible or r.levels < settings.minimum_contrast or r.contrast < 1.0:
                continue
            size = math.sqrt(float(area(h.family, r.q[None])[0]))
            allowed = settings.misfit_px + settings.misfit_share * size
            judged.append(_Judged(h, r, r.misfit / allowed, maps.to_pixels(h.region, vertices(h.family, r.q))))
        good = [j.refined.blur for j in judged if j.badness < 1.0]
        blur = float(np.median(good)) if good else blur
    return _select(judged, settings, regions, maps, image.shape)


def _same(a: _Hypothesis, b: _Hypothesis, maps: LocalMaps) -> bool:
    """Whether two hypotheses speak of the same outline."""
    if a.family is not b.family or abs(a.size / b.size - 1.0) > 0.08:
        return False
    apart = maps.centers[a.region] + a.q[:2] - maps.centers[b.region] - b.q[:2]
    return bool(np.abs(apart).sum() < 0.08 * a.size + 0.5)


def _select(
    judged: list[_Judged], settings: Precise, regions: list[Region], maps: LocalMaps, shape: tuple[int, ...]
) -> list[Found]:
    """The best of what overlaps."""
    accepted: list[_Judged] = []
    found: list[Found] = []
    for item in sorted(judged, key=lambda j: max(j.badness, 0.5) + 2.0 * (1.0 - j.refined.visible)):
        if item.badness > 1.0:
            continue
        if any(_overlap(item.outline, other.outline) > 0.15 for other in accepted):
            continue
        accepted.append(item)
        found.append(_found(item, settings, maps, shape))
    return found


def _overlap(a: Floats, b: Floats) -> float:
    """Area shared by two convex outlines over the smaller one's."""
    if (a.max(axis=0) < b.min(axis=0)).any() or (b.max(axis=0) < a.min(axis=0)).any():
        return 0.0
    pa, pb = a.astype(np.float32), b.astype(np.float32)
    common, _ = cv2.intersectConvexConvex(pa, pb)
    return float(common) / max(1.0, min(abs(cv2.contourArea(pa)), abs(cv2.contourArea(pb))))


def _found(item: _Judged, settings: Precise, maps: LocalMaps, shape: tuple[int, ...]) -> Found:
    k, family, q = item.hypothesis.region, item.hypothesis.family, item.refined.q
    verdict = family.shape
    diameter = None
    if family is RECTANGLE and max(q[2], q[3]) / min(q[2], q[3]) < settings.square_aspect:
        verdict = Shape.SQUARE
    center = q[:2]
    if family is TRIANGLE:
        center = vertices(family, q).mean(axis=0)
    center_px = maps.to_pixels(k, center[None])[0]
    if family is CIRCLE:
        diameter = 2.0 * math.sqrt(abs(cv2.contourArea(item.outline.astype(np.float32))) / math.pi)
        if maps.plane is None:
            diameter = 2.0 * float(q[2])
    score = float(np.clip(1.0 - 0.35 * item.badness**2, 0.0, 1.0) * min(1.0, item.refined.visible / 0.95))
    flags = set()
    low, high = item.outline.min(axis=0), item.outline.max(axis=0)
    if (low < 0.0).any() or high[0] > shape[1] - 1 or high[1] > shape[0] - 1:
        flags.add("cut_by_border")
    return Found(verdict, score, item.outline, item.outline, center_px, diameter, frozenset(flags))

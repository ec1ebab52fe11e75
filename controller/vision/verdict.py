"""From fitted outlines to objects: refined, selected, named, completed by what has no known shape."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from controller.geometry import PlaneMap
from controller.vision.contact import with_contacts
from controller.vision.fallen import fallen_in
from controller.vision.others import other_objects
from controller.vision.robust import median
from controller.vision.scene import Found, Judged, Scene, boxes, overlap, sampled, whole
from controller.vision.selection import WORN, has_hole, rims, select, stains, stands_alone
from controller.vision.shapes import CIRCLE, RECTANGLE, TRIANGLE, vertices
from controller.vision.silhouette import measure, reaches
from controller.vision.timing import Stopwatch
from controller.vision.wear import round_outline

Floats = NDArray[np.float64]

def judge(scene: Scene, judged: list[Judged], watch: Stopwatch) -> list[Found]:
    """The objects among the refined outlines."""
    accepted = select(scene, judged)
    alone = [scene.regions[item.hypothesis.region].cue == "alone" for item in accepted]
    fallen = iter(fallen_in(scene, [item.outline for item, yes in zip(accepted, alone, strict=True) if not yes]))
    accepted = [item for item, yes in zip(accepted, alone, strict=True) if yes or not next(fallen)]
    holes = has_hole(scene, rims(accepted)).tolist()
    found = [_found(scene, item, hole) for item, hole in zip(accepted, holes, strict=True)]
    watch.lap("judge")
    if scene.settings.others:
        blur = float(median(np.array([item.refined.blur for item in accepted]), 0)) if accepted else 0.0
        hidden = [i for i, item in enumerate(accepted) if _merged(item)]
        others = other_objects(
            scene.image, scene.noise, scene.regions, scene.factor, [item.face for item in found], hidden, blur,
            scene.settings.minimum_contrast, scene.settings.smallest_px,
            whole=[i for i, item in enumerate(accepted) if scene.sides or whole(item) or _all_around(item)],
            strength=None if scene.sides else scene.strength,
        )  # fmt: skip
        fallen = iter(fallen_in(scene, [item.outline for item in others]))
        others = [item for item in others if not next(fallen)]
        merged = {i for item in others for i in item.pieces}
        if not scene.sides:
            merged |= stains(accepted, [(_area(item.outline), item.levels) for item in others])
        found = [item for i, item in enumerate(found) if i not in merged]
        found = [item for item in found if not any(_part_of(item, other.outline) for other in others)]
        for outline, score in ((item.outline, item.score) for item in others):
            flags = _border(boxes([outline])[0].tolist(), scene.image.shape, float(scene.factor))
            disc = _worn_disc(scene, outline)
            if disc is not None:
                found.append(disc)
                continue
            found.append(Found(Shape.OTHER, score, outline, outline, _centroid(outline), None, flags))
        watch.lap("others")
    if scene.sides and scene.plane is not None:
        found = _with_sides(scene.image, scene.noise, found, scene.plane)
        watch.lap("sides")
    return with_contacts(found)


def _worn_disc(scene: Scene, outline: Floats) -> Found | None:
    """The disc that an outline of no known shape is, when glints, dark sides and wear alone make it another."""
    if scene.sides:
        return None
    disc = round_outline(outline, 0.5 * scene.factor)
    if disc is None:
        return None
    center, radius = disc
    ring = vertices(CIRCLE, np.array([*center, radius]))
    if not stands_alone(scene, ring):
        return None
    flags = _border(boxes([ring])[0].tolist(), scene.image.shape)
    if has_hole(scene, sampled(ring)[None])[0]:
        flags |= {"hole"}
    return Found(Shape.CIRCLE, 0.5, ring, ring, center, 2.0 * radius, flags)


def _area(outline: Floats) -> float:
    """Area of an outline, px^2."""
    return abs(float(cv2.contourArea(outline.astype(np.float32))))


def _part_of(item: Found, outline: Floats) -> bool:
    """Whether a small shape lies on or in a larger object: a print, a hole, a glint."""
    polygon = outline.astype(np.float32)
    small = abs(cv2.contourArea(item.face.astype(np.float32))) < 0.5 * abs(cv2.contourArea(polygon))
    return small and cv2.pointPolygonTest(polygon, (float(item.center[0]), float(item.center[1])), False) > 0.0


def _merged(item: Judged) -> bool:
    """Whether part of an outline runs through one colour: a piece cut out of something larger."""
    return item.refined.faint > 0.08 and not _all_around(item)


def _all_around(item: Judged) -> bool:
    """Whether there is an edge everywhere, though a shadow of nearly the same gray may make some of it faint."""
    return item.badness < 0.3 and item.refined.visible == 1.0


def _found(scene: Scene, item: Judged, hole: bool) -> Found:
    k, family, q = item.hypothesis.region, item.hypothesis.family, item.refined.q
    verdict = family.shape
    diameter = None
    if family is RECTANGLE and max(q[2], q[3]) / min(q[2], q[3]) < scene.settings.square_aspect:
        verdict = Shape.SQUARE
    center = q[:2]
    if family is TRIANGLE:
        center = vertices(family, q).mean(axis=0) if scene.plane is not None else (
            item.outline.mean(axis=0) - scene.maps.centers[k]
        )
    if family is CIRCLE:
        diameter = 2.0 * float(q[2])
        if scene.plane is not None:
            diameter = 2.0 * math.sqrt(abs(cv2.contourArea(item.outline.astype(np.float32))) / math.pi)
    fit = 1.0 - 0.35 * item.badness**2 if item.badness < 1.0 else 0.65 - 0.15 * (item.badness - 1.0) / (WORN - 1.0)
    score = float(max(fit, 0.0) * min(1.0, item.refined.visible / 0.95))
    flags = _border(item.box, scene.image.shape)
    if hole:
        flags |= {"hole"}
    return Found(
        verdict, score, item.outline, item.outline, scene.maps.to_pixels(k, center[None])[0], diameter, flags
    )


def _border(box: list[float], shape: tuple[int, ...], slack: float = 0.0) -> frozenset[str]:
    """The flag of an outline with such a box, known to `slack` px, that the picture's border cuts."""
    x0, y0, x1, y1 = box
    end = 0.5 + slack
    cut = min(x0, y0) < end or x1 > shape[1] - 1.0 - end or y1 > shape[0] - 1.0 - end
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

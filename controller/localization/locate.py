"""Objects on the table from detections in a frame: position, direction, size, with a stated deviation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import CellCalibration, Detection, LocatedObject, Shape
from controller.geometry import wrap
from controller.localization.prism import Noise, PrismFit, bounding_size, footprint
from controller.localization.prism_fit import Start, fit_prisms
from controller.localization.second_look import second_looks

Array = NDArray[np.float64]

#: Deviation of a silhouette's centroid on z = h/2 from the part's, as a share of its height: measured 0.01
#: for centrally symmetric prisms and up to 0.05 for triangles, the worse taken.
HALF_HEIGHT_SIGMA = 0.05
#: Fewer outline points than this cannot carry a fit of six unknowns with anything left to judge it by.
MIN_POINTS = 20
#: Further starts that are tried, as a share of the shape's period away from the detection's own direction: the fit
#: of a tall part may end in a local optimum.
_TURNS = (1 / 6, -1 / 6, 1 / 3, -1 / 3, 1 / 2)


@dataclass(frozen=True, slots=True)
class Limits:
    """When a fit is refused.

    Attributes:
        inlier: A point within this distance of the silhouette agrees with it, px.
        share: Least share of agreeing points.
        edge: Largest median distance of any one edge's points, px: a side that lies elsewhere is a shadow,
            a neighbour or another shape, even when all others fit.
        ragged: Largest median deviation of one edge's points from their own median, px: sides are straight, and to
            0.15 px so in every picture tried; the border of a shadow is not.
    """

    inlier: float = 1.0
    share: float = 0.8
    edge: float = 0.75
    ragged: float = 0.35


@dataclass(frozen=True, slots=True)
class Located:
    """What became of the detections of one frame.

    Attributes:
        objects: Located ones, in the order of the detections.
        refused: (detection, reason) of the others.
        in_the_way: Where the refused ones lie, roughly: not to be picked, but not to be run into either. One that
            has no place on the table at all is missing.
    """

    objects: tuple[LocatedObject, ...]
    refused: tuple[tuple[Detection, str], ...]
    in_the_way: tuple[LocatedObject, ...] = ()


def locate(
    detections: Sequence[Detection],
    calibration: CellCalibration,
    heights: Callable[[Detection], float],
    *,
    refine: bool = True,
    noise: Noise | None = None,
    limits: Limits | None = None,
) -> Located:
    """Pose and size on the table of every detection that a prism of its shape explains.

    Args:
        detections: Of one frame.
        calibration: Of the cell; its camera must be the one that took the frame.
        heights: Stated height of a detected part, mm.
        refine: Fit a prism; otherwise the silhouette is taken on the plane z = h/2.
        noise: What is known about outlines and heights.
        limits: When a fit is refused.
    """
    known = noise or Noise()
    objection = cache(partial(_objection, limits=limits or Limits()))
    stated = [heights(detection) for detection in detections]
    rough = _on_half_height(detections, calibration, stated)
    verdicts: list[LocatedObject | str] = []
    solid: dict[int, LocatedObject] = {}
    for i, (detection, thing) in enumerate(zip(detections, rough, strict=True)):
        verdict = _verdict(detection, calibration, thing, refine)
        verdicts.append(verdict)
        if refine and isinstance(verdict, LocatedObject) and detection.shape is not Shape.OTHER:
            solid[i] = verdict
    things = list(solid.values())
    fits = _fits(things, calibration, known, objection)
    fits = second_looks(list(zip(things, fits, strict=True)), calibration, known, objection)
    for (i, thing), fit in zip(solid.items(), fits, strict=True):
        verdicts[i] = objection(fit) or _located(thing, fit, calibration)
    objects: list[LocatedObject] = []
    refused: list[tuple[Detection, str]] = []
    in_the_way: list[LocatedObject] = []
    for detection, verdict, place in zip(detections, verdicts, rough, strict=True):
        if isinstance(verdict, LocatedObject):
            objects.append(verdict)
            continue
        refused.append((detection, verdict))
        if place is not None:
            in_the_way.append(place)
    return Located(tuple(objects), tuple(refused), tuple(in_the_way))


def _verdict(
    detection: Detection, calibration: CellCalibration, rough: LocatedObject | None, refine: bool
) -> LocatedObject | str:
    """Where a detection lies roughly, or why it is refused."""
    if "cut_by_border" in detection.flags:
        return "cut by the border of the picture"
    if detection.frame.size != calibration.camera.image_size:
        return f"a picture of {detection.frame.size} px, calibrated at {calibration.camera.image_size}"
    if rough is None:
        return "its rays do not meet the table"
    if refine and detection.shape is not Shape.OTHER and len(detection.outline_px) < MIN_POINTS:
        return f"only {len(detection.outline_px)} outline points"
    return rough


def _located(rough: LocatedObject, fit: PrismFit, calibration: CellCalibration) -> LocatedObject:
    """An object where a prism has been found."""
    spread = float(np.linalg.eigvalsh(fit.covariance)[-1])
    shape = rough.detection.shape
    # A height that the outline disputes moves the part along the line of sight.
    doubt = _slant(calibration, fit.center) * abs(fit.height - rough.height)
    return replace(
        rough,
        center=fit.center,
        yaw=fit.yaw,
        size=bounding_size(shape, fit.dimensions),
        height=fit.height,
        footprint=footprint(shape, fit.center, fit.yaw, fit.dimensions),
        sigma=math.sqrt(spread + calibration.sigma**2 + doubt**2),
    )


def _on_half_height(
    detections: Sequence[Detection], calibration: CellCalibration, heights: Sequence[float]
) -> list[LocatedObject | None]:
    """Silhouettes on the plane z = h/2, where parallax of top and foot cancel to first order.

    None for one of another picture's size, and for one that has no place on the table.
    """
    usable = [i for i, item in enumerate(detections) if item.frame.size == calibration.camera.image_size]
    out: list[LocatedObject | None] = [None] * len(detections)
    if not usable:
        return out
    points = [np.concatenate([detections[i].outline_px, _direction(detections[i])]) for i in usable]
    counts = [len(own) for own in points]
    levels = np.repeat([heights[i] / 2.0 for i in usable], counts)
    on_table = calibration.plane().to_plane(np.concatenate(points), levels)
    for i, own in zip(usable, np.split(on_table, np.cumsum(counts)[:-1]), strict=True):
        out[i] = _silhouette(detections[i], calibration, heights[i], own[:-2], own[-2:])
    return out


def _direction(detection: Detection) -> Array:
    """Two points (2, 2), px, on both sides of a detection's centre, along its direction."""
    reach = max(detection.size_px) / 2
    angle = detection.angle or 0.0
    # Counter-clockwise as displayed: the image's y runs down.
    ahead = reach * np.array([math.cos(angle), -math.sin(angle)])
    return np.asarray(np.asarray(detection.center_px) + np.array([-ahead, ahead]))


def _silhouette(
    detection: Detection, calibration: CellCalibration, height: float, outline: Array, ends: Array
) -> LocatedObject | None:
    """A detection on a plane, where its outline (N, 2) and `_direction`'s points lie there, mm."""
    if not np.isfinite(outline).all():
        return None
    following = np.concatenate([outline[1:], outline[:1]])
    cross = outline[:, 0] * following[:, 1] - following[:, 0] * outline[:, 1]
    area = cross.sum() / 2
    if abs(area) < 1.0:
        return None
    x, y = (cross @ (outline + following) / (6 * area)).tolist()
    center = (x, y)
    if area < 0.0:
        outline, area = outline[::-1], -area
    _, sides, _ = cv2.minAreaRect((outline - center).astype(np.float32))
    size = (float(max(sides)), float(min(sides)))
    if detection.shape is Shape.CIRCLE:
        size = (2 * math.sqrt(area / math.pi),) * 2
    period, yaw = detection.shape.period, None
    if detection.angle is not None and period is not None:
        back, front = ends.tolist()
        yaw = wrap(math.atan2(front[1] - back[1], front[0] - back[0]), period)
    return LocatedObject(
        detection=detection,
        center=center,
        yaw=yaw,
        size=size,
        height=height,
        footprint=outline,
        sigma=math.hypot(HALF_HEIGHT_SIGMA * height, calibration.sigma),
        calibration_id=calibration.calibration_id,
    )


def _fits(
    things: Sequence[LocatedObject],
    calibration: CellCalibration,
    noise: Noise,
    objection: Callable[[PrismFit], str | None],
) -> list[PrismFit]:
    """The best prism of each: from the detection's own direction, or from others when that one is not explained."""
    fits = fit_prisms([_start(thing) for thing in things], calibration.camera, calibration.T_table_camera, noise)
    open_ = [
        i for i, (thing, fit) in enumerate(zip(things, fits, strict=True))
        if thing.detection.shape.period is not None and objection(fit) is not None
    ]  # fmt: skip
    starts = [_start(things[i], turn) for i in open_ for turn in _TURNS]
    turned = fit_prisms(starts, calibration.camera, calibration.T_table_camera, noise)
    for k, i in enumerate(open_):
        tried = [fits[i], *turned[k * len(_TURNS) : (k + 1) * len(_TURNS)]]
        sound = [fit for fit in tried if objection(fit) is None]
        fits[i] = sound[0] if sound else min(tried, key=lambda fit: fit.cost)
    return fits


def _start(thing: LocatedObject, turn: float = 0.0) -> Start:
    """Where the fit of a prism starts, turned by a share of its shape's period."""
    shape, size = thing.detection.shape, thing.size
    if shape is Shape.RECTANGLE:
        dimensions: tuple[float, ...] = size
    elif shape is Shape.HEXAGON:
        dimensions = (size[0] / 2,)
    elif shape is Shape.CIRCLE:
        dimensions = (size[0],)
    else:
        dimensions = ((size[0] + size[1]) / 2,)
    yaw = (thing.yaw or 0.0) + turn * (shape.period or 0.0)
    return Start(thing.detection.outline_px, shape, (*thing.center, yaw), dimensions, thing.height)


def _slant(calibration: CellCalibration, center: tuple[float, float]) -> float:
    """How far apart, mm, two points seen as one lie on the table for every mm that they differ in height."""
    lens = calibration.T_table_camera[:3, 3]
    return math.dist(center, (float(lens[0]), float(lens[1]))) / float(lens[2])


def _objection(fit: PrismFit, limits: Limits) -> str | None:
    """Why a fit is not good enough, or None."""
    distances, edges, used = np.abs(fit.residuals), fit.edges, fit.used
    share = float((distances <= limits.inlier).mean())
    if share < limits.share:
        return f"its outline is not this shape: {share:.0%} of it within {limits.inlier:g} px of the fit"
    if fit.yaw is None:
        worst = _median(distances)
    else:
        counts = np.bincount(edges[used])
        sides = [fit.residuals[used & (edges == edge)] for edge in np.flatnonzero(counts >= 5)]
        worst = max((_median(np.abs(side)) for side in sides), default=math.inf)
        ragged = max((_median(np.abs(side - _median(side))) for side in sides), default=0.0)
        if ragged > limits.ragged:
            return f"one side is ragged by {ragged:.2f} px"
    if worst > limits.edge:
        return f"one side lies {worst:.2f} px beside the fit"
    return None


def _median(values: Array) -> float:
    """The median of some values (N,), without the overhead of numpy's, which is ten times the work for so few."""
    ordered, half = np.sort(values), len(values) // 2
    return float(ordered[half] if len(values) % 2 else (ordered[half - 1] + ordered[half]) / 2)

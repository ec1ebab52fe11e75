"""Objects on the table from detections in a frame: position, direction, size, with a stated deviation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import CellCalibration, Detection, LocatedObject, Shape
from controller.geometry import wrap
from controller.localization.prism import Noise, PrismFit, Silhouette, bounding_size, footprint
from controller.localization.second_look import second_look

Array = NDArray[np.float64]

#: Deviation of a silhouette's centroid on z = h/2 from the part's, as a share of its height: measured 0.01
#: for centrally symmetric prisms and up to 0.05 for triangles, the worse taken.
HALF_HEIGHT_SIGMA = 0.05
#: Fewer outline points than this cannot carry a fit of six unknowns with anything left to judge it by.
MIN_POINTS = 20
#: Starts that are tried, as a share of the shape's period away from the detection's own direction: the fit
#: of a tall part may end in a local optimum.
_TURNS = (0.0, 1 / 6, -1 / 6, 1 / 3, -1 / 3, 1 / 2)


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
    objects: list[LocatedObject] = []
    refused: list[tuple[Detection, str]] = []
    in_the_way: list[LocatedObject] = []
    for detection in detections:
        height = heights(detection)
        found = _locate_one(detection, calibration, height, refine, known, objection)
        if not isinstance(found, str):
            objects.append(found)
            continue
        refused.append((detection, found))
        if detection.frame.size == calibration.camera.image_size:
            rough = _on_half_height(detection, calibration, height)
            if rough is not None:
                in_the_way.append(rough)
    return Located(tuple(objects), tuple(refused), tuple(in_the_way))


def _locate_one(
    detection: Detection,
    calibration: CellCalibration,
    height: float,
    refine: bool,
    noise: Noise,
    objection: Callable[[PrismFit], str | None],
) -> LocatedObject | str:
    if "cut_by_border" in detection.flags:
        return "cut by the border of the picture"
    if detection.frame.size != calibration.camera.image_size:
        return f"a picture of {detection.frame.size} px, calibrated at {calibration.camera.image_size}"
    rough = _on_half_height(detection, calibration, height)
    if rough is None:
        return "its rays do not meet the table"
    if not refine or detection.shape is Shape.OTHER:
        return rough
    if len(detection.outline_px) < MIN_POINTS:
        return f"only {len(detection.outline_px)} outline points"
    fit = _fit(detection, calibration, rough, noise, objection)
    fit = second_look(detection, calibration, fit, height, noise, objection)
    reason = objection(fit)
    if reason:
        return reason
    spread = float(np.linalg.eigvalsh(fit.covariance)[-1])
    size = bounding_size(detection.shape, fit.dimensions)
    # A height that the outline disputes moves the part along the line of sight.
    doubt = _slant(calibration, fit.center) * abs(fit.height - height)
    return LocatedObject(
        detection=detection,
        center=fit.center,
        yaw=fit.yaw,
        size=size,
        height=fit.height,
        footprint=footprint(detection.shape, fit.center, fit.yaw, fit.dimensions),
        sigma=math.sqrt(spread + calibration.sigma**2 + doubt**2),
        calibration_id=calibration.calibration_id,
    )


def _on_half_height(detection: Detection, calibration: CellCalibration, height: float) -> LocatedObject | None:
    """The silhouette on the plane z = h/2, where parallax of top and foot cancel to first order."""
    plane = calibration.plane(height / 2)
    outline = plane.to_plane(detection.outline_px)
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
    return LocatedObject(
        detection=detection,
        center=center,
        yaw=_yaw(detection, calibration, height / 2),
        size=size,
        height=height,
        footprint=outline,
        sigma=math.hypot(HALF_HEIGHT_SIGMA * height, calibration.sigma),
        calibration_id=calibration.calibration_id,
    )


def _yaw(detection: Detection, calibration: CellCalibration, level: float) -> float | None:
    """The detection's direction carried over to the table."""
    period = detection.shape.period
    if detection.angle is None or period is None:
        return None
    reach = max(detection.size_px) / 2
    # Counter-clockwise as displayed: the image's y runs down.
    ahead = reach * np.array([math.cos(detection.angle), -math.sin(detection.angle)])
    ends = np.asarray(detection.center_px) + np.array([-ahead, ahead])
    back, front = calibration.plane(level).to_plane(ends)
    return wrap(math.atan2(front[1] - back[1], front[0] - back[0]), period)


def _fit(
    detection: Detection,
    calibration: CellCalibration,
    rough: LocatedObject,
    noise: Noise,
    objection: Callable[[PrismFit], str | None],
) -> PrismFit:
    """The best prism: from the detection's own direction, or from others when that one is not explained."""
    shape, height = detection.shape, rough.height
    silhouette = Silhouette(detection.outline_px, calibration.camera, calibration.T_table_camera)
    first = rough.yaw or 0.0
    if shape is Shape.RECTANGLE:
        dimensions: tuple[float, ...] = rough.size
    elif shape is Shape.HEXAGON:
        dimensions = (rough.size[0] / 2,)
    elif shape is Shape.CIRCLE:
        dimensions = (rough.size[0],)
    else:
        dimensions = ((rough.size[0] + rough.size[1]) / 2,)
    best: PrismFit | None = None
    for turn in (0.0,) if shape.period is None else _TURNS:
        start = (*rough.center, first + turn * (shape.period or 0.0))
        fit = silhouette.fit(shape, start, dimensions, height, noise)
        if objection(fit) is None:
            return fit
        best = fit if best is None else min(best, fit, key=lambda one: one.cost)
    assert best is not None
    return best


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

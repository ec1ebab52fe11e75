"""A second look at the picture where a prism does not quite explain an outline.

Vision knows one typical height for all parts, and shadows lie along their feet: an outline may run between two
edges, or along the wrong one of two. Once shape and pose are nearly known, the picture itself tells which prism of
the stated height is there: of several candidates the one whose edges it shows best.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from controller.domain import CellCalibration, Detection, Shape
from controller.geometry import invert, transform
from controller.localization.prism import Noise, PrismFit, Silhouette, footprint
from controller.localization.remeasure import misfit, remeasured

Array = NDArray[np.float64]

#: A fitted height this many deviations off the stated one speaks of an outline that runs beside the part, ...
_STRAINED = 1.0
#: ... and this many of another height, or of no such prism.
TORN = 3.0
#: A prism whose edges lie this far beside those in the picture is doubtful, px in the mean: five times what a good
#: one has by noise and blur, ...
_DOUBTFUL = 0.25
#: ... and another must be this much nearer to them.
_MARGIN = 0.1
#: Prisms that differ by less than this, mm, are the same.
_SAME = 0.1
#: How far about a silhouette its edges are looked for, px, first and then nearer.
_REACHES = (6.0, 4.0, 2.5)
#: Sides narrower than this, px, are within reach of where the outline has them.
_NARROWEST = 3.0
#: Fewer points than this cannot carry a fit.
_LEAST_POINTS = 20


def second_look(
    detection: Detection,
    calibration: CellCalibration,
    fit: PrismFit,
    height: float,
    noise: Noise,
    objection: Callable[[PrismFit], str | None],
) -> PrismFit:
    """The prism that the picture bears out best: the given one, unless it is doubtful and another one is better.

    Args:
        detection: What was seen.
        calibration: Of the cell.
        fit: The prism on the outline.
        height: Stated, mm.
        noise: What is known about outlines and heights.
        objection: Why a fit is not good enough, or None.
    """
    image = detection.frame.image
    beside = misfit(image, *corners(detection, calibration, fit))
    sound = objection(fit) is None
    strain = abs(fit.height - height) / noise.height
    if sound and strain <= _STRAINED and beside <= _DOUBTFUL:
        return fit
    best, least = fit, beside - _MARGIN if sound and strain <= TORN else np.inf
    settled: list[PrismFit] = []
    for start in _starts(detection, calibration, fit, height, noise):
        found = _settled(detection, calibration, start, height, noise, settled)
        if found is None:
            continue
        settled.append(found)
        if objection(found) is not None or abs(found.height - height) > TORN * noise.height:
            continue
        value = misfit(image, *corners(detection, calibration, found))
        if value < least:
            best, least = found, value
        if least < _MARGIN:
            break
    return best


def corners(detection: Detection, calibration: CellCalibration, fit: PrismFit) -> tuple[Array, Array]:
    """Pixels (K, 2) of a fitted prism's corners on the table, and of those above them."""
    feet = footprint(detection.shape, fit.center, fit.yaw, fit.dimensions)
    levels = np.repeat([0.0, fit.height], len(feet))
    points = np.column_stack([np.concatenate([feet, feet]), levels])
    pixels = calibration.camera.project(transform(invert(calibration.T_table_camera), points))
    return pixels[: len(feet)], pixels[len(feet) :]


def _starts(
    detection: Detection, calibration: CellCalibration, fit: PrismFit, height: float, noise: Noise
) -> Iterator[PrismFit]:
    """Prisms of the stated height near the fitted one."""
    yield replace(fit, height=height)
    # The same top face: it is what vision found, and the foot what it guessed.
    above = calibration.plane(fit.height).to_pixels(np.array([fit.center]))
    place = calibration.plane(height).to_plane(above)[0]
    yield replace(fit, height=height, center=(float(place[0]), float(place[1])))
    if detection.shape is Shape.CIRCLE:
        return
    for outline in _moved_out(detection.outline_px, *corners(detection, calibration, fit)):
        yield _fitted(outline, detection, calibration, fit, height, noise)


def _moved_out(outline: Array, foot: Array, top: Array) -> Iterator[Array]:
    """The outline with one near side moved out by its strip, for every near side.

    The border between top face and side may have been taken for the foot: then the true foot is one strip further out.
    """
    middle = top.mean(axis=0)
    for a, b, c, d in zip(foot, np.roll(foot, -1, axis=0), top, np.roll(top, -1, axis=0), strict=True):
        along = b - a
        normal = np.array([along[1], -along[0]]) / float(np.linalg.norm(along))
        normal *= np.sign(normal @ ((a + b) / 2 - middle))
        strip = float(normal @ ((a + b) - (c + d)) / 2)
        if strip < _NARROWEST:
            continue
        apart = outline - a
        share = apart @ along / float(along @ along)
        on = (np.abs(apart @ normal) < 0.5 * strip) & (share > -0.02) & (share < 1.02)
        yield outline + np.where(on, strip, 0.0)[:, None] * normal


def _settled(
    detection: Detection,
    calibration: CellCalibration,
    start: PrismFit,
    height: float,
    noise: Noise,
    known: Sequence[PrismFit],
) -> PrismFit | None:
    """The prism on the edges of the picture near a start; None when they are too few or lead to a known one."""
    found = start
    for reach in _REACHES:
        held = replace(found, height=height)
        outline = remeasured(detection.frame.image, *corners(detection, calibration, held), reach)
        if len(outline) < _LEAST_POINTS:
            return None
        found = _fitted(outline, detection, calibration, found, height, noise)
        if any(_same(found, other) for other in known):
            return None
    return found


def _same(one: PrismFit, other: PrismFit) -> bool:
    turned = abs((one.yaw or 0.0) - (other.yaw or 0.0)) * max(one.dimensions)
    grown = max(abs(a - b) for a, b in zip(one.dimensions, other.dimensions, strict=True))
    return max(math.dist(one.center, other.center), turned, grown) < _SAME


def _fitted(
    outline: Array, detection: Detection, calibration: CellCalibration, start: PrismFit, height: float, noise: Noise
) -> PrismFit:
    silhouette = Silhouette(outline, calibration.camera, calibration.T_table_camera)
    return silhouette.fit(detection.shape, (*start.center, start.yaw or 0.0), start.dimensions, height, noise)

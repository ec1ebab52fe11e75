"""A second look at the picture where a prism does not quite explain an outline.

Vision knows one typical height for all parts, and shadows lie along their feet: an outline may run between two
edges, or along the wrong one of two. Once shape and pose are nearly known, the picture itself tells which prism of
the stated height is there: of several candidates the one whose edges it shows best.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from controller.domain import CellCalibration, LocatedObject, Shape
from controller.geometry import invert, transform
from controller.localization.prism import Noise, PrismFit, footprint
from controller.localization.prism_fit import Start, fit_prisms
from controller.localization.remeasure import misfits, remeasured

Array = NDArray[np.float64]
Prism = tuple[LocatedObject, PrismFit]
"""What was seen, with its stated height, and a prism that may be it."""

#: A fitted height this many deviations off the stated one speaks of an outline that runs beside the part, ...
_STRAINED = 1.0
#: ... and this many of another height, or of no such prism.
_TORN = 3.0
#: A prism whose edges lie this far beside those in the picture is doubtful, px in the mean: five times what a good
#: one has by noise and blur, ...
_DOUBTFUL = 0.25
#: ... and another must be this much nearer to them.
_MARGIN = 0.1
#: How far about a silhouette its edges are looked for, px, first and then nearer.
_REACHES = (6.0, 4.0, 2.5)
#: Sides narrower than this, px, are within reach of where the outline has them.
_NARROWEST = 3.0
#: Fewer points than this cannot carry a fit.
_LEAST_POINTS = 20


def second_looks(
    prisms: Sequence[Prism],
    calibration: CellCalibration,
    noise: Noise,
    objection: Callable[[PrismFit], str | None],
) -> list[PrismFit]:
    """The prisms that the picture bears out best: the given ones, unless one is doubtful and another one is better.

    Args:
        prisms: What was seen in one picture, and the prism on the outline of each.
        calibration: Of the cell.
        noise: What is known about outlines and heights.
        objection: Why a fit is not good enough, or None.
    """
    if not prisms:
        return []
    image = prisms[0][0].detection.frame.image
    best = [fit for _, fit in prisms]
    limit = [0.0] * len(prisms)
    for i, ((thing, fit), beside) in enumerate(zip(prisms, misfits(image, corners(prisms, calibration)), strict=True)):
        sound, strain = objection(fit) is None, abs(fit.height - thing.height) / noise.height
        if not sound or strain > _STRAINED or beside > _DOUBTFUL:
            limit[i] = float(beside) - _MARGIN if sound and strain <= _TORN else np.inf
    # Every doubtful one is tried at its stated height; what that explains, or does not mend, needs no other start.
    for nearby, least in ((_of_height, 0.0), (_elsewhere, _MARGIN)):
        doubtful = [i for i, most in enumerate(limit) if most > least]
        owners, starts = nearby([prisms[i] for i in doubtful], calibration, noise)
        owners, found = _settled([doubtful[k] for k in owners], starts, calibration, noise)
        for i, prism, value in zip(owners, found, misfits(image, corners(found, calibration)), strict=True):
            thing, fit = prism
            if limit[i] <= least or value >= limit[i] or abs(fit.height - thing.height) > _TORN * noise.height:
                continue
            if objection(fit) is None:
                best[i], limit[i] = fit, float(value)
    return best


def corners(prisms: Sequence[Prism], calibration: CellCalibration) -> list[tuple[Array, Array]]:
    """Pixels (V, 2) of each prism's corners on the table, and of those above them."""
    if not prisms:
        return []
    feet = [footprint(thing.detection.shape, fit.center, fit.yaw, fit.dimensions) for thing, fit in prisms]
    both = [foot for foot in feet for _ in range(2)]
    counts = [len(foot) for foot in both]
    points = np.empty((sum(counts), 3))
    points[:, :2] = np.concatenate(both)
    points[:, 2] = np.repeat([level for _, fit in prisms for level in (0.0, fit.height)], counts)
    pixels = calibration.camera.project(transform(invert(calibration.T_table_camera), points))
    parts = np.split(pixels, np.cumsum(counts)[:-1])
    return list(zip(parts[::2], parts[1::2], strict=True))


def _of_height(
    prisms: Sequence[Prism], calibration: CellCalibration, noise: Noise
) -> tuple[list[int], list[Prism]]:
    """The prisms, were they of the stated height: whose each is, and they."""
    del calibration, noise
    return list(range(len(prisms))), [(thing, replace(fit, height=thing.height)) for thing, fit in prisms]


def _elsewhere(
    prisms: Sequence[Prism], calibration: CellCalibration, noise: Noise
) -> tuple[list[int], list[Prism]]:
    """Other prisms of the stated height near the given ones: whose each is, and they."""
    owners, starts = list(range(len(prisms))), []
    # The same top face: it is what vision found, and the foot what it guessed.
    for thing, fit in prisms:
        above = calibration.plane(fit.height).to_pixels(np.array([fit.center]))
        x, y = calibration.plane(thing.height).to_plane(above)[0].tolist()
        starts.append((thing, replace(fit, height=thing.height, center=(x, y))))
    moved: list[int] = []
    outlines: list[Array] = []
    for k, ends in enumerate(corners(prisms, calibration)):
        detection = prisms[k][0].detection
        if detection.shape is not Shape.CIRCLE:
            outlines += _moved_out(detection.outline_px, *ends)
            moved += [k] * (len(outlines) - len(moved))
    return owners + moved, starts + _fitted([prisms[k] for k in moved], outlines, calibration, noise)


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
    owners: Sequence[int], starts: Sequence[Prism], calibration: CellCalibration, noise: Noise
) -> tuple[list[int], list[Prism]]:
    """The prisms on the edges of the picture near some starts, and whose each is; without those on too few of them."""
    found = list(zip(owners, starts, strict=True))
    for reach in _REACHES:
        if not found:
            break
        held = [(thing, replace(fit, height=thing.height)) for _, (thing, fit) in found]
        image = held[0][0].detection.frame.image
        outlines = remeasured(image, corners(held, calibration), reach)
        enough = [len(outline) >= _LEAST_POINTS for outline in outlines]
        found = [one for one, use in zip(found, enough, strict=True) if use]
        outlines = [outline for outline, use in zip(outlines, enough, strict=True) if use]
        fits = _fitted([prism for _, prism in found], outlines, calibration, noise)
        found = [(owner, prism) for (owner, _), prism in zip(found, fits, strict=True)]
    return [owner for owner, _ in found], [prism for _, prism in found]


def _fitted(
    prisms: Sequence[Prism], outlines: Sequence[Array], calibration: CellCalibration, noise: Noise
) -> list[Prism]:
    """Prisms brought onto other outlines."""
    starts = [
        Start(outline, thing.detection.shape, (*fit.center, fit.yaw or 0.0), fit.dimensions, thing.height)
        for (thing, fit), outline in zip(prisms, outlines, strict=True)
    ]
    fits = fit_prisms(starts, calibration.camera, calibration.T_table_camera, noise)
    return [(thing, fit) for (thing, _), fit in zip(prisms, fits, strict=True)]

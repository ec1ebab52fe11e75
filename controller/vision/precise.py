"""The recipe `precise`: propose regions, find edges, fit shapes, refine the plausible ones, judge."""

from __future__ import annotations

from collections.abc import MutableMapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.geometry import PlaneMap
from controller.vision.background import Box, Whitened, whiten
from controller.vision.fitting import Hypothesis, fit_all
from controller.vision.local_map import LocalMaps, joined, local_maps
from controller.vision.noise import pixel_noise, without_spikes
from controller.vision.proposals import Region, propose, split_necks
from controller.vision.rays import find_edges, radial_profile
from controller.vision.recipe import Precise
from controller.vision.scene import Found, Scene
from controller.vision.timing import Stopwatch
from controller.vision.verdict import explained, judge, refined_outlines, settled

Floats = NDArray[np.float64]


def search(
    image: NDArray[np.uint8],
    settings: Precise,
    *,
    plane: PlaneMap | None = None,
    background: NDArray[np.uint8] | None = None,
    region: NDArray[np.uint8] | None = None,
    trace: MutableMapping[str, NDArray[np.generic]] | None = None,
    watch: Stopwatch,
) -> list[Found]:
    """Objects in an image; see `detect` for the arguments."""
    factor = reduction(image.shape)
    small = _small(image, factor)
    empty = None if background is None else _small(background, factor)
    mask = None
    if region is not None:
        mask = cv2.resize(region, small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    box = None if mask is None else _box(np.asarray(mask))
    watch.lap("reduce")
    white = whiten(small, empty, box)
    watch.lap("background")
    smallest = 0.5 * (settings.smallest_px / factor) ** 2
    regions, strengths = propose(white, settings.level, smallest, box)
    if trace is not None:
        for name, strength in strengths.items():
            trace[name] = np.clip(4.0 * strength, 0.0, 255.0).astype(np.uint8)
    if mask is not None:
        regions = _within(regions, np.asarray(mask))
    sides = plane is not None and plane.height > 0.0
    regions = _distinct(regions, small.shape, 0.02 if sides else 0.06)
    watch.lap("propose")
    noise = pixel_noise(image)
    image = without_spikes(image, noise)
    # First what stands out clearly; the costlier guesses only where that left something open.
    clear = [(item.core and (sides or item.cue == "level")) or (sides and item.cue == "zone") for item in regions]
    first = [item for item, use in zip(regions, clear, strict=True) if use]
    later = [item for item, use in zip(regions, clear, strict=True) if not use]
    first, maps, fits = _fits(first, white, factor, plane, watch)
    scene = Scene(image, noise, white, factor, maps, first, plane, settings)
    judged = refined_outlines(scene, fits)
    watch.lap("refine")
    done = settled(judged)
    open_ = [item for item in first if item.cue != "zone" and not explained(item, done, factor)]
    rest = [item for item in later if not explained(item, done, factor)]
    pieces = [piece for item in open_ for piece in split_necks(item, smallest)]
    pieces = _distinct([*rest, *pieces], small.shape, 0.02 if sides else 0.06)
    pieces = [item for item in pieces if not explained(item, done, factor)]
    second, more, fits = _fits(pieces, white, factor, plane, watch)
    fits = [[replace(h, region=h.region + len(first)) for h in options] for options in fits]
    scene = replace(scene, maps=joined(maps, more), regions=[*first, *second])
    judged += refined_outlines(scene, fits)
    watch.lap("refine")
    return judge(scene, judged, watch)


def _fits(
    regions: list[Region], white: Whitened, factor: int, plane: PlaneMap | None, watch: Stopwatch
) -> tuple[list[Region], LocalMaps, list[list[Hypothesis]]]:
    """The regions that can be measured, their local coordinates, and the fits around each."""
    if regions:
        centers = np.array([_center(item.contour) for item in regions])
        radii = np.stack([radial_profile(item.contour, c) for item, c in zip(regions, centers, strict=True)])
        usable = np.asarray(np.isfinite(radii).all(axis=1))
        if plane is not None:
            # Beyond the horizon of the plane there is nothing to measure.
            usable &= np.isfinite(plane.to_plane(centers * factor + (factor - 1) / 2.0)).all(axis=1)
        regions = [item for item, use in zip(regions, usable, strict=True) if use]
        centers, radii = centers[usable], radii[usable]
    if not regions:
        return [], local_maps(np.empty((0, 2)), np.empty(0), plane), []
    edges, weight = find_edges(white.difference, centers, radii, np.maximum(3.0, 0.35 * radii.mean(axis=1)))
    watch.lap("rays")
    full = centers * factor + (factor - 1) / 2.0
    maps = local_maps(full, (radii.max(axis=1) + 6.0) * factor * 1.3, plane)
    count, rays, choices = weight.shape
    flat = edges.reshape(count, rays * choices, 2) * factor + (factor - 1) / 2.0
    local = maps.all_to_local(flat).reshape(count, rays, choices, 2)
    hulls = [
        maps.to_local(i, cv2.convexHull(item.contour)[:, 0].astype(np.float64) * factor + (factor - 1) / 2.0)
        for i, item in enumerate(regions)
    ]
    fits = fit_all(hulls, local, weight, factor)
    watch.lap("fit")
    return regions, maps, fits


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


def _box(mask: NDArray[np.uint8]) -> Box | None:
    """Rows and columns of the mask, with a margin for what only has its middle in it; None when all of it is 0."""
    x, y, w, h = cv2.boundingRect(mask)
    if w == 0:
        return None
    margin = max(mask.shape) // 8
    return slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin)


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


def _distinct(regions: list[Region], shape: tuple[int, ...], share: float) -> list[Region]:
    """Regions without near copies of one another, and without those that fill most of the frame.

    Copies are regions whose boxes differ by less than half a pixel and a share of their size.
    """
    kept: list[Region] = []
    seen = np.empty((len(regions), 4))
    limit = 0.8 * shape[0] * shape[1]
    for item in regions:
        x, y, w, h = cv2.boundingRect(item.contour)
        if w * h > limit:
            continue
        box = np.array([x, y, x + w, y + h], float)
        tolerance = share * max(w, h) + 0.5
        if kept and bool((np.abs(seen[: len(kept)] - box).max(axis=1) < tolerance).any()):
            continue
        seen[len(kept)] = box
        kept.append(item)
    return kept

"""The recipe `precise`: a quick tier decides what is clear, a thorough one the rest, and all of it is judged."""

from __future__ import annotations

from collections.abc import MutableMapping

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.geometry import PlaneMap
from controller.vision.background import Box, whiten
from controller.vision.clear import clear_objects
from controller.vision.contours import standing
from controller.vision.fallen import soft_shades
from controller.vision.leftover import leftovers
from controller.vision.local_map import local_maps
from controller.vision.noise import least_step, pixel_noise, without_spikes
from controller.vision.proposals import Region, chroma, edge_energy, propose
from controller.vision.recipe import Precise
from controller.vision.scene import Found, Judged, Scene
from controller.vision.selection import shaded
from controller.vision.sheet import sheets, unpacked
from controller.vision.thorough import open_objects
from controller.vision.timing import Stopwatch
from controller.vision.trial import settled
from controller.vision.verdict import judge

_SMOOTH = cv2.getGaussianKernel(7, 1.0)


def search(
    image: NDArray[np.uint8],
    settings: Precise,
    *,
    plane: PlaneMap | None = None,
    background: NDArray[np.uint8] | None = None,
    region: NDArray[np.uint8] | None = None,
    hidden: NDArray[np.uint8] | None = None,
    trace: MutableMapping[str, NDArray[np.generic]] | None = None,
    watch: Stopwatch,
) -> list[Found]:
    """Objects in an image; see `detect` for the arguments."""
    found = _search(image, settings, plane, background, region, hidden, trace, watch)
    upright = plane is not None and plane.height > 0.0
    if region is None and background is None and hidden is None and not upright:
        for sheet in sheets(found, image, plane):
            things = _search(sheet.image, settings, sheet.plane, None, None, sheet.beside, None, watch)
            found = unpacked(found, sheet, things)
            watch.lap("sheets")
    return found


def _search(
    image: NDArray[np.uint8],
    settings: Precise,
    plane: PlaneMap | None,
    background: NDArray[np.uint8] | None,
    region: NDArray[np.uint8] | None,
    hidden: NDArray[np.uint8] | None,
    trace: MutableMapping[str, NDArray[np.generic]] | None,
    watch: Stopwatch,
) -> list[Found]:
    """One search of a whole image or of a part of it."""
    noise = pixel_noise(image)
    least = max(settings.minimum_contrast, least_step(image))
    settings = settings.model_copy(update={"minimum_contrast": least})
    image = without_spikes(image, noise)
    watch.lap("noise")
    factor = reduction(image.shape)
    small = _small(image, factor)
    empty = None if background is None else _small(without_spikes(background, noise), factor)
    mask = None
    if region is not None:
        mask = cv2.resize(region, small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    box = None if mask is None else _box(np.asarray(mask))
    watch.lap("reduce")
    white = whiten(small, empty, box)
    watch.lap("background")
    smallest = 0.5 * (settings.smallest_px / factor) ** 2
    strength = white.strength
    visible = None
    if hidden is not None:
        covered = cv2.resize(hidden, small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        visible = np.asarray(cv2.threshold(covered, 0.0, 255.0, cv2.THRESH_BINARY_INV)[1], np.uint8)
        strength = np.asarray(cv2.copyTo(strength, visible), np.float32)
    scene = Scene(image, noise, white, factor, local_maps(np.empty((0, 2)), np.empty(0), plane), [], plane, settings)
    seen = standing(strength, settings.level)
    clear: list[Judged] = []
    if not scene.sides:
        scene, clear = clear_objects(scene, strength, seen, smallest)
        watch.lap("clear")
    unknown = settled(clear, scene).unexplained
    regions = propose(white, strength, seen, settings.level, smallest, unknown, box, visible)
    if trace is not None:
        maps = {"strength": strength, "chroma": chroma(white, strength), "edges": edge_energy(white.difference)}
        for name, values in maps.items():
            trace[name] = np.clip(4.0 * values, 0.0, 255.0).astype(np.uint8)
    if mask is not None:
        regions = _within(regions, np.asarray(mask))
    if visible is not None:
        regions = _whole(regions, visible)
    watch.lap("propose")
    scene, rest = open_objects(scene, regions, clear, smallest, watch)
    found = judge(scene, [*clear, *rest], watch)
    if scene.sides and settings.others:
        there = None if mask is None else np.asarray(mask, np.uint8)

        def shadow(where: NDArray[np.bool_]) -> NDArray[np.bool_]:
            return shaded(scene, white.difference[where].astype(np.float64))

        shades = soft_shades(scene, [item.face for item in found])
        plain = [item for item, shade in zip(found, shades, strict=True) if not shade]
        found += leftovers(strength, found, plain, factor, there, settings.smallest_px / factor, shadow)
        watch.lap("others")
    return found


def reduction(shape: tuple[int, ...]) -> int:
    """How many times smaller the searched image is: small objects need every pixel of a small frame."""
    pixels = shape[0] * shape[1]
    return 1 if pixels < 500_000 else 2 if pixels < 16_000_000 else 4


def _small(image: NDArray[np.uint8], factor: int) -> NDArray[np.float32]:
    if factor > 1:
        size = (image.shape[1] // factor, image.shape[0] // factor)
        image = np.asarray(
            cv2.resize(image[: size[1] * factor, : size[0] * factor], size, interpolation=cv2.INTER_AREA), np.uint8
        )
    elif min(image.shape[:2]) >= 3:
        # No neighbours were averaged: single pixels of noise would break the regions of small frames.
        image = np.asarray(cv2.medianBlur(image, 3), np.uint8)
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, _SMOOTH, _SMOOTH), np.float32)


def _box(mask: NDArray[np.uint8]) -> Box | None:
    """Rows and columns of the mask, from even ones on, with a margin for what only has its middle in it.

    None when all of the mask is 0.
    """
    x, y, w, h = cv2.boundingRect(mask)
    if w == 0:
        return None
    margin = max(mask.shape) // 8
    top, left = max(y - margin, 0) // 2 * 2, max(x - margin, 0) // 2 * 2
    return slice(top, y + h + margin), slice(left, x + w + margin)


def _whole(regions: list[Region], visible: NDArray[np.uint8]) -> list[Region]:
    """Regions that do not run into what hides the table: others are cut, and mostly the shadow of that very thing."""
    if not regions:
        return []
    free = np.asarray(cv2.erode(visible, np.ones((5, 5), np.uint8)))
    places = np.rint(np.concatenate([item.contour for item in regions])).astype(np.intp)
    x, y = np.minimum(np.maximum(places, 0), np.array(visible.shape[::-1]) - 1).T
    first = np.cumsum([0, *(len(item.contour) for item in regions[:-1])])
    clear = np.minimum.reduceat(free[y, x], first) > 0
    return [item for item, yes in zip(regions, clear.tolist(), strict=True) if yes]


def _within(regions: list[Region], mask: NDArray[np.uint8]) -> list[Region]:
    """Regions whose bounding box has its middle in the mask."""
    out = []
    for item in regions:
        x, y, w, h = cv2.boundingRect(item.contour)
        row, column = min(max(y + h // 2, 0), mask.shape[0] - 1), min(max(x + w // 2, 0), mask.shape[1] - 1)
        if mask[row, column]:
            out.append(item)
    return out

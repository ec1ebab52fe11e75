"""What a taught class remembers of a view: outline, size, colour, texture and print, none of which turns with the part.

The outline and the print are read on circles around the part's middle; along a circle only the strengths of the
harmonics are kept, which a turn does not change. (A part and its mirror image look alike to this.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection
from controller.geometry import PlaneMap
from controller.vision.appearance.look import Surfaces
from controller.vision.appearance.patch import Patch
from controller.vision.appearance.texture import LENGTH as TEXTURE_LENGTH
from controller.vision.appearance.tiles import SIDE, WINDOW, Tiles

Floats32 = NDArray[np.float32]

VERSION = 1
"""Changes whenever a figure's meaning does: classes taught with another version have to be taught again."""

_RINGS, _ANGLES, _HARMONICS = 14, 64, 12
_REACH = 1.4
"""Circles reach this many roots of the area from the middle: the ends of a part four times as long as wide lie at 1."""
_PRINT_RINGS, _PRINT_HARMONICS = 7, 7

BLOCKS: Mapping[str, int] = {
    "outline": _RINGS * _HARMONICS,
    "form": 3,
    "size": 1,
    "colour": 3,
    "texture": TEXTURE_LENGTH,
    "print": _PRINT_RINGS * _PRINT_HARMONICS,
}
"""Parts of the vector in order, and their lengths."""
LENGTH = sum(BLOCKS.values())


def block(name: str) -> slice:
    """Where a block lies in the vector."""
    start = 0
    for key, length in BLOCKS.items():
        if key == name:
            return slice(start, start + length)
        start += length
    raise KeyError(name)


def features(detections: Sequence[Detection], surfaces: Surfaces, plane: PlaneMap | None) -> Floats32:
    """(n, LENGTH) of the surfaces' detections; sizes in mm with a plane, else in px."""
    count = len(surfaces.which)
    if not count:
        return np.empty((0, LENGTH), np.float32)
    chosen = [detections[k] for k in surfaces.which]
    polar = np.stack([_circles(patch) for patch in surfaces.patches])
    outline = np.abs(np.fft.rfft(polar, axis=1))[:, :_HARMONICS].reshape(count, -1) / _ANGLES
    form = np.array([_form(patch) for patch in surfaces.patches])
    size = np.log(np.sqrt([max(item.area_px, 1.0) for item in chosen]) * _scales(chosen, plane))
    colour = np.array([seen.lab for seen in surfaces.colours])
    parts = (outline, form, size[:, None], colour, surfaces.textures, _print(surfaces.tiles))
    return np.concatenate([np.asarray(part, np.float32) for part in parts], axis=1)


def _scales(detections: Sequence[Detection], plane: PlaneMap | None) -> NDArray[np.float64]:
    """Millimetres of the plane a pixel spans at each detection, or ones."""
    if plane is None:
        return np.ones(len(detections))
    middles = np.array([item.center_px for item in detections])
    at = np.concatenate([middles, middles + (1.0, 0.0), middles + (0.0, 1.0)])
    here, right, down = np.split(plane.to_plane(at), 3)
    u, v = (right - here)[:, :2], (down - here)[:, :2]
    return np.asarray(np.sqrt(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])))


def _circles(patch: Patch) -> Floats32:
    """(ANGLES, RINGS): how much of the part lies around each place of a polar grid, 0 to 1."""
    x, y = (c - o for c, o in zip(patch.detection.center_px, patch.corner, strict=True))
    reach = _REACH * math.sqrt(max(patch.detection.area_px, 1.0))
    # Two samples a ring, averaged: an edge that crosses a ring moves the figure evenly.
    # Without the flag, what lies outside the cut would be whatever the memory held.
    how = cv2.WARP_POLAR_LINEAR | cv2.WARP_FILL_OUTLIERS
    grid = cv2.warpPolar(patch.solid, (2 * _RINGS, _ANGLES), (x, y), reach, how)
    return np.asarray(grid.reshape(_ANGLES, _RINGS, 2).mean(axis=2) / 255.0, np.float32)


def _form(patch: Patch) -> tuple[float, float, float]:
    """Logarithm of the aspect, share of the hull that is filled, share of the outline that is hole."""
    outline = patch.detection.outline_px.astype(np.float32)
    hull = float(cv2.contourArea(cv2.convexHull(outline)))
    long, short = patch.detection.size_px
    inside = max(cv2.countNonZero(patch.inside), 1)
    hole = 1.0 - cv2.countNonZero(patch.solid) / inside
    return math.log(max(long, 1.0) / max(short, 1.0)), patch.detection.area_px / max(hull, 1.0), hole


def _sampling() -> tuple[NDArray[np.intp], Floats32]:
    """Pixels of a tile (4, places) and their weights that a polar grid of ANGLES / 2 x PRINT_RINGS reads."""
    angle = np.arange(_ANGLES // 2) * 4.0 * math.pi / _ANGLES
    # Circles up to where a square ends along its sides.
    radius = (np.arange(_PRINT_RINGS) + 0.5) / _PRINT_RINGS * 0.5 * SIDE / WINDOW
    middle = (SIDE - 1) / 2.0
    x = (middle + np.cos(angle)[:, None] * radius).ravel()
    y = (middle + np.sin(angle)[:, None] * radius).ravel()
    i, j = np.floor(y).astype(np.intp), np.floor(x).astype(np.intp)
    u, v = y - i, x - j
    places = np.stack([i * SIDE + j, i * SIDE + j + 1, (i + 1) * SIDE + j, (i + 1) * SIDE + j + 1])
    weights = np.stack([(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v])
    return places, weights.astype(np.float32)


_PLACES, _WEIGHTS = _sampling()


def _print(surface: Tiles) -> Floats32:
    """(n, PRINT_RINGS * PRINT_HARMONICS): strengths of the harmonics of brightness along circles on the part.

    Brightness is relative to the part's mean, and counts only on its material: light and edges leave it alone.
    """
    count = len(surface.image)
    gray = np.stack([cv2.cvtColor(tile, cv2.COLOR_BGR2GRAY) for tile in surface.image]).reshape(count, -1)
    inside = (surface.material.reshape(count, -1) > 127).astype(np.float32)
    values = gray.astype(np.float32)
    mean = (values * inside).sum(axis=1) / np.maximum(inside.sum(axis=1), 1.0)
    relative = (values / np.maximum(mean, 8.0)[:, None] - 1.0) * inside
    grid = (relative[:, _PLACES] * _WEIGHTS).sum(axis=1).reshape(count, _ANGLES // 2, _PRINT_RINGS)
    strengths = np.abs(np.fft.rfft(grid, axis=1))[:, :_PRINT_HARMONICS] / (_ANGLES // 2)
    return np.asarray(strengths.reshape(count, -1), np.float32)

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
from controller.vision.appearance.texture import LENGTH as TEXTURE_LENGTH
from controller.vision.appearance.tiles import FIELD, SIDE, WINDOW, Tiles

Floats32 = NDArray[np.float32]

VERSION = 4
"""Changes whenever a figure's meaning does: classes taught with another version have to be taught again."""

_RINGS, _ANGLES, _HARMONICS = 14, 64, 12
_REACH = 1.4
"""Circles reach this many roots of the area from the middle, as far as the field does."""
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
OPEN_BLOCKS = ("colour", "texture", "print")
"""What a drawing says nothing of: not a number in the views of a class that was taught by one."""


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
    seen = surfaces.tiles
    outline = _strengths(_OUTLINE_WAVES @ _circles(seen.form).astype(np.float32) @ _PAIRS, _HARMONICS)
    form = np.array([(*_proportions(item), hole) for item, hole in zip(chosen, seen.hole.tolist(), strict=True)])
    size = np.log(np.sqrt([max(item.area_px, 1.0) for item in chosen]) * _scales(chosen, plane))
    colour = np.array([seen.lab for seen in surfaces.colours])
    parts = (outline, form, size[:, None], colour, surfaces.textures, _print(seen))
    return np.concatenate([np.asarray(part, np.float32) for part in parts], axis=1)


def _waves(angles: int, harmonics: int) -> Floats32:
    """(2 * harmonics, angles): cosines and sines of the first harmonics of a circle, so that a mean is 1."""
    turn = np.outer(np.arange(harmonics), np.arange(angles)) * 2.0 * math.pi / angles
    return np.concatenate([np.cos(turn), np.sin(turn)]).astype(np.float32) / np.float32(angles)


_OUTLINE_WAVES = _waves(_ANGLES, _HARMONICS)
# Two samples a ring, averaged: an edge that crosses a ring moves the figure evenly.
_PAIRS = np.repeat(np.eye(_RINGS, dtype=np.float32), 2, axis=0) / np.float32(2.0 * 255.0)


def _strengths(waves: Floats32, harmonics: int) -> Floats32:
    """(n, harmonics * rings): how strong each harmonic is on each ring, of cosine and sine shares (n, 2 h, rings)."""
    even, odd = waves[:, :harmonics], waves[:, harmonics:]
    return np.sqrt(even * even + odd * odd).reshape(len(waves), -1)


def _scales(detections: Sequence[Detection], plane: PlaneMap | None) -> NDArray[np.float64]:
    """Millimetres of the plane a pixel spans at each detection, or ones."""
    if plane is None:
        return np.ones(len(detections))
    middles = np.array([item.center_px for item in detections])
    at = np.concatenate([middles, middles + (1.0, 0.0), middles + (0.0, 1.0)])
    here, right, down = np.split(plane.to_plane(at), 3)
    u, v = (right - here)[:, :2], (down - here)[:, :2]
    return np.asarray(np.sqrt(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])))


def _polar() -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Where the polar grid (ANGLES, 2 * RINGS) lies in the field, as OpenCV's `remap` is quickest on."""
    angle = np.arange(_ANGLES)[:, None] * (2.0 * math.pi / _ANGLES)
    radius = np.arange(2 * _RINGS) * (_REACH / (2 * _RINGS) * SIDE / WINDOW)
    middle = (FIELD - 1) / 2.0
    x, y = (middle + radius * np.cos(angle)).astype(np.float32), (middle + radius * np.sin(angle)).astype(np.float32)
    places, weights = cv2.convertMaps(x, y, cv2.CV_16SC2)
    return np.asarray(places, np.int16), np.asarray(weights, np.uint16)


_POLAR = _polar()


def _circles(forms: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(n, ANGLES, 2 * RINGS): how much of parts (n, FIELD, FIELD) lies at each place of a polar grid, 0 to 255."""
    out = np.empty((len(forms), _ANGLES, 2 * _RINGS), np.uint8)
    for form, grid in zip(forms, out, strict=True):
        cv2.remap(form, *_POLAR, cv2.INTER_LINEAR, dst=grid)
    return out


def _proportions(item: Detection) -> tuple[float, float]:
    """Logarithm of the aspect, and share of the hull that is filled."""
    hull = float(cv2.contourArea(cv2.convexHull(item.outline_px.astype(np.float32))))
    long, short = item.size_px
    return math.log(max(long, 1.0) / max(short, 1.0)), item.area_px / max(hull, 1.0)


def _print_waves() -> Floats32:
    """(SIDE * SIDE, 2 * PRINT_HARMONICS * PRINT_RINGS): a tile's pixels times this are the shares of the harmonics.

    Pixels are read between their middles on circles, up to where a square ends along its sides.
    """
    waves = _waves(_ANGLES // 2, _PRINT_HARMONICS)
    angle = np.arange(_ANGLES // 2) * 4.0 * math.pi / _ANGLES
    radius = (np.arange(_PRINT_RINGS) + 0.5) / _PRINT_RINGS * 0.5 * SIDE / WINDOW
    middle = (SIDE - 1) / 2.0
    out = np.zeros((SIDE, SIDE, len(waves), _PRINT_RINGS))
    x, y = middle + np.cos(angle)[:, None] * radius, middle + np.sin(angle)[:, None] * radius
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    u, v = y - i, x - j
    for di, dj, share in ((0, 0, (1 - u) * (1 - v)), (0, 1, (1 - u) * v), (1, 0, u * (1 - v)), (1, 1, u * v)):
        for ring in range(_PRINT_RINGS):
            np.add.at(out[:, :, :, ring], (i[:, ring] + di, j[:, ring] + dj), (waves * share[:, ring]).T)
    return out.reshape(SIDE * SIDE, -1).astype(np.float32)


_PRINT_WAVES = _print_waves()
_BRIGHTNESS = np.array([0.114, 0.587, 0.299], np.float32)
"""Weights of blue, green and red."""


def _print(surface: Tiles) -> Floats32:
    """(n, PRINT_RINGS * PRINT_HARMONICS): strengths of the harmonics of brightness along circles on the part.

    Brightness is relative to the part's mean, and counts only on its material: light and edges leave it alone.
    """
    count = len(surface.which)
    inside = surface.material.reshape(count, -1).astype(np.float32)
    values = (_BRIGHTNESS @ surface.planes.reshape(3, -1).astype(np.float32)).reshape(count, -1)
    mean = np.einsum("ni,ni->n", values, inside) / np.maximum(inside.sum(axis=1), 1.0)
    relative = (values / np.maximum(mean, 8.0)[:, None] - 1.0) * inside
    waves = (relative @ _PRINT_WAVES).reshape(count, -1, _PRINT_RINGS)
    return _strengths(waves, _PRINT_HARMONICS)

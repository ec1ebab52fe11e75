"""Twelve names for colours, each a handful of places in OKLab: the nearest place gives the name.

The places are colours of everyday plastic, paper and paint, given as sRGB; they are listed here because they are
the definition: whoever wants the border between orange and brown elsewhere moves a place. Lightness counts less
than hue and chroma, because light falls unevenly on parts and paints do not change with it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from controller.vision.appearance.oklab import oklab_of

PALETTE: Mapping[str, tuple[str, ...]] = {
    "red": ("c41e23", "961419", "e63c32", "6e0a0f", "dc4b41", "f0745f", "ff0000"),
    "orange": ("eb7814", "fa9632", "d75f19", "ff6a00", "ff4000", "eba57d"),
    "yellow": ("f0cd28", "d2b41e", "fae66e", "ffc846", "ffff00"),
    "green": ("329646", "1e6428", "5ac85a", "8cc83c", "00e646", "1e6e5f", "6b7a2c", "a8d8a0", "1f4e50"),
    "cyan": ("00bec8", "46d2dc", "1496a5", "8ce1e6", "00ffff"),
    "blue": ("1e46be", "2868be", "141e6e", "3c8ceb", "78aae6", "0000ff", "0a2a50", "4682b4"),
    "purple": ("783296", "551e6e", "a05abe", "7a3a92", "b496d7", "6a3ab0"),
    "pink": ("f082aa", "fab4c8", "e65096", "e16e8c", "f5a0c8", "b42864"),
    "brown": ("6e4123", "8c5a32", "4b2d19", "643220", "7a3c1e", "96693f", "32161a"),
    "black": ("101010", "262628", "1c1c20", "3a3a3a"),
    "gray": ("5a5a5a", "6e6e6e", "8c8c8c", "aaaaaa", "c0c0c0"),
    "white": ("e4e4e4", "f5f5f5", "ffffff"),
}

NAMES: tuple[str, ...] = tuple(PALETTE)
_LIGHTNESS = 0.6
"""Weight of a step in lightness against the same step in a or b."""
_SCALE = np.array([_LIGHTNESS, 1.0, 1.0], np.float32)


def _places() -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    codes = [(k, bytes.fromhex(code)[::-1]) for k, name in enumerate(NAMES) for code in PALETTE[name]]
    bgr = np.array([list(code) for _, code in codes], np.uint8)
    return oklab_of(bgr) * _SCALE, np.array([k for k, _ in codes])


_PLACES, _OWNERS = _places()


def nearest(lab: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Index into NAMES and distance (1 = black to white, lightness weighed less) of each of (N, 3) OKLab colours."""
    step = (lab * _SCALE)[:, None] - _PLACES
    squared = np.einsum("nkc,nkc->nk", step, step)
    best = squared.argmin(axis=1)
    return _OWNERS[best], np.asarray(np.sqrt(squared[np.arange(len(lab)), best]), np.float32)


def name_of(lab: NDArray[np.float32]) -> tuple[str, float]:
    """Name of one OKLab colour (3,), and its distance from the nearest place of that name."""
    index, distance = nearest(lab[None])
    return NAMES[int(index[0])], float(distance[0])

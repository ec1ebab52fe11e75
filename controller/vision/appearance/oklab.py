"""Colours as people see them: linear light and the OKLab space, in which equal steps look about equal.

OKLab keeps hues straight where CIE Lab bends blue into purple. Lightness is 0 (black) to 1 (white); a and b
span about +-0.3, so hue needs no wrap-around: distances are taken between points, not between angles.

Source: B. Ottosson, "A perceptual color space for image processing", 2020; IEC 61966-2-1 (sRGB).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]

_CODES = np.arange(256) / 255.0
LINEAR: Floats32 = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""Linear light of each 8-bit sRGB code."""

_CONES = np.array(
    [
        [0.0514459929, 0.5363325363, 0.4122214708],
        [0.1073969566, 0.6806995451, 0.2119034982],
        [0.6299787005, 0.2817188376, 0.0883024619],
    ],
    np.float32,
).T.copy()
_OPPONENTS = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ],
    np.float32,
).T.copy()
LUMINANCE: Floats32 = np.array([0.0722, 0.7152, 0.2126], np.float32)
"""Weights of linear B, G, R."""


def linear(codes: NDArray[np.uint8]) -> Floats32:
    """Linear light of 8-bit codes, same shape."""
    return LINEAR[codes]


def oklab(light: Floats32) -> Floats32:
    """(..., 3) L, a, b of linear BGR light (..., 3); light below zero counts as none."""
    return np.asarray(np.cbrt(np.maximum(light @ _CONES, 0.0)) @ _OPPONENTS, np.float32)


def oklab_of(codes: NDArray[np.uint8]) -> Floats32:
    """(..., 3) L, a, b of BGR codes (..., 3)."""
    return oklab(linear(codes))

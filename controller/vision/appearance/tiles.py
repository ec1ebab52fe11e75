"""Parts brought to one size, so that everything about their surface is computed for all of them at once.

A tile shows the part's middle, `WINDOW` times the root of its area wide, on `SIDE` x `SIDE` pixels, unturned.
Whatever is said of a tile has to be invariant to rotation; scale is relative to the part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.appearance.patch import Patch

SIDE = 32
WINDOW = 1.3
"""A square's half diagonal lies 0.71, a circle's radius 0.56 roots of its area from the middle."""


@dataclass(frozen=True, slots=True, eq=False)
class Tiles:
    """The surfaces of N parts.

    Attributes:
        image: ndarray of shape (N, SIDE, SIDE, 3), dtype uint8, BGR.
        solid: ndarray of shape (N, SIDE, SIDE), dtype uint8: 255 where the part is.
        material: ndarray of shape (N, SIDE, SIDE), dtype uint8: 255 where its material is seen, away from edges.
    """

    image: NDArray[np.uint8]
    solid: NDArray[np.uint8]
    material: NDArray[np.uint8]


def tiles(patches: Sequence[Patch]) -> Tiles:
    """The tiles of some patches."""
    image = np.empty((len(patches), SIDE, SIDE, 3), np.uint8)
    masks = np.empty((2, len(patches), SIDE, SIDE), np.uint8)
    for k, patch in enumerate(patches):
        scale = SIDE / (WINDOW * max(patch.detection.area_px, 1.0) ** 0.5)
        shown, solid, material = patch.image, patch.solid, patch.material
        reduce = int(1.0 / scale)
        x, y = (c - o for c, o in zip(patch.detection.center_px, patch.corner, strict=True))
        if reduce > 1:
            # Averaged first: a warp that skips pixels would fold fine textures into coarse ones.
            size = (max(1, shown.shape[1] // reduce), max(1, shown.shape[0] // reduce))
            x = (x + 0.5) * size[0] / shown.shape[1] - 0.5
            y = (y + 0.5) * size[1] / shown.shape[0] - 0.5
            scale *= shown.shape[1] / size[0]
            shown, solid, material = (
                np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.uint8)
                for part in (shown, solid, material)
            )
        middle = (SIDE - 1) / 2.0
        matrix = np.array([[scale, 0.0, middle - scale * x], [0.0, scale, middle - scale * y]])
        cv2.warpAffine(shown, matrix, (SIDE, SIDE), dst=image[k], borderMode=cv2.BORDER_REPLICATE)
        cv2.warpAffine(solid, matrix, (SIDE, SIDE), dst=masks[0, k])
        cv2.warpAffine(material, matrix, (SIDE, SIDE), dst=masks[1, k])
    return Tiles(image, masks[0], masks[1])

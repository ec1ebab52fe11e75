"""Shadows that fall in from beyond the picture: an arm's, a hand's, a lamp stand's.

A shadow is the table's colour, only darker, and so may a gray part be; a shadow has soft edges, and so has a part out
of focus. Both at once, and going on to the picture's border, is no part anybody could pick.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.contours import above
from controller.vision.robust import median
from controller.vision.scene import Scene, outside
from controller.vision.selection import shaded

Floats = NDArray[np.float64]

_NEAR, _FAR = 1.5, 6.0
"""How far to either side of an outline it is looked at, px of the searched image."""
_SOFT = 0.52
"""Share of a step that lies within the nearer distance: of an edge in focus 0.75, of a camera's blurred one 0.55."""
_POINTS = 48
_LEAST = 8
"""Points of an outline that must lie well within the picture to tell."""
_WIDE = 5
"""Pixels of the picture's rim that a shadow covers at least where it falls in."""


def fallen_in(scene: Scene, outlines: Sequence[Floats]) -> list[bool]:
    """Which of some outlines (N, 2), px, are those of shadows, or of parts of one, that reach the picture's border."""
    soft = soft_shades(scene, outlines)
    return [shade and _reaches_border(scene, outline) for shade, outline in zip(soft, outlines, strict=True)]


def soft_shades(scene: Scene, outlines: Sequence[Floats]) -> list[bool]:
    """Which of some outlines (N, 2), px, hold the table's colour, only darker, and have an edge that is mostly soft.

    Within a shadow it may be darker on one side and lighter on another.
    """
    if not outlines:
        return []
    points = outside(outlines, scene.factor * np.array([-_FAR, -_NEAR, _NEAR, _FAR]), _POINTS)
    limit = np.array(scene.image.shape[1::-1]) - 1.0
    within = np.asarray(((points >= 0.0) & (points <= limit)).all(axis=(0, 3)))
    deep, inner, outer, beyond = scene.differences(points)
    shade = shaded(scene, deep.reshape(-1, 3)).reshape(within.shape) & within
    # Steps of a shade lie along the table's colour; along that noise counts least.
    table = scene.white.whitener @ scene.white.table_colour
    near, far = (np.abs(step @ table) for step in (inner - outer, deep - beyond))
    out = []
    for k, use in enumerate(within):
        dark = use.sum() >= _LEAST and shade[k].sum() >= 0.5 * use.sum()
        out.append(bool(dark and median(near[k, use], 0) < _SOFT * median(far[k, use], 0)))
    return out


def _reaches_border(scene: Scene, outline: Floats) -> bool:
    """Whether what stands out of the table within an outline goes on to the picture's border."""
    mask = above(scene.white.strength, scene.settings.level)
    _, labels = cv2.connectedComponents(mask, connectivity=4)
    small = np.rint((outline - (scene.factor - 1) / 2.0) / scene.factor).astype(np.int32)
    own = cv2.fillPoly(np.zeros(mask.shape, np.uint8), [small], (1,))
    counts = np.bincount(labels[(own > 0) & (mask > 0)], minlength=2)
    most = int(counts[1:].argmax()) + 1
    rim = (labels[1], labels[-2], labels[:, 1], labels[:, -2])
    return max(int(np.count_nonzero(side == most)) for side in rim) >= _WIDE

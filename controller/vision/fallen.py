"""Shadows that fall in from beyond the picture: an arm's, a hand's, a lamp stand's.

A shadow is the table's colour, only darker, and so may a gray part be; a shadow has soft edges, and so has a part out
of focus. Both at once, and going on to the picture's border, is no part anybody could pick.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.proposals import above
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


def fallen_in(scene: Scene, outline: Floats) -> bool:
    """Whether an outline (N, 2), px, is that of a shadow, or a part of one, that goes on to the picture's border."""
    return soft_shade(scene, outline) and _reaches_border(scene, outline)


def soft_shade(scene: Scene, outline: Floats) -> bool:
    """Whether an outline (N, 2), px, holds the table's colour, only darker, and most of its edge is soft.

    Within a shadow it may be darker on one side and lighter on another.
    """
    distances = scene.factor * np.array([-_FAR, -_NEAR, _NEAR, _FAR])
    points = np.stack([outside(outline, distance, _POINTS) for distance in distances])
    limit = np.array(scene.image.shape[1::-1]) - 1.0
    within = ((points >= 0.0) & (points <= limit)).all(axis=(0, 2))
    if within.sum() < _LEAST:
        return False
    deep, inner, outer, beyond = scene.differences(points[:, within])
    if shaded(scene, deep).mean() < 0.5:
        return False
    # Steps of a shade lie along the table's colour; along that noise counts least.
    table = scene.white.whitener @ scene.white.table_colour
    near, far = (float(np.median(np.abs(step @ table))) for step in (inner - outer, deep - beyond))
    return near < _SOFT * far


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

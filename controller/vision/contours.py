"""Contours of what stands out of the table, and which of them show something new."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
Mask = NDArray[np.uint8]
Contour = MatLike
Boxes = NDArray[np.int32]
Unknown = Callable[[Boxes], NDArray[np.bool_]]
"""Of boxes (N, 4), x, y, width and height, which (N,) show nothing known already."""

SHORT = 8
"""Contours of fewer pixels hold nothing that a shape could be fitted to."""


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """What stands out of the table by its level.

    Attributes:
        mask: ndarray of shape (H, W), dtype uint8: 255 there, 0 elsewhere.
        contours: Its outer contours.
    """

    mask: Mask
    contours: Sequence[Contour]


def standing(strength: Floats32, level: float) -> Standing:
    """What stands out of a picture of strengths (H, W) above a level."""
    mask = above(strength, level)
    return Standing(mask, outer(mask))


def above(image: Floats32, level: float) -> Mask:
    """255 where an image exceeds a level, else 0."""
    return np.asarray(cv2.threshold(image, level, 255.0, cv2.THRESH_BINARY)[1], np.uint8)


def outer(mask: Mask) -> Sequence[Contour]:
    """Outer contours of a mask, pixel by pixel."""
    return cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]


def large(contours: Sequence[Contour], smallest: float) -> list[Contour]:
    """Those contours that hold an area that large."""
    return [contour for contour in contours if len(contour) >= SHORT and filled(contour) >= smallest]


def unseen(contours: Sequence[Contour], unknown: Unknown) -> list[Contour]:
    """Those contours that show nothing known already."""
    if not contours:
        return []
    boxes = np.array([cv2.boundingRect(contour) for contour in contours], np.int32)
    return [contour for contour, new in zip(contours, unknown(boxes).tolist(), strict=True) if new]


def nothing_known(boxes: Boxes) -> NDArray[np.bool_]:
    """Nothing is known."""
    return np.ones(len(boxes), bool)


def filled(contour: Contour) -> float:
    """Area of what a contour holds, its own pixels included: the polygon through their centres misses half of them."""
    return float(cv2.contourArea(contour)) + 0.5 * len(contour) + 1.0

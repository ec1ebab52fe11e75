"""What no outline explains though it stands out as clearly as they do: a part on its side upon others has no outline
that any family fits, but arms must not run into it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from controller.vision.scene import Found

SCORE = 0.25
"""Of what has no outline of its own: too little to be picked."""

_AS_STRONG = 0.75
"""Share of the fainter known objects' difference from the table that a leftover has at least: a shadow has less."""

_FAINTER = 0.25
"""The share of known objects that are fainter: dyes differ, and what the faintest is taken for may be a shadow."""

_COLOURED = 0.5
"""The same share for what has a colour that no shadow of the table has: a faint dye, but no shine of a part beside."""

_BLUR = 2.0
"""Beyond an outline by this much, px of the searched image, its object may still show."""


def leftovers(
    strength: NDArray[np.float32],
    found: Sequence[Found],
    plain: Sequence[Found],
    factor: int,
    region: NDArray[np.uint8] | None,
    narrow: float,
    shadow: Callable[[NDArray[np.bool_]], NDArray[np.bool_]],
) -> list[Found]:
    """Patches beside the known objects that differ from the table as they do, as objects of no known shape.

    Args:
        strength: ndarray of shape (H, W) of the searched image: how far the picture differs from the table.
        found: The known objects.
        plain: Those of them that are certainly no shadow, which tell how clearly an object stands out.
        factor: How many times smaller the searched image is.
        region: ndarray of shape (H, W), dtype uint8: only where it is not 0; everywhere when None.
        narrow: Width of the narrowest patch that counts, px of the searched image.
        shadow: Of the N pixels set in a mask (H, W), which have the table's colour, only darker, (N,).
    """
    if not plain:
        return []
    covered = np.zeros(strength.shape, np.uint8)
    for item in found:
        cv2.fillPoly(covered, [_reduced(item.outline, factor)], (255,))
    clear = [_clearness(strength, _reduced(item.face, factor)) for item in plain]
    typical = float(np.quantile(clear, _FAINTER, method="lower"))
    free = (strength > _COLOURED * typical) & (cv2.dilate(covered, _disc(_BLUR)) == 0)
    if region is not None:
        free &= region > 0
    rest = np.zeros(strength.shape, np.uint8)
    rest[free] = np.where((strength[free] > _AS_STRONG * typical) | ~shadow(free), 255, 0)
    rest = np.asarray(cv2.morphologyEx(rest, cv2.MORPH_OPEN, _disc(narrow / 2.0)), np.uint8)
    contours, _ = cv2.findContours(rest, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    out = []
    for contour in contours:
        hull = cv2.convexHull(contour)[:, 0].astype(np.float64)
        outline = hull * factor + (factor - 1) / 2.0
        center = outline.mean(axis=0)
        out.append(Found(Shape.OTHER, SCORE, outline, outline, center, None, frozenset({"touching"})))
    return out


def _clearness(strength: NDArray[np.float32], face: NDArray[np.int32]) -> float:
    """Median difference from the table inside a face; infinite outside the picture."""
    x, y, width, height = cv2.boundingRect(face)
    x, y = max(x, 0), max(y, 0)
    patch = strength[y : y + height, x : x + width]
    mask = np.zeros(patch.shape, np.uint8)
    cv2.fillPoly(mask, [face - np.array([x, y], np.int32)], (255,))
    inside = patch[mask > 0]
    return float(np.median(inside)) if len(inside) else np.inf


def _reduced(outline: NDArray[np.float64], factor: int) -> NDArray[np.int32]:
    return np.rint((outline - (factor - 1) / 2.0) / factor).astype(np.int32)


def _disc(radius: float) -> NDArray[np.uint8]:
    size = 2 * round(radius) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)

"""The certificate's picture: where over the table a touch misses, by how much and which way."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration.certificate import MEAN_LIMIT, P95_LIMIT, PASSED, Certificate

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_SCALE = 2.0  # px a mm
_BORDER = 50
_PANEL = 370
_REACH = 30.0  # mm within which a place speaks for its neighbourhood
_MAGNIFIED = 20.0  # arrows against the table
_INK, _PALE = (60, 50, 40), (150, 145, 140)
_GOOD, _BAD = (80, 130, 30), (40, 40, 190)


def touch_map(found: Certificate, outline: Array, made_at: str) -> Image:
    """A heat map of the misses over the work area, (H, W, 3), dtype uint8, BGR.

    Drawn as one sees the table from behind the arm: x of `table` up, y to the left.

    Args:
        found: The certificate.
        outline: ndarray of shape (N, 2), the work area in `table`, mm.
        made_at: Date and time, for the caption.
    """
    low = np.minimum(outline.min(axis=0), found.places.min(axis=0))
    high = np.maximum(outline.max(axis=0), found.places.max(axis=0))
    width, height = (int(size * _SCALE) + 2 * _BORDER for size in (high[1] - low[1], high[0] - low[0]))
    height = max(height, 400)

    def at(points: Array) -> Array:
        return np.asarray(_BORDER + (high - points)[:, ::-1] * _SCALE)

    picture = np.full((height, width + _PANEL, 3), 255, np.uint8)
    inside = np.zeros((height, width), np.uint8)
    border = np.rint(at(outline)).astype(np.int32)
    cv2.fillPoly(inside, [border], (255.0,))
    sizes = np.linalg.norm(found.errors, axis=1)
    picture[:, :width][inside > 0] = _coloured(_field(at(found.places), sizes, (height, width)))[inside > 0]
    cv2.polylines(picture, [border], True, _PALE, 1, cv2.LINE_AA)
    starts = at(found.places)
    ends = at(found.places + found.errors * _MAGNIFIED)
    for start, end, size in zip(starts, ends, sizes, strict=True):
        a, b = ((round(p[0]), round(p[1])) for p in (start, end))
        cv2.arrowedLine(picture, a, b, _INK, 1, cv2.LINE_AA, tipLength=0.25)
        cv2.circle(picture, a, 3, _INK, -1, cv2.LINE_AA)
        beside = a[0] + 5, a[1] + 12
        cv2.putText(picture, f"{size:.1f}", beside, cv2.FONT_HERSHEY_SIMPLEX, 0.35, _INK, 1, cv2.LINE_AA)
    _caption(picture[:, width:], found, made_at)
    return picture


def _field(places: Array, sizes: Array, shape: tuple[int, int]) -> Array:
    """Misses (H, W) between the places: their mean, weighted by nearness."""
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]]
    total, weights = np.zeros(shape), np.full(shape, 1e-9)
    for (x, y), size in zip(places, sizes, strict=True):
        weight = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * (_REACH * _SCALE) ** 2))
        total += weight * size
        weights += weight
    return np.asarray(total / weights)


def _coloured(field: Array) -> Image:
    """Dark for a hit, bright for a miss by the limit of the 95th percentile; light enough to write on."""
    share = np.clip(field / P95_LIMIT, 0.0, 1.0)
    colours = cv2.applyColorMap(np.asarray(255 * share, np.uint8), cv2.COLORMAP_VIRIDIS)
    return np.asarray(0.55 * np.asarray(colours, np.float64) + 0.45 * 255, np.uint8)


def _caption(panel: Image, found: Certificate, made_at: str) -> None:
    """Verdict, figures and scale."""
    passed = found.verdict == PASSED
    cv2.putText(
        panel, found.verdict, (0, 50), cv2.FONT_HERSHEY_SIMPLEX, 1.1, _GOOD if passed else _BAD, 2, cv2.LINE_AA
    )
    touch, before = found.touch_mm, found.before_mm
    lines = [
        f"touch: mean {touch.mean:.2f} mm (limit {MEAN_LIMIT:g})",
        f"   p95 {touch.p95:.2f} mm (limit {P95_LIMIT:g})",
        f"   worst {touch.max:.2f} mm, {len(found.places)} places",
        f"   and {found.unseen_mm:.1f} mm that the marker cannot show",
        f"by ruler alone: mean {before.mean:.1f} mm",
        found.calibration_id,
        made_at,
        f"arrows: sent to seen, {_MAGNIFIED:g} times as long",
        "x of the table up, y to the left",
    ]
    for index, line in enumerate(lines):
        cv2.putText(panel, line, (0, 90 + 24 * index), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _INK, 1, cv2.LINE_AA)
    top = 90 + 24 * len(lines)
    bar = np.tile(np.linspace(0.0, P95_LIMIT, 200), (14, 1))
    panel[top : top + 14, :200] = _coloured(bar)
    for value, x in ((0.0, 0), (P95_LIMIT, 175)):
        cv2.putText(panel, f"{value:g} mm", (x, top + 30), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _INK, 1, cv2.LINE_AA)

"""The outlines of many parts moved, scaled and made ready for drawing in one go."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection

SHIFT = 4
"""Fraction bits of drawn points: a sixteenth of a pixel."""

Floats = NDArray[np.float64]


class Rings:
    """Outlines of detections.

    Args:
        detections: The parts.
    """

    def __init__(self, detections: Sequence[Detection]) -> None:
        counts = [len(item.outline_px) for item in detections]
        points = np.concatenate([item.outline_px for item in detections] or [np.empty((0, 2))])
        # (2, M): columns and rows.
        self._points = np.ascontiguousarray(points.T)
        self._counts = np.array(counts, np.intp)
        self._spans = list(pairwise(accumulate(counts, initial=0)))

    def drawn(
        self,
        origin: Floats,
        scale: Floats,
        *,
        within: tuple[int, int] | None = None,
        shift: int = SHIFT,
    ) -> list[NDArray[np.int32]]:
        """Points (n, 1, 2) of each outline for OpenCV's drawing, in units of 2**-shift px.

        Args:
            origin: ndarray of shape (N, 2): place of the frame that comes to (0, 0), px.
            scale: ndarray of shape (N,): pixels a pixel of the frame becomes.
            within: (width, height) of the frame: points beyond its border are put onto it.
            shift: Fraction bits.
        """
        points = self._points
        if within is not None:
            points = np.stack([np.clip(row, 0.0, most - 1.0) for row, most in zip(points, within, strict=True)])
        moved = points - np.repeat(origin.T, self._counts, axis=1)
        moved *= np.repeat(scale * 2.0**shift, self._counts)
        whole = np.rint(moved.T).astype(np.int32, order="C")[:, None]
        return [whole[a:b] for a, b in self._spans]

"""A part's outline from the curves of a drawing: closed loops, the outer one and the holes within it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.errors import InputError

Floats = NDArray[np.float64]

MOST_BYTES = 5_000_000
MOST_POINTS = 200_000
CHORD = 0.02
"""Arcs are cut into chords that stray from them by about this, mm."""
_JOIN = 0.05
"""Ends this near to one another belong together, mm."""
_SIZES = (2.0, 500.0)
"""Smallest and largest extent of a part, mm."""


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """What a drawing says of a part.

    Attributes:
        outer: ndarray of shape (N, 2), mm, not closed, about the middle of its bounding box, y up.
        holes: The same for each hole.
    """

    outer: Floats
    holes: tuple[Floats, ...]

    @property
    def area(self) -> float:
        """Area within the outer outline, holes filled, mm^2."""
        return area(self.outer)

    @property
    def size(self) -> tuple[float, float]:
        """(long, short) side of its minimum-area rectangle, mm."""
        _, (w, h), _ = cv2.minAreaRect(self.outer.astype(np.float32))
        return max(w, h), min(w, h)


def read_drawing(path: Path) -> Outline:
    """The outline in a DXF or SVG file.

    Raises:
        InputError: The file is missing, too large, damaged, of another kind, or shows no closed outline of a part.
    """
    from controller.vision.drawings.dxf import dxf_curves
    from controller.vision.drawings.svg import svg_curves

    readers = {".dxf": dxf_curves, ".svg": svg_curves}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path} is neither DXF nor SVG", "save the drawing as one of them")
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path} is larger than {MOST_BYTES // 1_000_000} MB", "export the part's outline alone")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror})", "name a file that can be read") from error
    try:
        curves = reader(data)
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise InputError(f"{path} is damaged: {error}", "export it anew") from error
    try:
        return outline_of(curves)
    except InputError as error:
        raise InputError(f"{path}: {error.cause}", error.remedy) from error


def outline_of(curves: Sequence[Floats]) -> Outline:
    """The one part that curves (N, 2), mm, draw.

    Raises:
        InputError: They do not close, or draw nothing, several parts, or one of an unlikely size.
    """
    kept = [curve for curve in curves if len(curve) >= 2]
    if not kept:
        raise InputError("there is no outline in it", "draw it with lines, arcs, circles, polylines or paths")
    if sum(len(curve) for curve in kept) > MOST_POINTS:
        raise InputError(f"more than {MOST_POINTS} points", "simplify the drawing")
    if not all(np.isfinite(curve).all() for curve in kept):
        raise InputError("a coordinate is no number", "export it anew")
    loops = _closed(kept)
    loops.sort(key=area, reverse=True)
    outer, rest = loops[0], loops[1:]
    ring = outer.astype(np.float32)
    for loop in rest:
        x, y = loop.mean(axis=0)
        if cv2.pointPolygonTest(ring, (float(x), float(y)), False) < 0.0:
            raise InputError("there is more than one outline", "leave one part in the drawing, without frame and text")
    extent = float(np.ptp(outer, axis=0).max())
    if not _SIZES[0] <= extent <= _SIZES[1]:
        raise InputError(
            f"the part is {extent:.3g} mm long", f"{_SIZES[0]:g} to {_SIZES[1]:g} mm are allowed; see to the units"
        )
    if area(outer) < 0.02 * extent**2:
        raise InputError("the outline encloses next to nothing", "close it")
    middle = (outer.min(axis=0) + outer.max(axis=0)) / 2.0
    return Outline(outer - middle, tuple(loop - middle for loop in rest))


def area(ring: Floats) -> float:
    """Area of a closed polygon (N, 2)."""
    x, y = ring.T
    return float(0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def arc(center: tuple[float, float], radius: float, start: float, sweep: float) -> Floats:
    """Points (N, 2) of an arc, rad."""
    steps = max(4, int(np.ceil(abs(sweep) / np.sqrt(8.0 * CHORD / max(radius, CHORD)))))
    t = start + sweep * np.linspace(0.0, 1.0, min(steps, 2000) + 1)
    return np.stack([center[0] + radius * np.cos(t), center[1] + radius * np.sin(t)], axis=1)


def _closed(curves: Sequence[Floats]) -> list[Floats]:
    """Closed loops (N, 2) that the curves form, joined end to end."""
    loops, open_ = [], []
    for curve in curves:
        if np.linalg.norm(curve[0] - curve[-1]) <= _JOIN and len(curve) > 3:
            loops.append(curve[:-1])
        else:
            open_.append(curve)
    while open_:
        chain = open_.pop()
        while np.linalg.norm(chain[0] - chain[-1]) > _JOIN:
            end = chain[-1]
            nearest = [(float(np.linalg.norm(c[e] - end)), k, e) for k, c in enumerate(open_) for e in (0, -1)]
            gap, k, e = min(nearest, default=(np.inf, -1, 0))
            if gap > _JOIN:
                at = f"({end[0]:.2f}, {end[1]:.2f}) mm"
                raise InputError(f"the outline is open at {at}", "close it, and leave out dimensions and text")
            piece = open_.pop(k)
            chain = np.concatenate([chain, (piece if e == 0 else piece[::-1])[1:]])
        if len(chain) > 3:
            loops.append(chain[:-1])
    if not loops:
        raise InputError("nothing in it is closed", "close the outline")
    return loops

"""Outlines of all families as equal rows of numbers: (cx, cy, three sizes, three turns), what a family lacks 0."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from controller.vision.shapes import CIRCLE, HEXAGON, RECTANGLE, TRIANGLE, Family, area

Floats = NDArray[np.float64]
Rows = NDArray[np.intp]

POLYGONS = (HEXAGON, RECTANGLE, TRIANGLE)
KINDS = (*POLYGONS, CIRCLE)
ROUND = KINDS.index(CIRCLE)
PARAMETERS = 8
OWN = [np.array([*range(2 + f.sizes), *range(5, 5 + f.turns)]) for f in KINDS]
"""Places of each family's own parameters among the padded ones."""
_NUMBER = {family: kind for kind, family in enumerate(KINDS)}
_RECTANGLE, _TRIANGLE = _NUMBER[RECTANGLE], _NUMBER[TRIANGLE]
_COVERED = np.array([{HEXAGON: 2.0 * math.sqrt(3.0), RECTANGLE: 4.0, CIRCLE: math.pi}.get(f, 0.0) for f in KINDS])
"""Areas over the product of the sizes."""


def padded(families: Sequence[Family], qs: Sequence[Floats]) -> tuple[Rows, Floats]:
    """Kinds (K,) of families, places in `KINDS`, and their parameters (K, PARAMETERS)."""
    kind = np.array([_NUMBER[family] for family in families], np.intp)
    out = np.zeros((len(kind), PARAMETERS))
    for row, k, q in zip(out, kind.tolist(), qs, strict=True):
        row[OWN[k]] = q
    return kind, out


def areas(kind: Rows, q: Floats) -> Floats:
    """Areas (K,) of outlines of kinds (K,) with parameters (K, PARAMETERS)."""
    out = _COVERED[kind] * q[:, 2] * np.where(kind == _RECTANGLE, q[:, 3], q[:, 2])
    rows = np.flatnonzero(kind == _TRIANGLE)
    if len(rows):
        out[rows] = area(TRIANGLE, q[rows])
    return np.asarray(out)

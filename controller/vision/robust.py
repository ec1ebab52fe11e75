"""Statistics that single outliers do not disturb, for short rows of numbers."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Kind = TypeVar("Kind", np.float32, np.float64)


def tukey(ratio: NDArray[Kind]) -> NDArray[Kind]:
    """Tukey's weight of non-negative ratios, 1 at 0, 0 from 1 on."""
    rest = 1.0 - np.minimum(ratio, 1.0) ** 2
    return np.asarray(rest * rest)


def median(values: NDArray[Kind], axis: int) -> NDArray[Kind]:
    """Median along an axis.

    NumPy's own looks for NaN and takes several times as long on short rows; so does finding two places of the order
    instead of all of it.
    """
    count = values.shape[axis]
    ordered = np.sort(values, axis=axis)
    return np.asarray((ordered.take((count - 1) // 2, axis=axis) + ordered.take(count // 2, axis=axis)) * 0.5)

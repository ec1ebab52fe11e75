"""The faint texture of the still scenery: a sheet as bright as the table shows by lacking the table's grain.

Noise has no grain, and from one picture the two cannot be told apart: only places whose grain came back in the first
pictures after the reference are looked for later.

Source: J. P. Lewis, "Fast normalized cross-correlation", Vision Interface 1995: a change of light leaves the
correlation of two windows as it is.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.float32]
Floats = NDArray[np.float64]

_SIDE = 24  # px of the reduced picture: some 50 independent values, noise correlates by 0.15 (one sigma)
_FILLED = 0.5  # share of a window that must be still
_LEARNT = 5  # pictures whose mean correlation noise reaches by 0.07 (one sigma)
# A window's mean correlation, six of those sigmas, and that of one picture, two sigmas of one: in simulated runs
# grain at a standard deviation of 0.4 levels comes back at 0.6 to 0.9.
_PROVEN, _SEEN = 0.4, 0.3
_LEAST = 0.25  # share of the windows that must be proven: fewer stand for bins or a corner, not for the scenery
_FINE = 3.0  # px of the reduced picture: light, vignetting and the soft rims of shadows are coarser


class Grain:
    """What there is of texture, window by window.

    Args:
        reference: ndarray of shape (H, W), dtype float32: the reduced reference.
        still: ndarray of shape (H, W), dtype bool: where nothing is supposed to change.
    """

    def __init__(self, reference: Gray, still: NDArray[np.bool_]) -> None:
        self._still = still
        count = self._sums(np.ones(still.shape))
        self._use = count > _FILLED * _SIDE**2
        self._count = count[self._use]
        self._fine = _fine(reference)
        self._mean = self._means(self._fine)
        self._variance = self._means(self._fine**2) - self._mean**2
        self._learnt: list[Floats] = []
        self._proven = np.zeros(len(self._count), bool)

    def correlations(self, picture: Gray) -> Floats:
        """How each window of a picture correlates with the reference's: ndarray of shape (K,).

        Args:
            picture: ndarray of shape (H, W), dtype float32: its points where the reference's are.
        """
        fine = _fine(picture)
        mean = self._means(fine)
        variance = self._means(fine**2) - mean**2
        both = self._means(self._fine * fine) - self._mean * mean
        return np.asarray(both / np.sqrt(np.maximum(self._variance * variance, 1e-12)), np.float64)

    def learn(self, correlations: Floats) -> None:
        """Take a sound picture's correlations to tell grain from noise; after the first few, nothing more."""
        if len(self._learnt) == _LEARNT:
            return
        self._learnt.append(correlations)
        if len(self._learnt) == _LEARNT:
            proven = np.mean(self._learnt, axis=0) > _PROVEN
            if proven.sum() > _LEAST * len(proven):
                self._proven = proven

    def kept(self, correlations: Floats) -> float:
        """The part of the proven windows that show their grain; 1 as long as there are none."""
        if not self._proven.any():
            return 1.0
        return float(np.mean(correlations[self._proven] > _SEEN))

    def _means(self, values: NDArray[np.floating]) -> Floats:
        return np.asarray(self._sums(values)[self._use] / self._count, np.float64)

    def _sums(self, values: NDArray[np.floating]) -> Floats:
        """Sums over the still points of every window."""
        rows, columns = (length // _SIDE for length in self._still.shape)
        inside = np.where(self._still, values, 0.0)[: rows * _SIDE, : columns * _SIDE]
        return np.asarray(inside.reshape(rows, _SIDE, columns, _SIDE).sum(axis=(1, 3)), np.float64)


def _fine(picture: Gray) -> Gray:
    """A picture without what changes over more than some pixels."""
    return np.asarray(picture - cv2.GaussianBlur(picture, (0, 0), _FINE), np.float32)

"""A name for a vector of figures: ridge regression onto the classes over all products of two figures.

Small enough to ship as a file of numbers, quick enough to be one matrix product a frame, and as good on textures
as a support vector machine with a Gaussian kernel.

Source: Hastie, Tibshirani and Friedman, "The Elements of Statistical Learning", 2nd ed., sections 3.4.1 and 4.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
_RIDGE = 3.0
"""Penalty: about as much as three samples' worth of doubt; between 1 and 10 the result does not change."""


@dataclass(frozen=True, slots=True, eq=False)
class Namer:
    """Names by regression.

    Attributes:
        names: The classes.
        mean, scale: ndarray of shape (D,): what the figures are standardised by.
        weights: ndarray of shape (1 + D + D (D + 1) / 2, K): one column a class.
    """

    names: tuple[str, ...]
    mean: Floats32
    scale: Floats32
    weights: Floats32

    def scores(self, values: Floats32) -> Floats32:
        """(N, K): about 1 for a class that it is, -1 for one that it is not."""
        return np.asarray(_products((values - self.mean) / self.scale) @ self.weights, np.float32)

    def save(self, path: Path) -> None:
        """Write it to an .npz file of plain arrays."""
        np.savez_compressed(
            path,
            names=np.array(self.names),
            mean=self.mean,
            scale=self.scale,
            weights=self.weights.astype(np.float16),
        )


def fit(values: Floats32, labels: Sequence[str], names: Sequence[str]) -> Namer:
    """The namer learnt from figures (N, D) and their labels."""
    mean, scale = values.mean(axis=0), values.std(axis=0) + np.float32(1e-6)
    terms = _products((values - mean) / scale).astype(np.float64)
    wanted = np.array([[1.0 if label == name else -1.0 for name in names] for label in labels])
    weights = np.linalg.solve(terms.T @ terms + _RIDGE * np.eye(terms.shape[1]), terms.T @ wanted)
    return Namer(tuple(names), mean, scale, weights.astype(np.float32))


def load(path: Path) -> Namer:
    """The namer in an .npz file."""
    with np.load(path, allow_pickle=False) as data:
        names = tuple(str(name) for name in data["names"])
        return Namer(names, data["mean"], data["scale"], data["weights"].astype(np.float32))


def _products(values: Floats32) -> Floats32:
    """One, the figures (clipped: a square of an outlier would outvote all others), and all products of two."""
    kept = np.clip(values, -4.0, 4.0)
    first, second = _pairs(kept.shape[1])
    ones = np.ones((len(kept), 1), np.float32)
    return np.concatenate([ones, kept, kept[:, first] * kept[:, second]], axis=1)


@cache
def _pairs(count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Both indices of all pairs of figures, a figure with itself included."""
    return np.triu_indices(count)

"""Which taught class a part belongs to, or none: the nearest view that was shown, if it is near enough.

A part may have several faces (a nut lying, a nut on its side), so a class is its views and not their mean. Every
figure is measured in units of how much it varies between views of one class, pooled over all classes, never less
than what noise and light do to it; the nearest views then speak. How near is near enough is taken from how far
the class's own views lie from one another. What lies beyond, or as near to a second class, stays unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.vision.classes.features import BLOCKS, LENGTH, block

Floats32 = NDArray[np.float32]

FLOORS = {"outline": 0.005, "form": 0.01, "size": 0.03, "colour": 0.02, "texture": 0.06, "print": 0.01}
"""Standard deviation that noise, light and pixels leave in a figure of each block however alike two views are."""
WEIGHTS = {"outline": 3.0, "form": 1.0, "size": 1.0, "colour": 1.5, "texture": 1.0, "print": 1.5}
"""How much a block counts: its mean square difference is multiplied by this."""
_SLACK = 2.0
"""A new view may lie this much further from the nearest taught one than they lie from one another."""
_NEAREST, _FURTHEST = 1.1, 4.0
"""Bounds of that distance: a few views may by chance lie close together, or hold a stray one."""
_CLEAR = 0.9
"""The runner-up must be further than the best by this ratio."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a part was taken for.

    Attributes:
        name: The class, or None: unknown.
        distance: To the nearest view, in units of the class's reach: below 1 is within.
        nearest: The class of the nearest view, known or not.
        score: 1 on a taught view, 0.5 at the border, 0 far away.
    """

    name: str | None
    distance: float
    nearest: str
    score: float


class Classifier:
    """The taught classes at work.

    Args:
        views: Feature vectors (n, LENGTH) of each class's views, by name.
    """

    def __init__(self, views: dict[str, Floats32]) -> None:
        self.names = tuple(views)
        self._owner = np.concatenate([np.full(len(v), k) for k, v in enumerate(views.values())] or [np.empty(0)])
        self._owner = self._owner.astype(np.intp)
        raw = np.concatenate(list(views.values()) or [np.empty((0, LENGTH), np.float32)])
        self._scale = _scale(list(views.values()))
        # What a view says nothing of counts neither for nor against.
        says = np.isfinite(raw)
        self._says = np.ascontiguousarray(says.T, np.float32)
        self._views = np.where(says, raw, np.float32(0.0)) * self._scale
        self._lengths = (self._views * self._views).sum(axis=1)
        self._starts = np.searchsorted(self._owner, np.arange(len(self.names)))
        self.reach = np.array([self._reach(k) for k in range(len(self.names))])

    def verdicts(self, values: Floats32) -> list[Verdict | None]:
        """A verdict for each feature vector (m, LENGTH); None when nothing was taught."""
        if not self.names or not len(values):
            return [None] * len(values)
        return list(self._decided(self._to_classes(values * self._scale, None)))

    def _decided(self, near: NDArray[np.float64]) -> list[Verdict]:
        """What distances (m, classes) to the nearest view of each class say."""
        at = np.arange(len(near))
        best = near.argmin(axis=1)
        first = near[at, best]
        distance = first / self.reach[best]
        others = near.copy()
        others[at, best] = np.inf
        known = (distance <= 1.0) & (first < _CLEAR * others.min(axis=1))
        score = 0.5 ** (distance**2)
        rows = zip(best.tolist(), distance.tolist(), known.tolist(), score.tolist(), strict=True)
        return [Verdict(self.names[k] if sure else None, far, self.names[k], rated) for k, far, sure, rated in rows]

    def left_out(self) -> list[tuple[str, Verdict]]:
        """For every view its class, and the verdict on it by all views but itself (cross-validation, one out)."""
        near = self._to_classes(self._views, np.arange(len(self._views)))
        return [(self.names[k], verdict) for k, verdict in zip(self._owner, self._decided(near), strict=True)]

    def twins(self) -> dict[str, frozenset[str]]:
        """For each class the others that differ from it by nothing but what is on its surface."""
        form = np.ones(LENGTH, bool)
        for name in ("texture", "print"):
            form[block(name)] = False
        views = self._views[:, form]
        apart = np.linalg.norm(views[:, None] - views[None], axis=2)
        found: dict[str, frozenset[str]] = {}
        for k, name in enumerate(self.names):
            near = {
                other
                for j, other in enumerate(self.names)
                if j != k
                and apart[np.ix_(self._owner == k, self._owner == j)].min() <= max(self.reach[k], self.reach[j])
            }
            found[name] = frozenset(near)
        return found

    def _to_classes(self, scaled: Floats32, own: NDArray[np.intp] | None) -> NDArray[np.float64]:
        """(m, classes): distance to the nearest view of each class; `own` are rows to leave out."""
        squared = (scaled * scaled) @ self._says + self._lengths
        squared -= (scaled * np.float32(2.0)) @ self._views.T
        if own is not None:
            squared[np.arange(len(own)), own] = np.inf
        # Views of one class follow one another.
        nearest = np.minimum.reduceat(squared, self._starts, axis=1)
        return np.sqrt(np.maximum(nearest, 0.0)).astype(np.float64)

    def _reach(self, k: int) -> float:
        """How far from the nearest view of a class its parts may lie."""
        own = self._views[self._owner == k]
        if len(own) < 2:
            return _NEAREST
        apart = np.linalg.norm(own[:, None] - own[None], axis=2) + np.where(np.eye(len(own)) > 0, np.inf, 0.0)
        return float(np.clip(_SLACK * np.sort(apart.min(axis=1))[int(0.8 * (len(own) - 1))], _NEAREST, _FURTHEST))


def _scale(classes: Sequence[Floats32]) -> Floats32:
    """(LENGTH,) factors that turn a difference of figures into a share of the distance."""
    scale = np.empty(LENGTH, np.float32)
    pooled = np.zeros(LENGTH)
    rest = [views - np.median(views, axis=0) for views in classes if len(views) > 1]
    if rest:
        squares = np.concatenate(rest) ** 2
        count = np.isfinite(squares).sum(axis=0)
        pooled = np.sqrt(np.nansum(squares, axis=0) / np.maximum(count, 1))
    for name, length in BLOCKS.items():
        at = block(name)
        spread = np.sqrt(pooled[at] ** 2 + FLOORS[name] ** 2)
        scale[at] = np.sqrt(WEIGHTS[name] / length / sum(WEIGHTS.values())) / spread
    return scale


def scaled_by_noise(views: Floats32) -> Floats32:
    """Views (n, LENGTH) in units in which noise and light alone make distances of about 1 to 4."""
    return np.asarray(np.nan_to_num(views) * _scale([]), np.float32)

"""A frame while its outlines are judged: what is known, what was fitted, what was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from controller.geometry import PlaneMap
from controller.vision.background import Whitened
from controller.vision.fitting import Hypothesis
from controller.vision.local_map import LocalMaps
from controller.vision.profiles import CHUNKS
from controller.vision.proposals import Region
from controller.vision.recipe import Precise
from controller.vision.refine import Refined

Floats = NDArray[np.float64]

CLOSE = 0.35
"""Badness up to which an outline fits so well that no other explanation is needed for what it leaves open."""
_PALE = 1.5 / CHUNKS
"""Share of an outline that must be faint for it not to be seen completely: more than one chunk."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """One judged outline, in pixels of the frame.

    Attributes:
        shape: Verdict.
        score: Confidence in [0, 1].
        face: ndarray of shape (N, 2), px: the fitted shape's corners (a circle sampled): an object's top face.
        outline: ndarray of shape (M, 2), px: the outer outline; the face's, unless side faces show as well.
        center: (2,), px: the outline's centroid.
        diameter: A circle's diameter, px; None for anything else.
        flags: As for `Detection`.
    """

    shape: Shape
    score: float
    face: Floats
    outline: Floats
    center: Floats
    diameter: float | None
    flags: frozenset[str]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """All that is known about a frame when its outlines are judged.

    Attributes:
        image: ndarray of shape (H, W, 3), dtype uint8.
        noise: Covariance of its pixel noise, (3, 3).
        white: The searched image's difference from the table.
        factor: How many times smaller that is.
        maps: Local coordinates of every region.
        regions: The regions.
        plane: The plane shapes are decided in, or None.
        settings: The recipe's.
    """

    image: NDArray[np.uint8]
    noise: Floats
    white: Whitened
    factor: int
    maps: LocalMaps
    regions: Sequence[Region]
    plane: PlaneMap | None
    settings: Precise

    @property
    def sides(self) -> bool:
        """Whether side faces may show: shapes are decided on a plane above the table."""
        return self.plane is not None and self.plane.height > 0.0

    def with_regions(self, regions: Sequence[Region], maps: LocalMaps) -> Scene:
        """The same frame with other regions and their local coordinates."""
        return replace(self, regions=regions, maps=maps)

    def strengths(self, outline: Floats, *shares: float) -> Floats:
        """Whitened difference from the table at outlines' points shrunk to each share about their middle.

        Args:
            outline: ndarray of shape (..., N, 2), px.
            shares: S of them.

        Returns:
            ndarray of shape (..., S * N, 3): those of the first share first.
        """
        middle = outline.mean(axis=-2, keepdims=True)
        shrunk = middle[..., None, :, :] + np.array(shares)[:, None, None] * (outline - middle)[..., None, :, :]
        return self.differences(shrunk.reshape(*outline.shape[:-2], -1, 2))

    def differences(self, points: Floats) -> Floats:
        """Whitened difference from the table (..., 3) at points (..., 2), px."""
        places = np.rint((points - (self.factor - 1) / 2.0) / self.factor).astype(np.intp)
        rows, columns = self.white.difference.shape[:2]
        x = np.minimum(np.maximum(places[..., 0], 0), columns - 1)
        y = np.minimum(np.maximum(places[..., 1], 0), rows - 1)
        return np.asarray(self.white.difference.reshape(-1, 3).take(y * columns + x, axis=0), np.float64)

    def strength(self, points: Floats) -> Floats:
        """Length (N,) of the whitened difference from the table at points (N, 2), px."""
        difference = self.differences(points)
        return np.asarray(np.sqrt(np.vecdot(difference, difference)))


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A refined outline.

    Attributes:
        hypothesis: What it was refined from.
        refined: What the pixels say.
        badness: Its misfit over what is allowed.
        outline: ndarray of shape (N, 2), px.
        rim: ndarray of shape (32, 2), px: points at equal distances along it.
        area: In local units.
        box: Its least x and y and greatest x and y, px.
    """

    hypothesis: Hypothesis
    refined: Refined
    badness: float
    outline: Floats
    rim: Floats
    area: float
    box: list[float]


def whole(item: Judged) -> bool:
    """Whether an outline is seen so completely and fits so well that it is no piece of something larger."""
    return item.badness < 0.3 and item.refined.visible > 0.95 and item.refined.faint < _PALE


def sampled(outline: Floats, count: int = 32) -> Floats:
    """`count` points at equal distances along a closed outline."""
    return np.asarray(all_sampled([outline], count)[0])


def all_sampled(outlines: Sequence[Floats], count: int = 32) -> Floats:
    """`count` points (K, count, 2) at equal distances along each of K closed outlines."""
    if not outlines:
        return np.empty((0, count, 2))
    number = np.array([len(outline) for outline in outlines])
    last = np.cumsum(number) - 1
    first = last + 1 - number
    points = np.concatenate(outlines)
    after = np.arange(1, len(points) + 1)
    after[last] = first
    side = points[after] - points
    length = np.maximum(np.hypot(side[:, 0], side[:, 1]), 1e-9)
    ends = np.cumsum(length)
    begin = ends[first] - length[first]
    at = begin[:, None] + (np.arange(count) + 0.5) / count * (ends[last] - begin)[:, None]
    which = np.searchsorted(ends, at).clip(first[:, None], last[:, None])
    share = (at - ends[which] + length[which]) / length[which]
    return np.asarray(points[which] + side[which] * share[..., None])


def boxes(outlines: Sequence[Floats]) -> Floats:
    """Least x and y and greatest x and y (K, 4) of K outlines."""
    if not outlines:
        return np.empty((0, 4))
    points = np.concatenate(outlines)
    first = np.cumsum([0, *(len(outline) for outline in outlines[:-1])])
    return np.concatenate([np.minimum.reduceat(points, first), np.maximum.reduceat(points, first)], axis=1)


def outside(outlines: Sequence[Floats], distances: Sequence[float] | Floats, count: int = 32) -> Floats:
    """`count` points (D, K, count, 2) at each of D distances, px, outside each of K closed convex outlines."""
    points = all_sampled(outlines, count)
    along = np.roll(points, -1, axis=1) - np.roll(points, 1, axis=1)
    normal = np.stack([along[..., 1], -along[..., 0]], axis=2)
    normal /= np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-9)[..., None]
    outwards = np.vecdot(points - points.mean(axis=1, keepdims=True), normal).sum(axis=1)
    normal *= np.where(outwards < 0.0, -1.0, 1.0)[:, None, None]
    return np.asarray(points + np.asarray(distances)[:, None, None, None] * normal)


def neighbours(boxes: Floats) -> list[list[int]]:
    """Of each of some boxes (K, 4), least x and y and greatest x and y, which others it meets."""
    x0, y0, x1, y1 = boxes.T
    meet = (x0[:, None] <= x1) & (y0[:, None] <= y1)
    meet &= meet.T
    out: list[list[int]] = [[] for _ in boxes]
    for i, j in np.argwhere(meet).tolist():
        if i != j:
            out[i].append(j)
    return out


def shared(a: Judged, b: Judged) -> float:
    """`overlap` of two outlines, after a look at their boxes."""
    (ax0, ay0, ax1, ay1), (bx0, by0, bx1, by1) = a.box, b.box
    if ax1 < bx0 or bx1 < ax0 or ay1 < by0 or by1 < ay0:
        return 0.0
    return overlap(a.outline, b.outline)


def overlap(a: Floats, b: Floats) -> float:
    """Area shared by two convex outlines over the smaller one's."""
    pa, pb = a.astype(np.float32), b.astype(np.float32)
    areas = abs(cv2.contourArea(pa)), abs(cv2.contourArea(pb))
    common, _ = cv2.intersectConvexConvex(pa, pb)
    if common < 0.02 * min(areas):
        # OpenCV finds nothing in common between outlines that nearly coincide; points of the smaller one tell.
        small, large = (pa, pb) if areas[0] <= areas[1] else (pb, pa)
        middle = small.mean(axis=0)
        if cv2.pointPolygonTest(large, (float(middle[0]), float(middle[1])), False) <= 0.0:
            return 0.0
        inner = np.concatenate([middle + share * (small - middle) for share in (0.3, 0.6, 0.9)])
        inside = [cv2.pointPolygonTest(large, (float(x), float(y)), False) > 0.0 for x, y in inner]
        return float(np.mean(inside)) if np.mean(inside) > 0.1 else 0.0
    return float(common) / max(1.0, min(areas))

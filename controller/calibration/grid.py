"""Corners of a chessboard that overfills the view, indexed from whatever part is seen.

Corners are saddle points of the smoothed picture. From one of them the grid grows along its own two edge
directions, one step at a time; a step is taken only where a corner lies at the expected place and the edge
towards it has black and white on the expected sides.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Cell = tuple[int, int]

#: Smoothing before saddles are sought, px; squares below about 10 px are not resolved.
_SMOOTHING = 2.0
#: Saddles this much weaker than the strong ones of the picture are texture.
_WEAKEST = 0.1
#: How far into the squares around a saddle is looked, px.
_LOOK = 6.0
#: Distance of two saddles, px.
_APART = 9
#: A neighbour lies within this share of a step from where the last step points.
_SLACK = 0.25
#: Seeds that are tried, nearest to the picture's middle first.
_SEEDS = 12
_STEPS: tuple[Cell, ...] = ((1, 0), (0, 1), (-1, 0), (0, -1))


@dataclass(frozen=True, slots=True, eq=False)
class _Saddles:
    """Saddle points of a picture: `points` (N, 2), px, and their edge directions `first`, `second` (N, 2)."""

    smooth: NDArray[np.float32]
    points: Array
    first: Array
    second: Array
    tree: cKDTree


def find(gray: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Corners (N, 2), px, and their whole-numbered cell coordinates (N, 2), from an image (H, W).

    The largest connected part of the board is taken; empty arrays when there is none. The cells' x and y
    axes are turned like the image's (right-handed), otherwise arbitrary.
    """
    saddles = _saddles(gray)
    if len(saddles.points) < 4:
        return np.empty((0, 2)), np.empty((0, 2))
    middle = np.array(gray.shape[::-1]) / 2
    best: dict[Cell, int] = {}
    tried: set[int] = set()
    for seed in np.argsort(np.linalg.norm(saddles.points - middle, axis=1)):
        if int(seed) in best.values() or len(tried) >= _SEEDS:
            continue
        tried.add(int(seed))
        found = _grow(saddles, int(seed))
        if len(found) > len(best):
            best = found
        if len(best) > 0.6 * len(saddles.points):
            break
    best = _consistent(saddles, best)
    if len(best) < 4:
        return np.empty((0, 2)), np.empty((0, 2))
    cells = np.array(list(best), np.float64)
    return saddles.points[list(best.values())], cells - cells.min(axis=0)


def _saddles(gray: NDArray[np.uint8]) -> _Saddles:
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), _SMOOTHING)
    xx, yy, xy = (
        np.asarray(cv2.Sobel(smooth, cv2.CV_32F, dx, dy, ksize=5)) for dx, dy in ((2, 0), (0, 2), (1, 1))
    )
    strength = xy * xy - xx * yy
    highest = cv2.dilate(strength, np.ones((2 * _APART + 1, 2 * _APART + 1), np.uint8))
    floor = _WEAKEST * float(np.percentile(strength, 99.7))
    v, u = np.nonzero((strength == highest) & (strength > max(floor, 1e-3)))
    # The two edges run where the second derivative vanishes.
    a, b, c = (plane[v, u].astype(np.float64) for plane in (xx, xy, yy))
    turn = 0.5 * np.arctan2(2.0 * b, a - c)
    mean, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    away = 0.5 * np.arccos(np.clip(-mean / np.maximum(half, 1e-12), -1.0, 1.0))
    one, two = turn + away, turn - away
    points = np.column_stack([u, v]).astype(np.float64)
    real = _crossed(np.asarray(smooth, np.float32), points, (one + two) / 2)
    points, one, two = points[real], one[real], two[real]
    directions = [np.column_stack([np.cos(angle), np.sin(angle)]) for angle in (one, two)]
    return _Saddles(np.asarray(smooth, np.float32), points, directions[0], directions[1], cKDTree(points))


def _crossed(smooth: NDArray[np.float32], points: Array, middle: Array) -> NDArray[np.bool_]:
    """Which saddles (N,) have two bright squares opposite each other and two dark ones across.

    Aliasing along an edge makes weak saddles too, but no squares.

    Args:
        smooth: The picture.
        points: ndarray of shape (N, 2), px.
        middle: ndarray of shape (N,): direction into one of the squares, rad.
    """
    turns = middle[:, None] + np.pi / 2 * np.arange(4)
    places = points[:, None] + _LOOK * np.stack([np.cos(turns), np.sin(turns)], axis=2)
    inside = np.clip(np.rint(places).astype(int), 0, np.array(smooth.shape[::-1]) - 1)
    values = smooth[inside[..., 1], inside[..., 0]]
    contrast = np.abs(values[:, 0] + values[:, 2] - values[:, 1] - values[:, 3]) / 2
    unlike = np.maximum(np.abs(values[:, 0] - values[:, 2]), np.abs(values[:, 1] - values[:, 3]))
    return np.asarray((contrast > 10.0) & (unlike < 0.5 * contrast), np.bool_)


def _grow(saddles: _Saddles, seed: int) -> dict[Cell, int]:
    """Cells and the saddles on them, grown from one saddle."""
    first, second = saddles.first[seed], saddles.second[seed]
    if first[0] * second[1] - first[1] * second[0] < 0.0:
        second = -second
    start: dict[Cell, Array] = {}
    for step, direction in zip(_STEPS, (first, second, -first, -second), strict=True):
        neighbour = _along(saddles, seed, direction)
        if neighbour is not None:
            start[step] = saddles.points[neighbour] - saddles.points[seed]
    if not any(step in start for step in ((1, 0), (-1, 0))) or not any(step in start for step in ((0, 1), (0, -1))):
        return {}
    cells: dict[Cell, int] = {(0, 0): seed}
    used = {seed}
    sign = 0.0
    queue = deque([(0, 0)])
    while queue:
        cell = queue.popleft()
        at = saddles.points[cells[cell]]
        for step in _STEPS:
            to = (cell[0] + step[0], cell[1] + step[1])
            if to in cells:
                continue
            wanted = _expected(saddles, cells, cell, step)
            if wanted is None and cell == (0, 0):
                wanted = start.get(step)
            if wanted is None:
                continue
            off, index = saddles.tree.query(at + wanted)
            if off > _SLACK * float(np.linalg.norm(wanted)) or int(index) in used:
                continue
            contrast = _contrast(saddles, at, saddles.points[int(index)])
            # Black lies to the left of an edge or to its right in turn; across and along alternate too.
            along = step[0] + step[1]
            parity = -1.0 if (min(cell[0], to[0]) + min(cell[1], to[1]) + (step[0] == 0)) % 2 else 1.0
            value = contrast * along * parity
            if sign == 0.0:
                sign = float(np.sign(value))
            if value * sign <= 5.0:
                continue
            cells[to] = int(index)
            used.add(int(index))
            queue.append(to)
    return cells


def _along(saddles: _Saddles, seed: int, direction: Array) -> int | None:
    """The nearest saddle that an edge from the seed leads to."""
    apart = saddles.points - saddles.points[seed]
    ahead = apart @ direction
    aside = np.abs(apart @ np.array([direction[1], -direction[0]]))
    fits = np.flatnonzero((ahead > _APART) & (aside < 0.15 * ahead))
    return int(fits[np.argmin(ahead[fits])]) if len(fits) else None


def _expected(saddles: _Saddles, cells: dict[Cell, int], cell: Cell, step: Cell) -> Array | None:
    """The step as its nearest known neighbours have it: the one behind, else those beside."""
    behind = (cell[0] - step[0], cell[1] - step[1])
    if behind in cells:
        return np.asarray(saddles.points[cells[cell]] - saddles.points[cells[behind]])
    side = (step[1], step[0])
    for sign in (1, -1):
        a = (cell[0] + sign * side[0], cell[1] + sign * side[1])
        b = (a[0] + step[0], a[1] + step[1])
        if a in cells and b in cells:
            return np.asarray(saddles.points[cells[b]] - saddles.points[cells[a]])
    return None


def _contrast(saddles: _Saddles, a: Array, b: Array) -> float:
    """Brightness to the right of the line from `a` to `b` minus that to its left, as displayed."""
    along = b - a
    aside = 0.2 * np.array([-along[1], along[0]])
    shares = np.array([0.35, 0.5, 0.65])[:, None]
    sides = np.vstack([a + shares * along + aside, a + shares * along - aside])
    pixels = np.rint(sides).astype(int)
    height, width = saddles.smooth.shape
    if (pixels < 0).any() or (pixels >= [width, height]).any():
        return 0.0
    values = saddles.smooth[pixels[:, 1], pixels[:, 0]]
    return float(values[:3].mean() - values[3:].mean())


def _consistent(saddles: _Saddles, cells: dict[Cell, int]) -> dict[Cell, int]:
    """Cells without those that lie off the middle of their neighbours, and without single ones left over."""
    kept = dict(cells)
    for cell, index in cells.items():
        for step in ((1, 0), (0, 1)):
            before, after = (cell[0] - step[0], cell[1] - step[1]), (cell[0] + step[0], cell[1] + step[1])
            if before in cells and after in cells:
                p, q = saddles.points[cells[before]], saddles.points[cells[after]]
                # Perspective moves the middle by a few percent of the step, a wrong corner by far more.
                if np.linalg.norm(saddles.points[index] - (p + q) / 2) > 0.1 * np.linalg.norm(q - p):
                    kept.pop(cell, None)
    return {
        (x, y): index
        for (x, y), index in kept.items()
        if sum((x + dx, y + dy) in kept for dx, dy in _STEPS) >= 2
    }

"""What is printed on parts, compared by keypoints: for classes that differ by nothing else.

Keypoints (ORB) of two tops are matched, the turn and shift that most matches agree on is found (RANSAC), and one
print is laid over the other by it: how alike the two then are, pixel by pixel, is the verdict. The shift matters: a
print lies on the top face, whose middle a slanting view moves against the silhouette's.

Source: Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011; Fischler and Bolles, 1981.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection

Tile = NDArray[np.uint8]

SIDE = 96
"""Height and width of a tile, px: the window is as wide as the root of the part's area."""
_RIM = 0.08
"""Share of the tile at the outline that is left out: edges and walls."""
_STRETCH = (1.0, 99.0)
_LEAST_CONTRAST = 12.0
"""Codes: a fainter print is noise."""
_RATIO = 0.85
_LEAST_MATCHES = 4
_REACH_PX = 4.0
_SCALES = (0.8, 1.25)
_LEAST_SHARED = 0.35
"""Share of the tile that both must show."""

_ORB = cv2.ORB.create(150, 1.2, 4, 8, 0, 2, cv2.ORB_HARRIS_SCORE, 21, 8)


@dataclass(frozen=True, slots=True, eq=False)
class Marking:
    """One print with its keypoints.

    Attributes:
        tile: ndarray of shape (SIDE, SIDE), dtype uint8: 1 to 255 on the top, 0 beyond.
        points: ndarray of shape (n, 2), px.
        descriptors: ndarray of shape (n, 32), dtype uint8.
    """

    tile: Tile
    points: NDArray[np.float32]
    descriptors: NDArray[np.uint8]


def tiles_of(image: NDArray[np.uint8], detections: Sequence[Detection]) -> Tile:
    """(n, SIDE, SIDE) tops of detections, their contrast stretched, 0 beyond them."""
    if not len(detections):
        return np.zeros((0, SIDE, SIDE), np.uint8)
    return np.stack([_tile(image, item) for item in detections])


def _tile(image: NDArray[np.uint8], item: Detection) -> Tile:
    scale = SIDE / math.sqrt(max(item.area_px, 1.0))
    x, y = item.center_px
    middle = (SIDE - 1) / 2.0
    matrix = np.array([[scale, 0.0, middle - scale * x], [0.0, scale, middle - scale * y]])
    how = cv2.INTER_CUBIC if scale > 1.0 else cv2.INTER_AREA
    shown = cv2.warpAffine(image, matrix, (SIDE, SIDE), flags=how, borderMode=cv2.BORDER_REPLICATE)
    gray = cv2.cvtColor(shown, cv2.COLOR_BGR2GRAY).astype(np.float32)
    inside = np.zeros((SIDE, SIDE), np.uint8)
    ring = np.rint(((item.outline_px - item.center_px) * scale + middle) * 16.0).astype(np.int32)
    cv2.fillPoly(inside, [ring[:, None]], (255,), shift=4)
    rim = 2 * round(_RIM * SIDE) + 1
    inside = np.asarray(cv2.erode(inside, np.ones((rim, rim), np.uint8)), np.uint8)
    if not inside.any():
        return inside
    low, high = np.percentile(gray[inside > 0], _STRETCH)
    stretched = (gray - low) * (254.0 / max(float(high - low), _LEAST_CONTRAST)) + 1.0
    return np.where(inside > 0, np.clip(np.rint(stretched), 1, 255), 0).astype(np.uint8)


def marking(tile: Tile) -> Marking:
    """The tile with its keypoints."""
    mask = (tile > 0).astype(np.uint8) * 255
    points, descriptors = _ORB.detectAndCompute(tile, mask)
    if descriptors is None or not len(points):
        return Marking(tile, np.empty((0, 2), np.float32), np.empty((0, 32), np.uint8))
    places = np.array([point.pt for point in points], np.float32)
    return Marking(tile, places, np.asarray(descriptors, np.uint8))


def likeness(a: Marking, b: Marking) -> float:
    """How alike two prints are when one is laid over the other, -1 to 1; 0 when no way to lay them is found."""
    if min(len(a.points), len(b.points)) < _LEAST_MATCHES:
        return 0.0
    found = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a.descriptors, b.descriptors, 2)
    good = [pair[0] for pair in found if len(pair) == 2 and pair[0].distance < _RATIO * pair[1].distance]
    if len(good) < _LEAST_MATCHES:
        return 0.0
    from_ = a.points[[match.queryIdx for match in good]]
    to = b.points[[match.trainIdx for match in good]]
    # RANSAC draws at random: the same prints shall always give the same answer.
    cv2.setRNGSeed(1)
    # The stub does not know that nothing is returned when no way is found.
    way, _ = cast(
        "tuple[NDArray[np.float64] | None, object]",
        cv2.estimateAffinePartial2D(from_, to, ransacReprojThreshold=_REACH_PX),
    )
    if way is None or not _SCALES[0] < math.hypot(way[0, 0], way[1, 0]) < _SCALES[1]:
        return 0.0
    laid = np.asarray(cv2.warpAffine(a.tile, way, (SIDE, SIDE)), np.uint8)
    shared = (laid > 0) & (b.tile > 0)
    if np.count_nonzero(shared) < _LEAST_SHARED * SIDE * SIDE:
        return 0.0
    p, q = laid[shared].astype(np.float64), b.tile[shared].astype(np.float64)
    p, q = p - p.mean(), q - q.mean()
    return float(p @ q / max(math.sqrt(float(p @ p) * float(q @ q)), 1e-9))


def best_likeness(new: Marking, known: Sequence[Marking]) -> float:
    """Of a print to the most similar of some; 0 without any."""
    return max((likeness(new, one) for one in known), default=0.0)

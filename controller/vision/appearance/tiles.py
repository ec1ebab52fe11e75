"""Parts brought to one size, so that everything about their surface is computed for all of them at once.

A tile shows the part's middle, `WINDOW` times the root of its area wide, on `SIDE` x `SIDE` pixels, unturned.
Whatever is said of a tile has to be invariant to rotation; scale is relative to the part. A part's form reaches
further out, and is kept on a wider field of the same fineness.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection
from controller.vision.appearance.hole import counts, holes
from controller.vision.appearance.rings import SHIFT, Rings
from controller.vision.appearance.surroundings import surroundings

Image = NDArray[np.uint8]
Floats32 = NDArray[np.float32]
Masks = NDArray[np.bool_]

SIDE = 32
WINDOW = 1.3
"""A square's half diagonal lies 0.71, a circle's radius 0.56 roots of its area from the middle."""
FIELD = 70
"""Pixels of the wider field: the ends of a part four times as long as wide lie one root from its middle."""
_CORE = slice((FIELD - SIDE) // 2, (FIELD + SIDE) // 2)
"""Where a tile lies in the field."""
_MIDDLE = (SIDE - 1) / 2.0
_RIM = 0.07
"""How far inside the outline the material is looked at, share of the short side: beyond blur and side faces' edge."""
_LEAST_RIM = 1.5
"""px of the frame: the blur of a sharp lens."""
_MOST_RIM = 4
"""px of a tile."""
_FEW = 12
"""Fewer pixels say nothing of a surface."""
_NARROWEST = 3.0
"""px of the frame."""
_NEIGHBOURS = np.ones((3, 3), np.uint8)
_RIMS = [cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * rim + 1,) * 2) for rim in range(_MOST_RIM + 1)]


@dataclass(frozen=True, slots=True, eq=False)
class Tiles:
    """The surfaces of N parts.

    Attributes:
        which: Index of each among the detections.
        detections: The parts.
        planes: ndarray of shape (3, N, SIDE, SIDE), dtype uint8: blue, green and red.
        material: ndarray of shape (N, SIDE, SIDE), dtype bool: where its material is seen, away from edges and holes.
        table: ndarray of shape (N, 3), dtype float32: BGR codes of the empty table around each.
        form: ndarray of shape (N, FIELD, FIELD), dtype uint8: 255 where the part is, 0 elsewhere and in its hole.
        hole: ndarray of shape (N,): share of the outline where the table shows through.
    """

    which: tuple[int, ...]
    detections: tuple[Detection, ...]
    planes: Image
    material: Masks
    table: Floats32
    form: NDArray[np.uint8]
    hole: NDArray[np.float64]


def tiles(image: Image, detections: Sequence[Detection]) -> Tiles:
    """The tiles of the detections that are large enough to be looked at.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8, BGR.
        detections: What was found in it.
    """
    which = [k for k, item in enumerate(detections) if min(item.bbox_px[2:]) >= _NARROWEST]
    chosen = [detections[k] for k in which]
    count = len(chosen)
    rings = Rings(chosen)
    middles = np.array([item.center_px for item in chosen]).reshape(-1, 2)
    scales = np.array([SIDE / (WINDOW * math.sqrt(max(item.area_px, 1.0))) for item in chosen])
    rims = np.array([max(_LEAST_RIM, _RIM * item.size_px[1]) for item in chosen]) * scales
    shown = np.empty((count, SIDE, SIDE, 3), np.uint8)
    form = np.zeros((count, FIELD, FIELD), np.uint8)
    # Where the middle of the field lies is where the middle of its part does.
    corners = middles - 0.5 * (FIELD - 1) / scales[:, None]
    outlines = rings.drawn(corners, scales, within=(image.shape[1], image.shape[0]))
    for k, (outline, scale) in enumerate(zip(outlines, scales.tolist(), strict=True)):
        _show(image, chosen[k].center_px, scale, shown[k])
        cv2.fillPoly(form[k], [outline], (255,), cv2.LINE_AA, SHIFT)
    planes = np.array(cv2.split(shown.reshape(-1, SIDE, 3)), np.uint8).reshape(3, -1, SIDE, SIDE)
    table = surroundings(image, chosen, rings)
    solid = form[:, _CORE, _CORE] > 127
    material = _eroded(solid.view(np.uint8), np.clip(np.rint(rims).astype(int), 1, _MOST_RIM))
    few = counts(material) < _FEW
    material[few] = solid[few]
    hole = holes(planes, material, table, ["hole" in item.flags for item in chosen])
    material = _without(material, hole)
    share = counts(hole) / np.maximum(counts(form > 127), 1)
    form[:, _CORE, _CORE][hole] = 0
    keep = np.flatnonzero((counts(solid & ~hole) >= _FEW) & (counts(material) > 0))
    return Tiles(
        tuple(which[k] for k in keep),
        tuple(chosen[k] for k in keep),
        planes[:, keep],
        material[keep],
        table[keep],
        form[keep],
        share[keep],
    )


def _show(image: Image, middle: tuple[float, float], scale: float, out: Image) -> None:
    """Bring a part's surroundings to a tile."""
    x, y = middle
    reduce = int(1.0 / scale)
    if reduce > 3:
        reduce &= ~1
    if reduce > 1:
        # Averaged first: a warp that skips pixels would fold fine textures into coarse ones.
        reach = 0.5 * SIDE / scale + reduce
        left, top = max(0, int(x - reach)), max(0, int(y - reach))
        # Whole blocks only.
        wide = max(1, (min(int(x + reach) + 2, image.shape[1]) - left) // reduce)
        high = max(1, (min(int(y + reach) + 2, image.shape[0]) - top) // reduce)
        cut = image[top : top + high * reduce, left : left + wide * reduce]
        if reduce % 2 == 0:
            # Pairs of pixels are what OpenCV averages quickly.
            cut = np.asarray(cv2.resize(cut, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        image = np.asarray(cv2.resize(cut, (wide, high), interpolation=cv2.INTER_AREA), np.uint8)
        x, y = (x - left + 0.5) / reduce - 0.5, (y - top + 0.5) / reduce - 0.5
        scale *= reduce
    matrix = np.array([[scale, 0.0, _MIDDLE - scale * x], [0.0, scale, _MIDDLE - scale * y]])
    cv2.warpAffine(image, matrix, (SIDE, SIDE), dst=out, borderMode=cv2.BORDER_REPLICATE)


def _eroded(masks: NDArray[np.uint8], rims: NDArray[np.intp]) -> Masks:
    """The masks (N, SIDE, SIDE) with each rim taken off, px; what a tile's edge cuts counts as going on."""
    out = np.empty(masks.shape, bool)
    # Side by side, (SIDE, N, SIDE + gap): long rows are what OpenCV is quick on.
    padded = np.ones((SIDE, len(masks), SIDE + 2 * _MOST_RIM), np.uint8)
    padded[:, :, _MOST_RIM:-_MOST_RIM] = masks.transpose(1, 0, 2)
    for rim in set(rims.tolist()):
        thin = np.asarray(cv2.erode(padded.reshape(SIDE, -1), _RIMS[rim]), np.uint8).reshape(padded.shape)
        own = rims == rim
        out[own] = thin[:, own, _MOST_RIM:-_MOST_RIM].transpose(1, 0, 2) > 0
    return out


def _without(material: Masks, hole: Masks) -> Masks:
    """The material (N, SIDE, SIDE) without the holes and, where that leaves enough of it, without their rims."""
    rim = np.zeros_like(hole)
    for k in np.flatnonzero(hole.any(axis=(1, 2))):
        rim[k] = np.asarray(cv2.dilate(hole[k].view(np.uint8), _NEIGHBOURS)) > 0
    clear = material & ~rim
    return np.where((counts(clear) >= _FEW)[:, None, None], clear, material & ~hole)

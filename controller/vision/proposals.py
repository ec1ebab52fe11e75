"""Where objects may be: regions that differ from the table by level, by chroma, or by their edges.

Every cue overlooks something (a shadow has no chroma, a neutral object of low contrast hardly a level, a large
soft one no edges), so that their regions are all proposed and the fit decides between them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.background import Box, Whitened
from controller.vision.contours import (
    SHORT,
    Boxes,
    Mask,
    Standing,
    Unknown,
    above,
    filled,
    large,
    nothing_known,
    outer,
    standing,
    unseen,
)

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

_QUARTER_TURN = np.array([1.0, -1.0], np.float32)
_WIDENED = np.array([0, 0, 1, 1], np.int32)
"""The box of a contour drawn twice as large is one pixel less than twice as wide."""
_ZONE = 3.0
"""Edge energy, over its median, where a zone ends: noise alone hardly ever exceeds twice the median."""
_EDGE, _FAINT_EDGE = 3.5, 2.5
"""Edge energy, over its median, of clear edges, and of faint ones, looked for at half the size."""
_FAINT_SIZE = 6.0
"""Hulls of faint edges of less than so many times the smallest area are noise: it makes them up to 5 times as large."""
FAINT = 2.0
"""Faint edges are looked for around what reaches no more than so many times the level of a proposal."""
_EDGE_HALF_WIDTH = 1.8
"""By how much the blur of the searched image makes a zone smaller than its object, px."""


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """One proposed region.

    Attributes:
        contour: ndarray of shape (N, 2), dtype float32, its outer boundary in pixels of the searched image.
        area: Its area there.
        cue: `alone`, `level`, `chroma`, `edge`, `faint`, `zone` or `split`.
        convex: The region's area over its hull's.
        core: It is what lies above half of the strength of its surroundings, not all that stands out.
    """

    contour: Floats32
    area: float
    cue: str
    convex: float
    core: bool = False


def propose(
    white: Whitened,
    strength: Floats32,
    seen: Standing,
    level: float,
    smallest: float,
    unknown: Unknown,
    box: Box | None = None,
    visible: Mask | None = None,
) -> list[Region]:
    """Regions worth a closer look.

    Args:
        white: The whitened frame.
        strength: Its strength, 0 where something known hides the table.
        seen: What is `standing` there.
        level: Strength, in standard deviations of the table, above which a pixel may belong to an object.
        smallest: Smallest area, px of the searched image.
        unknown: Leaves out contours of objects that are known already.
        box: Rows and columns to look at.
        visible: ndarray of shape (H, W), dtype uint8: 0 where something known hides the table; `strength` is 0 there.
    """
    if box is not None:
        corner = np.array([box[1].start, box[0].start, 0, 0], np.int32)

        def beyond(boxes: Boxes) -> NDArray[np.bool_]:
            return unknown(boxes + corner)

        high, wide = (length // 2 for length in strength[box].shape)
        top, left = box[0].start // 2, box[1].start // 2
        half = white.half[top : top + high, left : left + wide]
        part = replace(white, difference=white.difference[box], half=half)
        regions = propose(
            part, strength[box], standing(strength[box], level), level, smallest, beyond,
            visible=None if visible is None else visible[box],
        )  # fmt: skip
        return [replace(item, contour=item.contour + corner[:2].astype(np.float32)) for item in regions]
    regions = []
    mask = _unknown(seen, smallest, unknown)
    if mask is not None:
        regions += _components(strength, mask, smallest, "level")
        # What stands out by its chroma stands out by its level, which is never less.
        tint = chroma(white, strength) if visible is None else _where(visible, chroma(white, strength))
        mask = _unknown(standing(tint, level), smallest, unknown)
        if mask is not None:
            regions += _components(tint, mask, smallest, "chroma")
    # A look at half the size tells whether there is anything; beside what hides the table there always is.
    faint = _faint_edges(white, smallest, unknown, visible)
    if visible is not None or faint:
        edges = edge_energy(white.difference)
        typical = _typical(edges, visible)
        if visible is not None:
            edges = _where(visible, edges)
        regions += _edge_regions(above(edges, _EDGE * typical), smallest, "edge", unknown)
        regions += _zones(edges, typical, smallest, unknown, visible)
        regions += [item for item in faint if _hardly(strength, item.contour, FAINT * level)]
    return regions


def _where(visible: Mask, image: Floats32) -> Floats32:
    """An image (H, W), 0 where the mask is."""
    return np.asarray(cv2.copyTo(image, visible), np.float32)


def _faint_edges(white: Whitened, smallest: float, unknown: Unknown, visible: Mask | None) -> list[Region]:
    """Hulls of connected faint edges, at half the size and in fine units, in which there is less noise."""
    edges = edge_energy(np.asarray(cv2.transform(white.half, white.fine.astype(np.float32)), np.float32))
    if visible is not None:
        visible = np.asarray(cv2.resize(visible, edges.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    mask = above(edges, _FAINT_EDGE * _typical(edges, visible))
    if visible is not None:
        mask &= visible

    def beyond(boxes: Boxes) -> NDArray[np.bool_]:
        return unknown(2 * boxes - _WIDENED)

    found = _edge_regions(mask, _FAINT_SIZE * smallest / 4.0, "faint", beyond)
    return [replace(item, contour=2.0 * item.contour + 0.5, area=4.0 * item.area) for item in found]


def _hardly(strength: Floats32, hull: Floats32, most: float) -> bool:
    """Whether what a hull (N, 2) holds, well within the picture, has no more than a strength (median)."""
    x, y, w, h = cv2.boundingRect(hull)
    if x < 2 or y < 2 or x + w > strength.shape[1] - 2 or y + h > strength.shape[0] - 2:
        return False
    inside = np.zeros((h, w), np.uint8)
    cv2.fillConvexPoly(inside, np.rint(hull).astype(np.int32) - (x, y), (1,))
    low = strength[y : y + h, x : x + w] < most
    return bool(2 * np.count_nonzero(low & (inside > 0)) > np.count_nonzero(inside))


def _typical(edges: Floats32, visible: Mask | None) -> float:
    """The median of an edge energy where the table is to be seen: that of its texture and noise."""
    sample = edges[1::4, 1::4] if visible is None else edges[1::4, 1::4][visible[1::4, 1::4] > 0]
    if not sample.size:
        return 0.0
    ordered = np.sort(sample, axis=None)
    return float(ordered[len(ordered) // 2])


def chroma(white: Whitened, strength: Floats32) -> Floats32:
    """Strength of the colour difference that no shadow can make.

    A shadow scales the table's colour, that is, it moves a pixel along that colour; what is perpendicular to it,
    in whitened units, must be an object.
    """
    shade = white.whitener @ white.table_colour
    shade /= max(float(np.linalg.norm(shade)), 1e-9)
    along = cv2.transform(white.difference, shade[None].astype(np.float32))
    across = cv2.multiply(strength, strength)
    cv2.subtract(across, cv2.multiply(along, along, dst=along), dst=across)
    cv2.threshold(across, 0.0, 0.0, cv2.THRESH_TOZERO, dst=across)
    return np.asarray(cv2.sqrt(across, dst=across), np.float32)


def edge_energy(difference: Floats32) -> Floats32:
    """Magnitudes of the gradients of a difference from the table, summed over the channels."""
    flat = difference.shape[0], difference.shape[1] * 3
    dx = cv2.Sobel(difference, cv2.CV_32F, 1, 0, ksize=3).reshape(flat)
    dy = cv2.Sobel(difference, cv2.CV_32F, 0, 1, ksize=3).reshape(flat)
    magnitude = np.asarray(cv2.magnitude(dx, dy)).reshape(difference.shape)
    return np.asarray(cv2.transform(magnitude, np.ones((1, 3), np.float32)), np.float32)


def _components(image: Floats32, mask: Mask, smallest: float, cue: str) -> list[Region]:
    """The regions of a mask, and within each what lies above half and above a fifth of its own strength.

    Half is where the edge of an evenly coloured object lies; a fifth holds objects with glints and dark sides.
    """
    count, labels = cv2.connectedComponents(mask, connectivity=4, ltype=cv2.CV_16U)
    flat = labels.ravel()
    inside = np.flatnonzero(flat)
    values = image.ravel()[inside]
    names = flat[inside]
    squared = values * values
    own = np.bincount(names, squared * values, count) / np.maximum(np.bincount(names, squared, count), 1e-9)
    own = np.where(np.bincount(names, minlength=count) >= smallest, own, np.inf).astype(np.float32)
    own[0] = np.inf
    relative = values / own[names]
    core, soft = np.zeros(mask.shape, np.uint8), np.zeros(mask.shape, np.uint8)
    core.ravel()[inside] = relative > 0.5
    soft.ravel()[inside] = relative > 0.2
    return (
        _contours(core, smallest, cue, core=True) + _contours(soft, smallest, cue) + _contours(mask, smallest, cue)
    )


def _edge_regions(mask: Mask, smallest: float, cue: str, unknown: Unknown) -> list[Region]:
    """Hulls of connected edges."""
    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)), np.uint8)
    found = []
    for region in _contours(mask, smallest, cue, unknown=unknown):
        hull = np.asarray(cv2.convexHull(region.contour)[:, 0], np.float32)
        area = float(cv2.contourArea(hull))
        found.append(Region(hull, area, cue, 1.0))
    return found


def _zones(
    edges: Floats32, typical: float, smallest: float, unknown: Unknown, visible: Mask | None
) -> list[Region]:
    """Convex patches without edges inside: faces of objects, also where objects touch, overlap or cast shadows."""
    flat = cv2.bitwise_not(above(edges, _ZONE * typical))
    if visible is not None:
        flat = cv2.bitwise_and(flat, visible)
    contours, hierarchy = cv2.findContours(flat, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    # The fourth entry is the parent: holes have one, outer boundaries none.
    closed = [
        contour for contour, links in zip(contours, hierarchy[0] if contours else (), strict=True)
        if links[3] < 0 and len(contour) >= SHORT
    ]  # fmt: skip
    out = []
    for contour in unseen(closed, unknown):
        area = filled(contour)
        if area < 0.25 * smallest or area > 0.3 * edges.size:
            continue
        hull = cv2.convexHull(contour)
        convex = area / (float(cv2.contourArea(hull)) + 0.5 * len(contour) + 1.0)
        if convex < 0.85:
            continue
        grown = _outwards(hull[:, 0].astype(np.float32), _EDGE_HALF_WIDTH)
        out.append(Region(grown, float(cv2.contourArea(grown)), "zone", 1.0))
    return out


def _outwards(hull: Floats32, by: float) -> Floats32:
    """A convex polygon (N, 2) with its sides moved outwards."""
    if len(hull) < 3:
        return hull
    side = np.concatenate([hull[1:], hull[:1]]) - hull
    normal = side[:, ::-1] * _QUARTER_TURN / np.maximum(np.hypot(side[:, 0], side[:, 1]), 1e-6)[:, None]
    if np.sum((hull - hull.mean(axis=0)) * normal) < 0.0:
        normal = -normal
    both = normal + np.concatenate([normal[-1:], normal[:-1]])
    length = np.maximum(np.vecdot(both, both) / 2.0, 0.3)[:, None]
    return np.asarray(hull + by * both / length, np.float32)


def _unknown(seen: Standing, smallest: float, unknown: Unknown) -> Mask | None:
    """Of what stands out all that is neither known nor too small; None when there is none."""
    mask, kept = seen.mask, unseen(large(seen.contours, smallest), unknown)
    if not kept or len(kept) == len(seen.contours):
        return mask if kept else None
    return mask & np.asarray(cv2.drawContours(np.zeros_like(mask), kept, -1, (255,), cv2.FILLED), np.uint8)


def _contours(
    mask: Mask, smallest: float, cue: str, core: bool = False, unknown: Unknown = nothing_known
) -> list[Region]:
    out = []
    for contour in unseen(large(outer(mask), smallest), unknown):
        area = filled(contour)
        hull = float(cv2.contourArea(cv2.convexHull(contour))) + 0.5 * len(contour) + 1.0
        out.append(Region(contour[:, 0].astype(np.float32), area, cue, min(1.0, area / hull), core))
    return out


def split_necks(region: Region, smallest: float, depth: int = 2) -> list[Region]:
    """Pieces of a region that seems to be several touching objects, cut at its necks; empty when it has none.

    A neck joins two concave points of the contour by a chord that is short against both ways around.
    """
    if region.convex > 0.96 or depth == 0 or len(region.contour) < 16:
        return []
    contour = region.contour.astype(np.int32)[:, None]
    hull = cv2.convexHull(contour, returnPoints=False)
    if len(hull) < 4:
        return []
    hull = np.sort(hull, axis=0)[::-1]
    # OpenCV's stub leaves out that there may be none.
    defects: Any = cv2.convexityDefects(contour, hull)
    if defects is None:
        return []
    size = np.sqrt(region.area)
    points = defects[defects[:, 0, 3] > 256.0 * max(1.2, 0.03 * size), 0, 2].tolist()
    pieces: list[Region] = []
    cuts = []
    n = len(contour)
    for a in range(len(points)):
        for b in range(a + 1, len(points)):
            i, j = sorted((points[a], points[b]))
            around = min(j - i, n - (j - i))
            chord = float(np.linalg.norm(region.contour[i] - region.contour[j]))
            if around > 6 and chord < 0.6 * around:
                cuts.append((chord / around, i, j))
    for _, i, j in sorted(cuts)[:2]:
        for part in (region.contour[i : j + 1], np.concatenate([region.contour[j:], region.contour[: i + 1]])):
            area = float(cv2.contourArea(part)) + 0.5 * len(part) + 1.0
            if area < smallest:
                continue
            hull_area = float(cv2.contourArea(cv2.convexHull(part))) + 0.5 * len(part) + 1.0
            piece = Region(np.ascontiguousarray(part), area, "split", min(1.0, area / hull_area))
            pieces.append(piece)
            pieces += split_necks(piece, smallest, depth - 1)
    return pieces

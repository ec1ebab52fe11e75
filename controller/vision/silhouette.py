"""What a camera sees of an upright part besides its top face: the sides that lean into view.

The fitted shape is the top face, whose edges are all there; the outline of the part also holds the side faces,
down to the foot. Which sides show, and how far, follows from the camera and the part's height; where exactly they
end is measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.geometry import PlaneMap
from controller.vision.local_map import LocalMaps
from controller.vision.profiles import sample

Floats = NDArray[np.float64]

POINTS = 72
"""Points of a measured outline: 5 degrees of a circle."""
_TALLEST = 1.5
"""Parts are expected to be at most this much taller than typical."""
_COLUMNS = 25


def foot(top: Floats, plane: PlaneMap, height: float) -> Floats:
    """Pixels (N, 2) of the points on the table below the points of a top face, given in px, at `height` (mm)."""
    return plane.at(0.0).to_pixels(plane.at(height).to_plane(top))


def feet(tops: Sequence[Floats], plane: PlaneMap, height: float) -> list[Floats]:
    """`foot` of several top faces at one height."""
    if not tops:
        return []
    ends = np.cumsum([len(top) for top in tops])[:-1]
    return np.split(foot(np.concatenate(tops), plane, height), ends)


def to_feet(centers: Floats, maps: LocalMaps, index: NDArray[np.intp], plane: PlaneMap) -> Floats:
    """How far (K, 2) the feet of parts lie from their top faces with such centres (K, 2), local units.

    Args:
        centers: Of the top faces, local coordinates.
        maps: The local coordinates.
        index: ndarray of shape (K,): which object of `maps` each belongs to.
        plane: Half way up the parts.
    """
    if not len(centers):
        return np.empty((0, 2))
    below = foot(maps.all_to_pixels(index, centers[:, None])[:, 0], plane, 2.0 * plane.height)
    return np.asarray(maps.many_to_local(index, below[:, None])[:, 0] - centers)


def _hulls(tops: Sequence[Floats], below: Sequence[Floats]) -> list[Floats]:
    """Hulls (M, 2), px, of each top face and its foot."""
    both = (np.concatenate(pair).astype(np.float32) for pair in zip(tops, below, strict=True))
    return [np.asarray(cv2.convexHull(points)[:, 0], np.float64) for points in both]


def reaches(tops: Sequence[Floats], plane: PlaneMap) -> list[Floats]:
    """Hulls of everything that can be seen of parts with these top faces, were they as tall as parts get."""
    return _hulls(tops, feet(tops, plane, 2.0 * plane.height * _TALLEST))


def measure(image: NDArray[np.uint8], noise: Floats, tops: list[Floats], plane: PlaneMap) -> list[Floats]:
    """Outlines (POINTS, 2), px, of parts with these top faces, on the edges in the image.

    The height starts as twice the plane's (parts are decided on the plane half way up) and follows the edges of
    the foot; where no edge is to be seen the outline is the predicted one.
    """
    if not tops:
        return []
    typical = 2.0 * plane.height
    points = np.concatenate(tops)
    counts = [len(top) for top in tops]
    # The ray through a point of the picture is straight: it crosses heights between these in proportion.
    ground, lifted = plane.at(0.0).to_plane(points), plane.at(typical).to_plane(points)

    def below_at(heights: Floats) -> list[Floats]:
        places = ground + (lifted - ground) * np.repeat(heights / typical, counts)[:, None]
        return np.split(plane.at(0.0).to_pixels(places), np.cumsum(counts)[:-1])

    usual = np.full(len(tops), typical)
    below = below_at(usual)
    shifts = np.array([np.linalg.norm((low - top).mean(axis=0)) for top, low in zip(tops, below, strict=True)])
    middle, normal, length = _chunks(_hulls(tops, below))
    stray, found = _edges(image, noise, middle, normal, length, np.clip(0.45 * shifts, 3.0, 12.0))
    taller = _hulls(tops, below_at(1.1 * usual))
    heights = _follow(usual, middle, normal, stray, found, taller)
    middle, normal, length = _chunks(_hulls(tops, below_at(heights)))
    stray, found = _edges(image, noise, middle, normal, length, np.full(len(tops), 3.0))
    out = []
    for k in range(len(tops)):
        smooth = np.where(found[k], stray[k], 0.0)
        out.append(middle[k] + smooth[:, None] * normal[k])
    return out


def _chunks(hulls: list[Floats]) -> tuple[Floats, Floats, Floats]:
    """POINTS equal pieces of every hull: middles and outward normals (K, POINTS, 2), lengths (K, POINTS)."""
    middles, normals = np.empty((len(hulls), POINTS, 2)), np.empty((len(hulls), POINTS, 2))
    lengths = np.empty((len(hulls), POINTS))
    for k, hull in enumerate(hulls):
        side, length, n = _sides(hull)
        ends = np.cumsum(length)
        at = (np.arange(POINTS) + 0.5) / POINTS * ends[-1]
        which = np.minimum(np.searchsorted(ends, at), len(hull) - 1)
        part = (at - (ends[which] - length[which])) / length[which]
        middles[k] = hull[which] + side[which] * part[:, None]
        normals[k] = n[which]
        lengths[k] = ends[-1] / POINTS
    return middles, normals, lengths


def _sides(hull: Floats) -> tuple[Floats, Floats, Floats]:
    """Sides (M, 2) of a convex hull, their lengths (M,) and outward normals (M, 2)."""
    side = np.concatenate([hull[1:], hull[:1]]) - hull
    length = np.maximum(np.hypot(side[:, 0], side[:, 1]), 1e-9)
    normal = side[:, ::-1] * (1.0, -1.0) / length[:, None]
    if np.sum((hull - hull.mean(axis=0)) * normal) < 0.0:
        normal = -normal
    return side, length, normal


def _edges(
    image: NDArray[np.uint8], noise: Floats, middle: Floats, normal: Floats, length: Floats, window: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """How far outwards the outermost clear edge lies from each point, px, and whether there is one."""
    along = np.stack([-normal[..., 1], normal[..., 0]], axis=-1) * (0.5 * length[..., None])
    profiles = sample(image, middle - along, middle + along, normal, window + 1.0, _COLUMNS)
    whitener = np.linalg.inv(np.linalg.cholesky(noise)).astype(np.float32)
    values = profiles.values @ whitener.T
    spacing = 2.0 * (window + 1.0) / (_COLUMNS - 1)
    gap = max(1, round(0.7 / float(np.median(spacing))))
    slope = values[:, :, 2 * gap :] - values[:, :, : -2 * gap]
    own = np.sqrt(np.vecdot(slope, slope))
    # A chunk's neighbours look at the same edge.
    around = np.concatenate([own[:, -1:], own, own[:, :1]], axis=1)
    strength = 0.5 * own + 0.25 * (around[:, :-2] + around[:, 2:])
    columns = strength.shape[2]
    top = strength.max(axis=2, keepdims=True)
    peak = np.zeros_like(strength, bool)
    peak[:, :, 1:-1] = (strength[:, :, 1:-1] >= strength[:, :, :-2]) & (strength[:, :, 1:-1] > strength[:, :, 2:])
    floor = 6.0 / np.sqrt(profiles.pixels)[..., None]
    peak &= (strength > 0.4 * top) & (strength > floor)
    outermost = columns - 1 - np.argmax(peak[:, :, ::-1], axis=2)
    found = peak.any(axis=2)
    k, c = np.indices(outermost.shape, sparse=True)
    i = np.clip(outermost, 1, columns - 2)
    a, b, d = strength[k, c, i - 1], strength[k, c, i], strength[k, c, i + 1]
    bend = a - 2.0 * b + d
    shift = np.where(bend < -1e-9, 0.5 * (a - d) / np.where(bend < -1e-9, bend, -1.0), 0.0)
    at = (i + gap + np.clip(shift, -0.5, 0.5) - (_COLUMNS - 1) / 2.0) * spacing[:, None]
    return np.asarray(at), np.asarray(found & (np.abs(at) <= window[:, None]))


def _follow(
    heights: Floats, middle: Floats, normal: Floats, stray: Floats, found: NDArray[np.bool_], taller: list[Floats]
) -> Floats:
    """Heights after the edges of the foot: a taller part's outline lies further out on the foot's side only."""
    out = heights.copy()
    for k, hull in enumerate(taller):
        # Distance inside the taller outline: how far a tenth more height moves this point.
        outwards = _sides(hull)[2]
        rate = np.maximum(((hull * outwards).sum(axis=1) - middle[k] @ outwards.T).min(axis=1), 0.0)
        use = found[k] & (rate > 0.3 * max(float(rate.max()), 1e-9)) & (rate > 0.15)
        if use.sum() < 4:
            continue
        tenths = float(np.median(stray[k][use] / rate[use]))
        out[k] = heights[k] * float(np.clip(1.0 + 0.1 * tenths, 0.5, _TALLEST))
    return out

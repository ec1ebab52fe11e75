"""Hypotheses tried on the pixels, and what of a frame the good ones explain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.chunks import Batch, batch_of, corners
from controller.vision.contours import Boxes
from controller.vision.fitting import Hypothesis
from controller.vision.local_map import LocalMaps
from controller.vision.padded import KINDS, ROUND, areas
from controller.vision.profiles import CHUNKS
from controller.vision.proposals import Region
from controller.vision.refine import Refined, open_sided, refine, refine_on
from controller.vision.robust import median
from controller.vision.scene import CLOSE, Judged, Scene, all_sampled, boxes, whole
from controller.vision.shapes import CIRCLE, area, vertices
from controller.vision.silhouette import feet, to_feet

Floats = NDArray[np.float64]

_RING = vertices(CIRCLE, np.array([0.0, 0.0, 1.0]))
HALF_SEEN = 0.45
"""Share of a silhouette that its top face's shape explains at least: half its sides may lean into view, and where those
begin the two are hardly apart."""
_CLEAR = 4.0
"""How many times the smallest contrast an outline has of which side faces hide some: the arm's shadow has less."""
_RESTARTS = 3
"""How often an outline with hidden parts may move on."""
_ALIKE = 0.5, 1.6
"""Ratios of areas between which two outlines around one place are one thing: not a print, nor a pair that touches."""
_RIM, _RIM_SHARE = 0.4, 0.06
"""Misfit, px, that side faces seen as a narrow rim cause at most, and as a share of how far the foot lies from the top:
a chunk sees part of their edge when they are narrower than its profile."""
_GROWN, _AROUND = 1.6, 8.0
"""How many times the box of a settled outline the box of a contour may hold that shows the same, and by how many pixels
of the searched image it may be wider, half of them on either side: its blur and shadow."""
THIN = 0.55
"""Short side of the smallest object over its width: the smallest circle and a slim rectangle of its area."""


def tried(
    scene: Scene, wanted: list[Hypothesis], blur: float, certain: Sequence[Judged] = (), *, restarts: int = _RESTARTS
) -> list[Judged]:
    """Hypotheses refined, those with a visible outline.

    Where side faces show, outlines half seen are kept as well, with a badness that nobody believes: they may be
    silhouettes, whose one half is the top face's. Of a top face only what has the table beside it must be seen.

    Args:
        scene: The frame.
        wanted: The hypotheses.
        blur: Expected blur, px.
        certain: Outlines found before that need no further guess.
        restarts: How often those with hidden parts may move on.
    """
    image, noise, maps, settings = scene.image, scene.noise, scene.maps, scene.settings
    families, index = [h.family for h in wanted], [h.region for h in wanted]
    refined = refine(image, noise, families, [h.q for h in wanted], maps, index, blur)
    judged = _judged(scene, wanted, refined)
    # What lies around an outline that is certain is no better for being sought again.
    certain = [*certain, *(item for item in judged if item is not None and whole(item))]
    rows = []
    for i, (h, item) in enumerate(zip(wanted, refined, strict=True)):
        if item is not None and item.levels >= settings.minimum_contrast and open_sided(item, settings.visible):
            x, y = maps.to_pixels(h.region, item.q[None, :2])[0].tolist()
            if not lies_on(x, y, float(area(h.family, item.q[None])[0]), certain):
                rows.append(i)
    if rows:
        again = [wanted[i] for i in rows]
        start = [item for i in rows if (item := refined[i]) is not None]
        better = refine_on(
            image, noise, [families[i] for i in rows], start, maps, [index[i] for i in rows], blur,
            restarts=restarts, enough=settings.visible, hasty=scene.sides,
        )
        for i, last in zip(rows, _judged(scene, again, better), strict=True):
            judged[i] = last
    return [item for item in judged if item is not None]


def lies_on(x: float, y: float, covered: float, certain: Sequence[Judged]) -> bool:
    """Whether the middle of an outline (px) of an area lies on another that is certain and of about its size."""
    return any(
        other.box[0] < x < other.box[2] and other.box[1] < y < other.box[3]
        and _ALIKE[0] * covered < other.area < _ALIKE[1] * covered
        and cv2.pointPolygonTest(other.outline.astype(np.float32), (x, y), False) > 0.0
        for other in certain
    )  # fmt: skip


def _judged(
    scene: Scene, wanted: Sequence[Hypothesis], refined: Sequence[Refined | None]
) -> list[Judged | None]:
    """What is to be thought of refined hypotheses; None of what nobody sees."""
    settings, maps = scene.settings, scene.maps
    least = min(settings.visible, HALF_SEEN) if scene.sides else settings.visible
    shown = [
        (i, h, r) for i, (h, r) in enumerate(zip(wanted, refined, strict=True))
        if r is not None and r.visible >= least
        and r.levels >= settings.minimum_contrast and r.contrast >= 1.0
    ]  # fmt: skip
    batch = batch_of([h.family for _, h, _ in shown], [r.q for _, _, r in shown], [h.region for _, h, _ in shown], 1.0)
    open_ = _open_chunks(scene, batch)
    found = open_ & np.array([r.seen for _, _, r in shown], bool).reshape(open_.shape)
    shares = (found.sum(axis=1) / np.maximum(open_.sum(axis=1), 1)).tolist()
    kept = [
        (*item, share, covered, outline)
        for item, share, covered, outline in zip(
            shown, shares, areas(batch.kind, batch.q).tolist(), _outlines(maps, batch), strict=True
        )
        if np.isfinite(outline).all() and _width(outline) >= THIN * settings.smallest_px
    ]
    outlines = [outline for *_, outline in kept]
    out: list[Judged | None] = [None] * len(wanted)
    told = zip(kept, all_sampled(outlines), boxes(outlines).tolist(), _slack(scene, outlines), strict=True)
    for (i, h, r, seen, covered, outline), rim, box, slack in told:
        allowed = settings.misfit_px + settings.misfit_share * math.sqrt(covered) + slack
        badness = r.misfit / allowed
        clear = badness <= CLOSE and r.levels >= _CLEAR * settings.minimum_contrast
        if (seen if clear else r.visible) < settings.visible:
            badness = math.inf
        out[i] = Judged(h, r, badness, outline, rim, covered, box)
    return out


def _open_chunks(scene: Scene, batch: Batch) -> NDArray[np.bool_]:
    """Which chunks (K, CHUNKS) of top faces have the table beside them, and no side face of their own part."""
    if not scene.sides or scene.plane is None:
        return np.ones((len(batch.q), CHUNKS), bool)
    normals, _ = batch.geometry()
    outwards = to_feet(batch.q[:, :2], scene.maps, batch.index, scene.plane)
    # A side face narrower than a pixel hides nothing.
    return np.asarray(np.vecdot(normals, outwards[:, None]) <= 1.0)


def _outlines(maps: LocalMaps, batch: Batch) -> list[Floats]:
    """Corners (N, 2) of outlines, px; circles are sampled."""
    circles = np.flatnonzero(batch.kind == ROUND)
    rest = batch.some(np.flatnonzero(batch.kind != ROUND))
    rings = batch.q[circles, None, :2] + batch.q[circles, 2, None, None] * _RING
    both = iter(maps.all_to_pixels(batch.index[circles], rings)), iter(maps.all_to_pixels(rest.index, corners(rest)))
    return [
        next(both[0]) if kind == ROUND else next(both[1])[: len(KINDS[kind].normals)] for kind in batch.kind.tolist()
    ]


def typical_blur(judged: Sequence[Judged], otherwise: float) -> float:
    """Median blur of the outlines that fit, px."""
    good = [item.refined.blur for item in judged if item.badness < 1.0]
    return float(median(np.array(good), 0)) if good else otherwise


def _width(outline: Floats) -> float:
    """Short side of the minimum-area rectangle, px."""
    return float(min(cv2.minAreaRect(outline.astype(np.float32))[1]))


def _slack(scene: Scene, outlines: list[Floats]) -> list[float]:
    """Misfit, px, that side faces seen as a narrow rim beside each top face may cause."""
    if not scene.sides or scene.plane is None:
        return [0.0] * len(outlines)
    below = feet(outlines, scene.plane, 2.0 * scene.plane.height)
    shifts = [math.hypot(*(low - top).mean(axis=0)) for top, low in zip(outlines, below, strict=True)]
    return [min(_RIM, _RIM_SHARE * shift) if math.isfinite(shift) else 0.0 for shift in shifts]


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """Outlines that need no further guess.

    Attributes:
        owner: ndarray of shape (H, W), dtype uint16, of the searched image: which outline each pixel lies in, counted
            from 1; 0 for none.
        size: ndarray of shape (K + 1, 2): width and height of each outline's box, px of the searched image.
    """

    owner: NDArray[np.uint16]
    size: Floats

    def unexplained(self, boxes: Boxes) -> NDArray[np.bool_]:
        """Which (N,) boxes (N, 4) of contours in the searched image are none of an outline or of a part of it."""
        if len(self.size) < 2:
            return np.ones(len(boxes), bool)
        x, y, w, h = boxes.T
        rows, columns = self.owner.shape
        row, column = np.maximum(y + h // 2, 0), np.maximum(x + w // 2, 0)
        owner = self.owner[np.minimum(row, rows - 1), np.minimum(column, columns - 1)]
        own = self.size[owner]
        return np.asarray((owner == 0) | (w * h >= 1.6 * own[:, 0] * own[:, 1] + 8.0 * own.sum(axis=1)))

    def fills(self, region: Region, share: float) -> bool:
        """Whether several of the outlines fill more than a share of a region."""
        x, y, w, h = cv2.boundingRect(region.contour)
        rows, columns = slice(max(y, 0), max(y + h, 0)), slice(max(x, 0), max(x + w, 0))
        owner = self.owner[rows, columns]
        inside = np.zeros(owner.shape, np.uint8)
        cv2.fillPoly(inside, [np.rint(region.contour).astype(np.int32) - (columns.start, rows.start)], (1,))
        counts = np.bincount(owner[inside > 0], minlength=1)
        return bool(np.count_nonzero(counts[1:]) > 1 and counts[1:].sum() > share * counts.sum())

    def explained(self, regions: Sequence[Region]) -> list[bool]:
        """Which regions are one of the outlines, or a part of it."""
        boxes = np.array([cv2.boundingRect(item.contour) for item in regions], np.int32).reshape(-1, 4)
        return [not new for new in self.unexplained(boxes).tolist()]


def settled(judged: Sequence[Judged], scene: Scene) -> Settled:
    """The outlines that are seen completely and fit well."""
    done = [item for item in judged if whole(item)]
    owner = np.zeros(scene.white.strength.shape, np.uint16)
    size = np.zeros((len(done) + 1, 2))
    if done:
        corners = np.array([item.box for item in done])
        size[1:] = (corners[:, 2:] - corners[:, :2]) / scene.factor
        points = (np.concatenate([item.outline for item in done]) - (scene.factor - 1) / 2.0) / scene.factor
        places, end = np.rint(points).astype(np.int32), 0
        for number, item in enumerate(done, start=1):
            begin, end = end, end + len(item.outline)
            cv2.fillConvexPoly(owner, places[begin:end], (number,))
    return Settled(owner, size)

"""What is told of every object found: size, area, direction and descriptors of its outline, all objects at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Descriptors, Detection, Frame, Shape
from controller.geometry import wrap
from controller.vision.scene import Found

Floats = NDArray[np.float64]
Places = NDArray[np.intp]

_LEAST_POINTS = 32
"""Points of an outline handed on."""
_UNEVEN = 1.1
"""Longest over shortest side from which a triangle's longest side alone says how it lies."""


class Rings:
    """Closed outlines of any numbers of points, laid end to end.

    Args:
        outlines: K of shape (N, 2), at least one.

    Attributes:
        points: ndarray of shape (M, 2): all their points.
        first: ndarray of shape (K,): where each begins.
        count: ndarray of shape (K,): points of each.
        sides: ndarray of shape (M, 2): from every point to the one after it.
        lengths: ndarray of shape (M,): of the sides.
        doubled: ndarray of shape (K,): twice the signed areas: positive when clockwise as displayed.
    """

    def __init__(self, outlines: Sequence[Floats]) -> None:
        self._lay(np.concatenate(outlines), np.array([len(outline) for outline in outlines]))

    def _lay(self, points: Floats, count: Places) -> None:
        self.points, self.count = points, count
        ends = np.cumsum(count)
        self.first = ends - count
        after = np.arange(1, len(points) + 1)
        after[ends - 1] = self.first
        self.sides = points[after] - points
        self.lengths = np.hypot(self.sides[:, 0], self.sides[:, 1])
        shifted = points - np.repeat(points[self.first], count, axis=0)
        self.doubled: Floats = np.add.reduceat(
            shifted[:, 0] * self.sides[:, 1] - shifted[:, 1] * self.sides[:, 0], self.first
        )

    def counter_clockwise(self) -> Rings:
        """The outlines with their points in counter-clockwise order as displayed (y down)."""
        turned = np.repeat(self.doubled > 0.0, self.count)
        if not turned.any():
            return self
        place = np.arange(len(self.points))
        ends = np.repeat(2 * self.first + self.count - 1, self.count)
        out = object.__new__(Rings)
        out._lay(self.points[np.where(turned, ends - place, place)], self.count)
        return out

    def ring(self, k: int) -> Floats:
        """The points (N, 2) of outline k."""
        return np.asarray(self.points[self.first[k] : self.first[k] + self.count[k]])

    def dense(self, least: int = _LEAST_POINTS) -> list[Floats]:
        """The outlines, the sides of those of few points cut into equal pieces, at least `least` in all of each."""
        whole = np.add.reduceat(self.lengths, self.first)
        few = np.repeat(self.count < least, self.count)
        share = self.lengths / np.repeat(np.maximum(whole, 1e-9), self.count)
        pieces = np.where(few, np.maximum(np.ceil(least * share), 1), 1).astype(np.intp)
        ends = np.cumsum(pieces)
        side = np.repeat(np.arange(len(pieces)), pieces)
        along = (np.arange(ends[-1]) - (ends - pieces)[side]) / pieces[side]
        points = self.points[side] + self.sides[side] * along[:, None]
        last = ends[self.first + self.count - 1].tolist()
        return [points[a:b] for a, b in pairwise([0, *last])]


def described(frame: Frame, found: Sequence[Found]) -> list[Detection]:
    """The detections of what was found in a frame."""
    if not found:
        return []
    outlines = Rings([item.outline for item in found]).counter_clockwise()
    same = all(item.face is item.outline for item in found)
    faces = outlines if same else Rings([item.face for item in found]).counter_clockwise()
    areas = 0.5 * np.abs(outlines.doubled)
    low = np.minimum.reduceat(outlines.points, outlines.first)
    high = np.maximum.reduceat(outlines.points, outlines.first)
    boxes = np.concatenate([low, high - low], axis=1).tolist()
    perimeters = np.add.reduceat(outlines.lengths, outlines.first).tolist()
    uneven = np.abs(faces.lengths[faces.first] - faces.lengths[faces.first + 1]).tolist()
    angles = _directions([item.shape for item in found], faces)
    out = []
    for k, (item, points) in enumerate(zip(found, outlines.dense(), strict=True)):
        covered = float(areas[k])
        if item.diameter is not None:
            size = item.diameter, item.diameter
            covered *= _circle_area_factor(int(outlines.count[k]))
        else:
            width, height = cv2.minAreaRect(outlines.ring(k).astype(np.float32))[1]
            size = max(width, height), min(width, height)
        box, area = boxes[k], max(covered, 1e-9)
        out.append(
            Detection(
                frame=frame,
                shape=item.shape,
                score=item.score,
                outline_px=points,
                center_px=(float(item.center[0]), float(item.center[1])),
                size_px=size,
                angle=angles[k],
                area_px=covered,
                bbox_px=(box[0], box[1], box[2], box[3]),
                descriptors=Descriptors(
                    box[2] * box[3] / area,
                    perimeters[k] ** 2 / (4.0 * math.pi * area),
                    0.0 if item.shape is Shape.CIRCLE else uneven[k],
                ),
                label=str(item.shape),
                flags=item.flags,
            )
        )
    return out


def _directions(shapes: Sequence[Shape], faces: Rings) -> list[float | None]:
    """Directions, rad, counter-clockwise as displayed, by the convention of each shape; None for circles."""
    period = np.array([shape.period or math.inf for shape in shapes])
    turn = 2.0 * math.pi / period
    # The mean over the sides, each as long as it counts, modulo the period.
    counts = faces.lengths.copy()
    for k, shape in enumerate(shapes):
        own = slice(faces.first[k], faces.first[k] + faces.count[k])
        length = faces.lengths[own]
        if shape is Shape.RECTANGLE:
            counts[own][int(length[0] + length[2] >= length[1] + length[3]) :: 2] = 0.0
        elif shape is Shape.TRIANGLE and length.max() > _UNEVEN * length.min():
            counts[own] = 0.0
            counts[own][length.argmax()] = 1.0
    phases = np.arctan2(-faces.sides[:, 1], faces.sides[:, 0]) * np.repeat(turn, faces.count)
    sums = np.add.reduceat(counts * np.exp(1j * phases), faces.first)
    means = np.angle(sums)
    out: list[float | None] = []
    for k, shape in enumerate(shapes):
        if shape.period is None:
            out.append(None)
        elif shape is Shape.OTHER:
            (_, (width, height), degrees) = cv2.minAreaRect(faces.ring(k).astype(np.float32))
            out.append(wrap(-math.radians(degrees + (0.0 if width >= height else 90.0)), shape.period))
        else:
            out.append(wrap(float(means[k]) / float(turn[k]), shape.period))
    return out


def _circle_area_factor(corners: int) -> float:
    """Area of a circle over that of the regular polygon with corners on it."""
    turn = 2.0 * math.pi / corners
    return turn / math.sin(turn)

"""What a trained model says of a picture, put onto what was found in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Descriptors, Detection, Frame, Shape
from controller.vision.models.crops import crops
from controller.vision.models.network import Network
from controller.vision.models.settings import Model

Floats32 = NDArray[np.float32]
BOX = "box"
"""Flag of an object that only a detector saw: its outline is a box, good to a tenth of its size."""
_SAME = 0.5
"""A box and an object are the same when what they share is this part of what they cover together."""


def named(frame: Frame, detections: Sequence[Detection], network: Network) -> list[Detection]:
    """The detections with the model's names as labels where it is sure enough; boxes of a detector added.

    Raises:
        ConfigError: The model fails.
    """
    settings = network.settings
    if settings.task == "detect":
        return _boxed(frame, detections, network)
    out = list(detections)
    if not out:
        return out
    scores = network.scores(crops(frame.image, out, settings.margin, settings.input[2:]))
    best = scores.argmax(axis=1)
    for k, (row, index) in enumerate(zip(scores, best, strict=True)):
        if row[index] >= settings.least:
            out[k] = replace(out[k], label=settings.labels[int(index)])
    return out


def _boxed(frame: Frame, detections: Sequence[Detection], network: Network) -> list[Detection]:
    settings = network.settings
    _, _, height, width = settings.input
    wide, high = frame.size
    small = np.asarray(cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    boxes, scores, kinds = _decoded(network.scores(small[None]), settings)
    # Centres of pixels are whole numbers, before and after the change of size.
    grow = np.array([wide / width, high / height] * 2)
    boxes = (boxes + 0.5) * grow - 0.5
    out = list(detections)
    free = set(range(len(out)))
    for box, score, kind in zip(boxes, scores, kinds, strict=True):
        label = settings.labels[kind]
        shared = {k: _overlap(box, out[k]) for k in free}
        best = max(shared, key=lambda k: shared[k], default=None)
        if best is not None and shared[best] >= _SAME:
            free.remove(best)
            out[best] = replace(out[best], label=label)
        elif all(_overlap(box, item) < _SAME for item in out):
            seen = _box(frame, box, float(score), label)
            out += [seen] if seen is not None else []
    return out


def _decoded(values: Floats32, settings: Model) -> tuple[NDArray[np.float64], Floats32, list[int]]:
    """Boxes (n, 4) x0, y0, x1, y1 in px of the input, their scores and classes, the surest first, each part once."""
    rows = values.reshape(-1, values.shape[-1])
    if settings.layout == "corners":
        boxes, scores, kinds = rows[:, :4], rows[:, 4], np.rint(rows[:, 5]).astype(int)
    else:
        columns = values.reshape(values.shape[-2], values.shape[-1]).T
        half = columns[:, 2:4] / 2.0
        boxes = np.concatenate([columns[:, :2] - half, columns[:, :2] + half], axis=1)
        kinds = columns[:, 4:].argmax(axis=1)
        scores = columns[np.arange(len(columns)), 4 + kinds]
    keep = (scores >= settings.least) & (kinds >= 0) & (kinds < len(settings.labels))
    keep &= (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])
    boxes, scores, kinds = boxes[keep], scores[keep], kinds[keep]
    # What overlaps a surer box is the same part, whatever it is called.
    sides = [(x0, y0, x1 - x0, y1 - y0) for x0, y0, x1, y1 in boxes.tolist()]
    chosen = [int(k) for k in np.ravel(cv2.dnn.NMSBoxes(sides, scores.tolist(), settings.least, _SAME))]
    return np.asarray(boxes[chosen], np.float64), scores[chosen], [int(kinds[k]) for k in chosen]


def _overlap(box: NDArray[np.float64], item: Detection) -> float:
    """What a box and a detection's box share, over what they cover together."""
    x, y, w, h = item.bbox_px
    across = min(box[2], x + w) - max(box[0], x)
    down = min(box[3], y + h) - max(box[1], y)
    if across <= 0.0 or down <= 0.0:
        return 0.0
    shared = float(across * down)
    return shared / (float((box[2] - box[0]) * (box[3] - box[1])) + w * h - shared)


def _box(frame: Frame, box: NDArray[np.float64], score: float, label: str) -> Detection | None:
    """A detection that is no more than a box; None when nothing of it lies in the picture."""
    wide, high = frame.size
    x0, y0 = max(float(box[0]), 0.0), max(float(box[1]), 0.0)
    x1, y1 = min(float(box[2]), wide - 1.0), min(float(box[3]), high - 1.0)
    w, h = x1 - x0, y1 - y0
    if w < 2.0 or h < 2.0:
        return None
    # Counter-clockwise as displayed, in pieces as short as other outlines have them.
    corners = np.array([[x0, y0], [x0, y1], [x1, y1], [x1, y0]])
    steps = np.arange(8)[:, None] / 8.0
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    outline = np.concatenate([a + steps * (b - a) for a, b in sides])
    cut = x0 <= 0.0 or y0 <= 0.0 or x1 >= wide - 1.0 or y1 >= high - 1.0
    area = w * h
    return Detection(
        frame=frame,
        shape=Shape.OTHER,
        score=score,
        outline_px=outline,
        center_px=((x0 + x1) / 2.0, (y0 + y1) / 2.0),
        size_px=(max(w, h), min(w, h)),
        angle=0.0 if w >= h else np.pi / 2.0,
        area_px=area,
        bbox_px=(x0, y0, w, h),
        descriptors=Descriptors(1.0, (w + h) ** 2 / (np.pi * area), abs(w - h)),
        label=label,
        flags=frozenset({BOX, "cut_by_border"} if cut else {BOX}),
    )

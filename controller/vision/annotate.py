"""Pictures of what was detected, for people: readable from a thumbnail's size to a large sensor's."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection, LocatedObject, Shape

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]
Colour = tuple[int, int, int]
Box = tuple[int, int, int, int]

# Okabe and Ito's palette, which colour-blind people can tell apart; BGR.
COLOURS: Mapping[Shape, Colour] = {
    Shape.SQUARE: (0, 159, 230),
    Shape.RECTANGLE: (233, 180, 86),
    Shape.CIRCLE: (115, 158, 0),
    Shape.HEXAGON: (167, 121, 204),
    Shape.TRIANGLE: (66, 228, 240),
    Shape.OTHER: (200, 200, 200),
}
_DARK: Colour = (32, 28, 26)
_WHITE: Colour = (250, 250, 250)
_RED: Colour = (0, 0, 255)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SMALLEST_WIDTH = 960
"""Narrower pictures are enlarged, so that the writing does not cover the objects."""


def annotate(
    image: Image, detections: Sequence[Detection], *, located: Sequence[LocatedObject] = (), legend: bool = True
) -> Image:
    """The picture with every object's outline, axes, name, score and, when known, millimetres.

    A picture narrower than 960 px is enlarged by a whole number first.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8, BGR; left untouched.
        detections: What was seen in it.
        located: Where it lies on the table, for the detections that were located.
        legend: Whether to add a bar below with the meaning of the colours and the counts.
    """
    grow = max(1, math.ceil(_SMALLEST_WIDTH / image.shape[1]))
    canvas = np.array(image, np.uint8)
    if grow > 1:
        canvas = np.asarray(cv2.resize(image, None, fx=grow, fy=grow, interpolation=cv2.INTER_CUBIC), np.uint8)
    unit = max(1.0, math.hypot(*canvas.shape[:2]) / 1100.0)
    on_table = {id(item.detection): item for item in located}
    for item in detections:
        _draw_outline(canvas, item, grow, unit)
    taken: list[Box] = []
    boxes = [_box(item, grow) for item in detections]
    for item in detections:
        _draw_label(canvas, item, on_table.get(id(item)), grow, unit, boxes, taken)
    if legend:
        canvas = _with_legend(canvas, detections, unit)
    return canvas


def annotate_paper(image: Image, detections: Sequence[Detection]) -> Image:
    """The paper's figure 2: a red bounding box and a red centroid for every object, nothing else."""
    canvas = np.array(image, np.uint8)
    unit = max(1.0, math.hypot(*canvas.shape[:2]) / 800.0)
    for item in detections:
        x, y, w, h = item.bbox_px
        corners = _fixed(np.array([[x, y], [x + w, y + h]]))
        cv2.rectangle(canvas, corners[0].tolist(), corners[1].tolist(), _RED, round(2 * unit), cv2.LINE_AA, shift=4)
        center = _fixed(np.array([item.center_px]))[0].tolist()
        cv2.circle(canvas, center, round(4 * unit * 16), _RED, -1, cv2.LINE_AA, shift=4)
    return canvas


def _fixed(points: Floats) -> NDArray[np.int32]:
    """Points in OpenCV's fixed point with four fractional bits."""
    return np.rint(points * 16.0).astype(np.int32)


def _grown(points: Floats, grow: int) -> Floats:
    """Pixels of the picture as pixels of the enlarged one."""
    return points * grow + (grow - 1) / 2.0


def _draw_outline(canvas: Image, item: Detection, grow: int, unit: float) -> None:
    """Outline with a dark rim, and the axes of the object in its centre."""
    colour = COLOURS[item.shape]
    outline = _fixed(_grown(item.outline_px, grow))[:, None]
    thick = max(1, round(2.0 * unit))
    cv2.polylines(canvas, [outline], True, _DARK, thick + 2, cv2.LINE_AA, shift=4)
    cv2.polylines(canvas, [outline], True, colour, thick, cv2.LINE_AA, shift=4)
    center = _grown(np.array([item.center_px]), grow)[0]
    length = 0.32 * item.size_px[1] * grow
    turn = 0.0 if item.angle is None else item.angle
    x_axis = np.array([math.cos(turn), -math.sin(turn)]) * length
    y_axis = np.array([-math.sin(turn), -math.cos(turn)]) * length
    for axis, shade in ((y_axis, _WHITE), (x_axis, colour)):
        ends = _fixed(np.stack([center, center + axis]))
        cv2.line(canvas, ends[0].tolist(), ends[1].tolist(), _DARK, thick + 2, cv2.LINE_AA, shift=4)
        cv2.line(canvas, ends[0].tolist(), ends[1].tolist(), shade, thick, cv2.LINE_AA, shift=4)
    at = _fixed(center[None])[0].tolist()
    cv2.circle(canvas, at, round(3.0 * unit * 16), _DARK, -1, cv2.LINE_AA, shift=4)
    cv2.circle(canvas, at, round(2.0 * unit * 16), _WHITE, -1, cv2.LINE_AA, shift=4)


def _lines(item: Detection, place: LocatedObject | None) -> list[str]:
    name = item.label or str(item.shape)
    marks = "".join(f" {flag.replace('_', ' ')}" for flag in sorted(item.flags))
    lines = [f"{name} {item.score:.2f}"]
    if marks:
        lines.append(marks.strip())
    if place is not None:
        lines.append(f"{place.center[0]:.1f}, {place.center[1]:.1f} mm")
    return lines


def _box(item: Detection, grow: int) -> Box:
    """Bounding box in the enlarged picture."""
    points = _grown(item.outline_px, grow)
    low, high = points.min(axis=0), points.max(axis=0)
    return round(low[0]), round(low[1]), round(high[0] - low[0]), round(high[1] - low[1])


def _draw_label(
    canvas: Image,
    item: Detection,
    place: LocatedObject | None,
    grow: int,
    unit: float,
    objects: Sequence[Box],
    taken: list[Box],
) -> None:
    """Name, score and millimetres on a dark plate where they hide least."""
    lines = _lines(item, place)
    scale, thick = 0.42 * unit, max(1, round(unit))
    sizes = [cv2.getTextSize(line, _FONT, scale, thick)[0] for line in lines]
    pad = round(4 * unit)
    row = max(size[1] for size in sizes) + round(5 * unit)
    width, height = max(size[0] for size in sizes) + 3 * pad, row * len(lines) + pad
    points = _grown(item.outline_px, grow)
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2.0
    spots = []
    for gap in (5.0 * unit, 5.0 * unit + height, 5.0 * unit + 2 * height):
        spots += [
            (middle[0] - width / 2, low[1] - height - gap),
            (middle[0] - width / 2, high[1] + gap),
            (high[0] + gap, middle[1] - height / 2),
            (low[0] - width - gap, middle[1] - height / 2),
            (high[0] + gap, low[1] - height - gap),
            (low[0] - width - gap, high[1] + gap),
        ]
    rows, columns = canvas.shape[:2]
    boxes = [
        (round(min(max(x, 0), columns - width)), round(min(max(y, 0), rows - height)), width, height) for x, y in spots
    ]
    cost = [
        3.0 * sum(_shared(box, other) for other in taken)
        + sum(_shared(box, other) for other in objects)
        # Nearer is better, by a little.
        + 0.02 * i * width * height
        for i, box in enumerate(boxes)
    ]
    x, y, width, height = boxes[int(np.argmin(cost))]
    taken.append((x, y, width, height))
    x1, y1 = min(columns, x + width), min(rows, y + height)
    plate = canvas[max(0, y) : y1, max(0, x) : x1]
    plate[:] = np.rint(0.25 * plate.astype(np.float32) + 0.75 * np.array(_DARK, np.float32)).astype(np.uint8)
    cv2.rectangle(canvas, (x, y), (x + max(2, round(3 * unit)), y1 - 1), COLOURS[item.shape], -1)
    for i, line in enumerate(lines):
        at = (x + 2 * pad, y + row * (i + 1) - round(2 * unit))
        cv2.putText(canvas, line, at, _FONT, scale, _WHITE, thick, cv2.LINE_AA)


def _shared(a: Box, b: Box) -> float:
    """Area two boxes (x, y, width, height) share."""
    w = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    h = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    return float(max(w, 0) * max(h, 0))


def _with_legend(canvas: Image, detections: Sequence[Detection], unit: float) -> Image:
    """The picture with a bar below it: each shape's colour and count."""
    counts = Counter(item.shape for item in detections)
    scale, thick = 0.5 * unit, max(1, round(unit))
    row = round(30 * unit)
    entries = [(shape, f"{shape} {counts[shape]}") for shape in Shape if counts[shape]]
    title = f"{len(detections)} object{'s' if len(detections) != 1 else ''}"
    items: list[tuple[Colour | None, str]] = [(None, title)]
    items += [(COLOURS[shape], text) for shape, text in entries]
    pad, swatch = round(10 * unit), round(14 * unit)
    placed: list[tuple[int, int, Colour | None, str]] = []
    x, line = pad, 0
    for colour, text in items:
        width = cv2.getTextSize(text, _FONT, scale, thick)[0][0] + (swatch + pad if colour else 0) + 2 * pad
        if x + width > canvas.shape[1] and x > pad:
            x, line = pad, line + 1
        placed.append((x, line, colour, text))
        x += width
    bar = np.empty((row * (line + 1), canvas.shape[1], 3), np.uint8)
    bar[:] = _DARK
    for left, at_line, colour, text in placed:
        base = at_line * row + row // 2
        start = left
        if colour is not None:
            cv2.rectangle(bar, (left, base - swatch // 2), (left + swatch, base + swatch // 2), colour, -1)
            start += swatch + pad
        height = cv2.getTextSize(text, _FONT, scale, thick)[0][1]
        cv2.putText(bar, text, (start, base + height // 2), _FONT, scale, _WHITE, thick, cv2.LINE_AA)
    return np.vstack([canvas, bar])

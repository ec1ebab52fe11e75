"""One frame in, its objects out: the recipe decides how."""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Descriptors, Detection, Frame, Shape
from controller.geometry import PlaneMap, wrap
from controller.vision.appearance.look import look, named
from controller.vision.classes.taught import Taught
from controller.vision.models import naming
from controller.vision.models.network import network
from controller.vision.morphology import Component
from controller.vision.precise import search
from controller.vision.recipe import Ranges, Recipe
from controller.vision.scene import Found
from controller.vision.shapes import rotated
from controller.vision.stages import classified, margin, run_stages
from controller.vision.timing import Stopwatch

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Detected:
    """What was found in one frame.

    Attributes:
        detections: The objects, top to bottom.
        timing_ms: Time of each stage and in `total`, ms.
    """

    detections: tuple[Detection, ...]
    timing_ms: Mapping[str, float]


def detect(
    frame: Frame,
    recipe: Recipe,
    *,
    plane: PlaneMap | None = None,
    background: NDArray[np.uint8] | None = None,
    region: NDArray[np.uint8] | None = None,
    trace: MutableMapping[str, NDArray[np.generic]] | None = None,
    classes: Taught | None = None,
) -> Detected:
    """Objects in a frame; an empty table gives an empty tuple.

    Args:
        frame: The frame.
        recipe: What to do.
        plane: The plane of the objects' top faces: shape and centre are decided there; in pixels when None.
        background: ndarray of shape (H, W, 3), dtype uint8: the same view of the empty table.
        region: ndarray of shape (H, W), dtype uint8: only objects whose centre lies where it is not 0 are returned.
        trace: Receives the image after every stage by its name.
        classes: Taught classes, whose names become labels.

    Raises:
        InputError: The recipe needs a picture of the empty table and got none of this size, or a gray card that
            cannot be measured; or the classes were taught in mm and there is no plane.
        ConfigError: The recipe's trained model is not what the recipe says.
    """
    watch = Stopwatch()
    image = frame.image
    if min(image.shape[:2]) < 8:
        return Detected((), watch.result())
    if recipe.method == "stages":
        mask = run_stages(image, recipe.stages, background=background, trace=trace, watch=watch)
        detections = [_component(frame, *item, recipe.ranges) for item in classified(mask, recipe.ranges)]
    else:
        found = search(
            image, recipe.precise, plane=plane, background=background, region=region, trace=trace, watch=watch
        )
        detections = [_detection(frame, item) for item in found]
    if recipe.model is not None:
        detections = naming.named(frame, detections, network(recipe.model))
        watch.lap("model")
    if region is not None:
        detections = [item for item in detections if _inside(region, item.center_px)]
    detections.sort(key=lambda item: (item.center_px[1], item.center_px[0]))
    watch.lap("describe")
    if recipe.appearance.colour or recipe.appearance.texture or classes is not None:
        surfaces = look(image, detections, recipe.appearance)
        detections = named(detections, surfaces, recipe.appearance)
        watch.lap("appearance")
        if classes is not None:
            detections = classes.label(detections, surfaces, plane)
            watch.lap("classes")
    return Detected(tuple(detections), watch.result())


def _inside(region: NDArray[np.uint8], center: tuple[float, float]) -> bool:
    x, y = round(center[0]), round(center[1])
    return 0 <= y < region.shape[0] and 0 <= x < region.shape[1] and bool(region[y, x])


def _detection(frame: Frame, found: Found) -> Detection:
    outline = counter_clockwise(found.outline)
    face = outline if found.face is found.outline else counter_clockwise(found.face)
    points = outline.astype(np.float32)
    covered = polygon_area(outline)
    (_, (w, h), _) = cv2.minAreaRect(points)
    size = (max(w, h), min(w, h))
    low, high = outline.min(axis=0), outline.max(axis=0)
    if found.diameter is not None:
        size = (found.diameter, found.diameter)
        covered *= _circle_area_factor(len(outline))
    side = rotated(outline) - outline
    perimeter = float(np.hypot(side[:, 0], side[:, 1]).sum())
    sides = np.linalg.norm(face[:3] - rotated(face)[:3], axis=1)
    box = high - low
    difference = 0.0 if found.shape is Shape.CIRCLE else float(abs(sides[0] - sides[1]))
    return Detection(
        frame=frame,
        shape=found.shape,
        score=found.score,
        outline_px=dense(outline),
        center_px=(float(found.center[0]), float(found.center[1])),
        size_px=(float(size[0]), float(size[1])),
        angle=direction(found.shape, face),
        area_px=covered,
        bbox_px=(float(low[0]), float(low[1]), float(box[0]), float(box[1])),
        descriptors=Descriptors(
            float(box[0] * box[1]) / max(covered, 1e-9), perimeter**2 / (4.0 * math.pi * max(covered, 1e-9)), difference
        ),
        label=str(found.shape),
        flags=found.flags,
    )


def _component(
    frame: Frame,
    item: Component,
    values: Descriptors,
    shape: Shape,
    outline: Floats,
    covered: float,
    ranges: Ranges,
) -> Detection:
    """What a recipe of stages says of one component: the toolbox's measures, the ellipse's orientation."""
    (_, (w, h), _) = cv2.minAreaRect(outline.astype(np.float32))
    x, y, wide, high = item.bbox
    width, height = frame.size
    cut = x < 0.0 or y < 0.0 or x + wide > width - 1 or y + high > height - 1
    return Detection(
        frame=frame,
        shape=shape,
        score=margin(values, shape, ranges),
        outline_px=counter_clockwise(outline),
        center_px=item.centroid,
        # Boundary pixels are centres: half a pixel is missing on every side.
        size_px=(max(w, h) + 1.0, min(w, h) + 1.0),
        angle=math.radians(item.orientation),
        area_px=covered,
        bbox_px=item.bbox,
        descriptors=values,
        label=str(shape),
        flags=frozenset({"cut_by_border"} if cut else ()),
    )


def counter_clockwise(outline: Floats) -> Floats:
    """The outline's points in counter-clockwise order as displayed (y down)."""
    x, y = outline[:, 0], outline[:, 1]
    doubled = float(np.sum(x * rotated(y) - rotated(x) * y))
    return np.ascontiguousarray(outline[::-1] if doubled > 0.0 else outline)


def dense(outline: Floats, least: int = 32) -> Floats:
    """The outline with every side cut into equal pieces, corners kept, at least `least` points in all."""
    if len(outline) >= least:
        return outline
    side = rotated(outline) - outline
    length = np.linalg.norm(side, axis=1)
    pieces = np.maximum(np.ceil(least * length / max(float(length.sum()), 1e-9)), 1).astype(int)
    parts = [a + s * (np.arange(n) / n)[:, None] for a, s, n in zip(outline, side, pieces, strict=True)]
    return np.concatenate(parts)


def polygon_area(outline: Floats) -> float:
    """Area of a simple polygon of shape (N, 2)."""
    x, y = outline[:, 0], outline[:, 1]
    return 0.5 * abs(float(np.sum(x * rotated(y) - rotated(x) * y)))


def _circle_area_factor(corners: int) -> float:
    """Area of a circle over that of the regular polygon with corners on it."""
    turn = 2.0 * math.pi / corners
    return turn / math.sin(turn)


def direction(shape: Shape, outline: Floats) -> float | None:
    """Direction of an outline, rad, counter-clockwise as displayed, by the convention of its shape."""
    period = shape.period
    if period is None:
        return None
    if shape is Shape.OTHER:
        (_, (w, h), turn) = cv2.minAreaRect(outline.astype(np.float32))
        return wrap(-math.radians(turn + (0.0 if w >= h else 90.0)), period)
    sides = rotated(outline) - outline
    lengths = np.linalg.norm(sides, axis=1)
    angles = np.arctan2(-sides[:, 1], sides[:, 0])
    if shape is Shape.RECTANGLE:
        first = int(lengths[0] + lengths[2] < lengths[1] + lengths[3])
        angles, lengths = angles[first::2], lengths[first::2]
    elif shape is Shape.TRIANGLE and lengths.max() > 1.1 * lengths.min():
        angles = angles[[int(lengths.argmax())]]
        lengths = np.ones(1)
    # The mean over the sides, each as long as it counts, modulo the period.
    mean = np.angle(np.sum(lengths * np.exp(2j * math.pi * angles / period)))
    return wrap(float(mean) * period / (2.0 * math.pi), period)

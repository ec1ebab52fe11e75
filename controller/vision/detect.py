"""One frame in, its objects out: the recipe decides how."""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Descriptors, Detection, Frame, Shape
from controller.geometry import PlaneMap
from controller.vision.appearance.look import look, named, names
from controller.vision.classes.taught import Taught
from controller.vision.describe import Rings, described
from controller.vision.models import naming
from controller.vision.models.network import network
from controller.vision.morphology import Component
from controller.vision.precise import search
from controller.vision.recipe import Ranges, Recipe
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
    hidden: NDArray[np.uint8] | None = None,
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
        hidden: ndarray of shape (H, W), dtype uint8: where it is not 0 something known hides the table, and nothing is
            looked for there. Recipes of stages do without.
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
            image, recipe.precise,
            plane=plane, background=background, region=region, hidden=hidden, trace=trace, watch=watch,
        )  # fmt: skip
        detections = described(frame, found)
    if recipe.model is not None:
        detections = naming.named(frame, detections, network(recipe.model))
        watch.lap("model")
    if region is not None:
        detections = [item for item in detections if _inside(region, item.center_px)]
    detections.sort(key=lambda item: (item.center_px[1], item.center_px[0]))
    watch.lap("describe")
    if recipe.appearance.colour or recipe.appearance.texture or classes is not None:
        surfaces = look(image, detections, recipe.appearance)
        said = names(surfaces, recipe.appearance)
        watch.lap("appearance")
        labels = classes.names(detections, surfaces, plane) if classes is not None else ()
        detections = named(detections, surfaces, said, labels)
        watch.lap("classes")
    return Detected(tuple(detections), watch.result())


def _inside(region: NDArray[np.uint8], center: tuple[float, float]) -> bool:
    x, y = round(center[0]), round(center[1])
    return 0 <= y < region.shape[0] and 0 <= x < region.shape[1] and bool(region[y, x])


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
        outline_px=Rings([outline]).counter_clockwise().ring(0),
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

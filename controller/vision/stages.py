"""Recipes of stages: textbook operators one after the other, then the paper's sorting of what remains."""

from __future__ import annotations

import math
from collections.abc import MutableMapping

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Descriptors, Shape
from controller.errors import InputError
from controller.vision import edges, morphology, operators, recipe
from controller.vision.descriptors import classify, describe
from controller.vision.morphology import Component, Mask, components
from controller.vision.read import read_image
from controller.vision.timing import Stopwatch

Image = NDArray[np.uint8]


def run_stages(
    image: Image,
    stages: tuple[recipe.Stage, ...],
    *,
    background: Image | None = None,
    trace: MutableMapping[str, NDArray[np.generic]] | None = None,
    watch: Stopwatch,
) -> Mask:
    """Mask (0, 1) that the stages make of a picture.

    Raises:
        InputError: A stage needs a picture of the empty table and there is none.
    """
    binary = False
    value = image
    for number, stage in enumerate(stages, start=1):
        value, binary = _apply(value, binary, stage, image, background)
        watch.lap(f"{number:02d} {stage.op}")
        if trace is not None:
            trace[f"{number:02d}_{stage.op}"] = value * np.uint8(255) if binary else value
    return value if binary else (operators.gray(value) > 0).astype(np.uint8)


def _apply(
    value: Image, binary: bool, stage: recipe.Stage, image: Image, background: Image | None
) -> tuple[Image, bool]:
    """One stage's result and whether it is a mask."""
    match stage:
        case recipe.Unsharp():
            return operators.unsharp_mask(value, stage.radius, stage.amount), False
        case recipe.Gray():
            return operators.gray(value), False
        case recipe.Median():
            return operators.median(value, stage.size), binary
        case recipe.Average():
            return operators.average(value, stage.size), False
        case recipe.Gaussian():
            return operators.gaussian(value, stage.sigma), False
        case recipe.Stretch():
            return operators.stretch(operators.gray(value), stage.low, stage.high), False
        case recipe.Equalise():
            return operators.equalise(operators.gray(value)), False
        case recipe.Homomorphic():
            plain = operators.gray(value)
            return operators.homomorphic(plain, stage.sigma_share, stage.low_gain, stage.high_gain), False
        case recipe.Canny():
            return edges.canny(operators.gray(value), stage.sigma, stage.low, stage.high), True
        case recipe.Gradient():
            return edges.gradient_edges(operators.gray(value), stage.op, stage.threshold), True
        case recipe.ZeroCrossings():
            return edges.zero_crossings(operators.gray(value), stage.sigma, stage.threshold), True
        case recipe.Otsu():
            return operators.otsu(operators.gray(value)), True
        case recipe.FrameDifference():
            if background is None or background.shape != image.shape:
                raise InputError(
                    "the recipe compares with the empty table, and there is no such picture of this size",
                    "pass one with --background",
                )
            return operators.frame_difference(image, background, stage.threshold, stage.block), True
        case recipe.TemplateMatch():
            template = operators.gray(read_image(stage.template))
            return operators.match_template(operators.gray(value), template, stage.scales, stage.threshold), True
        case recipe.FillHoles():
            return morphology.fill_holes(value, stage.connectivity), True
        case recipe.AreaOpen():
            pixels = round(stage.pixels * max(1.0, value.size / (640 * 480)))
            return morphology.area_open(value, pixels), True
        case recipe.Disk():
            operation = morphology.open_disk if stage.op == "open_disk" else morphology.close_disk
            return operation(value, stage.radius), True


def classified(
    mask: Mask, ranges: recipe.Ranges
) -> list[tuple[Component, Descriptors, Shape, NDArray[np.float64], float]]:
    """Every component with its variables, class, outline (N, 2) in px, and area by `bwarea`."""
    found = []
    for item in components(mask):
        values = describe(item.mask)
        covered = morphology.bwarea(item.mask)
        outline = morphology.boundary(item.mask) + np.array([item.bbox[0] + 0.5, item.bbox[1] + 0.5])
        simple = cv2.approxPolyDP(outline.astype(np.float32)[:, None], 0.5, True)[:, 0].astype(np.float64)
        found.append((item, values, classify(values, covered, ranges), simple, covered))
    return found


def margin(values: Descriptors, shape: Shape, ranges: recipe.Ranges) -> float:
    """Confidence of a class in [0, 1]: how far the extent lies from the nearest limit of its range, logistic."""
    limits = {
        Shape.SQUARE: (1.0, ranges.four_sided_extent),
        Shape.RECTANGLE: (1.0, ranges.four_sided_extent),
        Shape.CIRCLE: (ranges.four_sided_extent, ranges.circle_extent),
        Shape.HEXAGON: ranges.hexagon_extent,
    }.get(shape)
    if limits is None:
        return 0.5
    low, high = limits
    inside = min(values.extent - low, high - values.extent) if low > 1.0 else high - values.extent
    return 1.0 / (1.0 + math.exp(-40.0 * inside))

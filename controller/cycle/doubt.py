"""What looks like a part of known shape and is not to be believed: it is sorted as what has none."""

from __future__ import annotations

import dataclasses

from controller.domain import LocatedObject, Shape


def nameless(thing: LocatedObject) -> LocatedObject:
    """The thing without what it was taken for."""
    detection = dataclasses.replace(thing.detection, shape=Shape.OTHER, label=str(Shape.OTHER))
    return dataclasses.replace(thing, detection=detection)


TALL_MM = 45.0
"""A prism on its side is as high as one of its own sides: this much may stand there."""


_ALIKE_SIGMAS = 4.0
"""Deviations of a place by which two sides that are alike differ at most: 3 of their difference."""


def toppled(thing: LocatedObject) -> LocatedObject:
    """A thing that lies on its side: it has no name, and is higher than it was taken for."""
    return dataclasses.replace(nameless(thing), height=max(thing.height, TALL_MM))


def may_be_square(thing: LocatedObject) -> bool:
    """Whether a rectangle's sides are as long as each other by all that is known; a taught class knows its own views.

    Args:
        thing: What was located.
    """
    alike = thing.size[0] - thing.size[1] < _ALIKE_SIGMAS * thing.sigma
    return thing.shape is Shape.RECTANGLE and thing.detection.label == str(thing.shape) and alike


def lies_on_its_side(thing: LocatedObject, narrowest: float) -> bool:
    """Whether a thing is narrower than any part that lies as it should; a taught class knows its own views.

    A prism that has toppled shows a side as long as one of its own and as wide as it was high: a rectangle.

    Args:
        thing: What was located.
        narrowest: Short side of the narrowest part, mm.
    """
    return thing.size[1] < narrowest and thing.detection.label == str(thing.shape)


def doubted(thing: LocatedObject, narrowest: float) -> LocatedObject:
    """A thing as it is to be sorted: without a name where it lies on its side, or is a rectangle that may be a square.

    Args:
        thing: What was located.
        narrowest: See `lies_on_its_side`.
    """
    if lies_on_its_side(thing, narrowest):
        return toppled(thing)
    return nameless(thing) if may_be_square(thing) else thing

"""Colour and texture of everything found in a frame, measured once and shared by rules and taught classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection
from controller.vision.appearance import colour, texture
from controller.vision.appearance.colour import Colour
from controller.vision.appearance.settings import Appearance
from controller.vision.appearance.tiles import Tiles, tiles

TWO_COLOURED = "two_coloured"


class Surfaces:
    """The surfaces of the detections that are large enough to be looked at; everything is measured when asked for.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8, BGR.
        detections: What was found in it.
        settings: What a recipe says about it.

    Attributes:
        image: The frame.
    """

    def __init__(self, image: NDArray[np.uint8], detections: Sequence[Detection], settings: Appearance) -> None:
        self.image = image
        self._detections = tuple(detections)
        self._settings = settings

    @cached_property
    def tiles(self) -> Tiles:
        """The parts' surfaces at one size."""
        return tiles(self.image, self._detections)

    @property
    def which(self) -> tuple[int, ...]:
        """Index of each surface among the detections."""
        return self.tiles.which

    @cached_property
    def colours(self) -> tuple[Colour, ...]:
        """Their colours.

        Raises:
            InputError: The gray card the recipe speaks of cannot be measured.
        """
        return tuple(colour.measure(self.image, self.tiles, self._settings))

    @cached_property
    def textures(self) -> NDArray[np.float32]:
        """Texture descriptors: ndarray of shape (n, texture.LENGTH)."""
        return texture.descriptors(self.tiles)


def look(image: NDArray[np.uint8], detections: Sequence[Detection], settings: Appearance) -> Surfaces:
    """Surfaces of detections."""
    return Surfaces(image, detections, settings)


def named(detections: Sequence[Detection], surfaces: Surfaces, settings: Appearance) -> list[Detection]:
    """The detections with colour and texture filled in, as far as the settings ask for them.

    Raises:
        InputError: The gray card the recipe speaks of cannot be measured.
    """
    out = list(detections)
    if not settings.texture and not settings.colour:
        return out
    woven = texture.names_of(surfaces.textures) if settings.texture else []
    colours = surfaces.colours if settings.colour else ()
    for place, k in enumerate(surfaces.which):
        item = out[k]
        seen = colours[place] if colours else None
        two = seen is not None and seen.second is not None
        out[k] = replace(
            item,
            texture=woven[place] if woven else item.texture,
            colour=seen.name if seen is not None else item.colour,
            flags=item.flags | {TWO_COLOURED} if two else item.flags,
        )
    return out

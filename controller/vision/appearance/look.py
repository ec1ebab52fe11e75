"""Colour and texture of everything found in a frame, measured once and shared by rules and taught classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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


@dataclass(frozen=True, slots=True)
class Names:
    """What surfaces are called, in their order.

    Attributes:
        textures: Or empty, when the settings do not ask for them.
        colours: Likewise.
    """

    textures: Sequence[str | None] = ()
    colours: Sequence[Colour] = ()


def names(surfaces: Surfaces, settings: Appearance) -> Names:
    """Colours and textures of surfaces, as far as the settings ask for them.

    Raises:
        InputError: The gray card the recipe speaks of cannot be measured.
    """
    woven = texture.names(surfaces.tiles) if settings.texture else []
    return Names(woven, surfaces.colours if settings.colour else ())


def named(
    detections: Sequence[Detection], surfaces: Surfaces, said: Names, labels: Sequence[str | None] = ()
) -> list[Detection]:
    """The detections with colour, texture and label filled in where something was said.

    Args:
        detections: Those the surfaces were taken from.
        surfaces: n surfaces.
        said: What they are called.
        labels: n names of taught classes, None for unknown; or none at all.
    """
    out = list(detections)
    for place, k in enumerate(surfaces.which):
        item = out[k]
        seen = said.colours[place] if said.colours else None
        label = labels[place] if labels else None
        two = seen is not None and seen.second is not None
        if seen is None and label is None and not said.textures:
            continue
        out[k] = replace(
            item,
            label=item.label if label is None else label,
            texture=said.textures[place] if said.textures else item.texture,
            colour=seen.name if seen is not None else item.colour,
            flags=item.flags | {TWO_COLOURED} if two else item.flags,
        )
    return out

"""Colour and texture of everything found in a frame, measured once and shared by rules and taught classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from controller.domain import Detection
from controller.vision.appearance import colour, texture
from controller.vision.appearance.colour import Colour
from controller.vision.appearance.patch import Image, Patch, cut_out
from controller.vision.appearance.settings import Appearance
from controller.vision.appearance.tiles import Tiles, tiles

TWO_COLOURED = "two_coloured"


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """The surfaces of the detections that are large enough to be looked at.

    Attributes:
        which: Index of each among the detections.
        patches: Their pixels.
        tiles: The same at one size.
        colours: Their colours.
        textures: ndarray of shape (n, texture.LENGTH): texture descriptors.
    """

    which: tuple[int, ...]
    patches: tuple[Patch, ...]
    tiles: Tiles
    colours: tuple[Colour, ...]
    textures: NDArray[np.float32]


def look(image: Image, detections: Sequence[Detection], settings: Appearance) -> Surfaces:
    """Surfaces of detections.

    Raises:
        InputError: The gray card the recipe speaks of cannot be measured.
    """
    cut = [(k, patch) for k, patch in enumerate(cut_out(image, detections)) if patch is not None]
    patches = tuple(patch for _, patch in cut)
    surface = tiles(patches)
    return Surfaces(
        tuple(k for k, _ in cut),
        patches,
        surface,
        tuple(colour.measure(image, patches, settings)),
        texture.descriptors(surface),
    )


def named(detections: Sequence[Detection], surfaces: Surfaces, settings: Appearance) -> list[Detection]:
    """The detections with colour and texture filled in, as far as the settings ask for them."""
    out = list(detections)
    textures = texture.names_of(surfaces.textures) if settings.texture else [None] * len(surfaces.which)
    for k, seen, woven in zip(surfaces.which, surfaces.colours, textures, strict=True):
        item = replace(out[k], texture=woven)
        if settings.colour:
            flags = item.flags | {TWO_COLOURED} if seen.second is not None else item.flags
            item = replace(item, colour=seen.name, flags=flags)
        out[k] = item
    return out

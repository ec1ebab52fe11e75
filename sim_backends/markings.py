"""What is on the tops of parts: textures and prints, as pictures that the painter lays there."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from controller.domain import Shape
from sim_backends.painter_surface import Print
from sim_backends.parts import COLOURS, Part
from sim_backends.solids import Array

Image = NDArray[np.uint8]

_PER_MM = 8.0
_INK, _BLACK = 0.1, (22.0, 22.0, 24.0)
"""Black ink on paint of some colour, which shines through a little."""
_PITCH = 7.0
"""mm from stripe to stripe, dot to dot: five and more on the narrowest part."""


def _striped(x: Array, y: Array) -> NDArray[np.bool_]:
    return np.asarray(np.mod(x / _PITCH, 1.0) < 0.5)


def _checked(x: Array, y: Array) -> NDArray[np.bool_]:
    return np.asarray((np.mod(x / _PITCH, 1.0) < 0.5) ^ (np.mod(y / _PITCH, 1.0) < 0.5))


def _dotted(x: Array, y: Array) -> NDArray[np.bool_]:
    return np.asarray(np.hypot(np.mod(x / _PITCH, 1.0) - 0.5, np.mod(y / _PITCH, 1.0) - 0.5) < 0.3)


def _cross(x: Array, y: Array) -> NDArray[np.bool_]:
    return np.asarray(((np.abs(x) < 2.0) | (np.abs(y) < 2.0)) & (np.maximum(np.abs(x), np.abs(y)) < 8.0))


def _target(x: Array, y: Array) -> NDArray[np.bool_]:
    r = np.hypot(x, y)
    return np.asarray((r < 2.5) | ((r > 5.0) & (r < 7.5)))


def _arrow(x: Array, y: Array) -> NDArray[np.bool_]:
    shaft = (np.abs(y) < 1.6) & (x > -8.0) & (x < 2.0)
    return np.asarray(shaft | ((x >= 1.0) & (x + 1.1 * np.abs(y) < 8.0)))


MARKINGS: Mapping[str, Callable[[Array, Array], NDArray[np.bool_]]] = {
    "striped": _striped, "checked": _checked, "dotted": _dotted, "cross": _cross, "target": _target, "arrow": _arrow,
}  # fmt: skip
"""Where, in mm about the middle of a part's top, its second shade is."""
# Half the side of the square that the marking fills, as a share of the width between the jaws.
_REACH = {Shape.SQUARE: 0.45, Shape.RECTANGLE: 0.45, Shape.CIRCLE: 0.33, Shape.HEXAGON: 0.33, Shape.TRIANGLE: 0.21}


def marking_of(part: Part) -> Print:
    """The picture on a part's top, in the coordinates of its body."""
    half = _REACH[part.shape] * part.grip
    count = 2 * round(half * _PER_MM)
    pixel = 2.0 * half / count
    along = (np.arange(count) + 0.5) * pixel - half
    x, y = np.meshgrid(along, -along)
    first = np.array(COLOURS[part.colour])
    second = _INK * first + np.array(_BLACK)
    picture = np.where(MARKINGS[part.marking](x, y)[..., None], second, first)
    on_top = np.eye(4)
    on_top[2, 3] = part.height / 2.0
    return Print(np.asarray(np.rint(picture), np.uint8), pixel, on_top, y_up=True, ink=0.0, paper=255.0)

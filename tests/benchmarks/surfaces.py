"""Painted parts with colours, textures and prints under lamps of any warmth: the pictures of the appearance studies.

Everything is computed in linear light on a grid four times as fine as the camera's: reflectance times light,
averaged over the pixel, blurred, coded as sRGB, noise added.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.appearance.oklab import LINEAR

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Pattern = Callable[[Floats, Floats], Floats]
FINE = 4
TABLE = (196, 206, 212)


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """A flat part.

    Attributes:
        rings: Outer outline and holes, (N, 2) each, px about the origin, y down.
        colours: BGR codes in white light of the two shades the pattern mixes.
        x, y, turn: Where it lies, px and rad.
        pattern: Share (0..1) of the second shade at points (px, before turning).
    """

    rings: Sequence[Floats]
    colours: tuple[tuple[int, int, int], tuple[int, int, int]]
    x: float
    y: float
    turn: float
    pattern: Pattern = lambda x, y: np.zeros_like(x)


def linear_of(code: Sequence[float]) -> Floats:
    """Linear light of BGR codes."""
    return np.asarray(LINEAR[np.asarray(code, int)], np.float64)


def coded(light: Floats) -> Floats:
    """sRGB codes, not rounded, of linear light."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055) * 255.0


def paint(
    things: Sequence[Thing],
    size: tuple[int, int],
    random: np.random.Generator,
    *,
    light: Floats | None = None,
    blur: float = 0.7,
    noise: float = 2.0,
    table: Sequence[int] = TABLE,
) -> Image:
    """The picture; `light` (H, W, 3) multiplies the linear BGR reflectances."""
    width, height = size
    scene: Floats = np.empty((height, width, 3))
    scene[:] = linear_of(table) * (1.0 + 0.02 * random.standard_normal((height, width, 1)))
    for thing in things:
        _lay(scene, thing)
    if light is not None:
        scene *= light
    codes = coded(np.asarray(cv2.GaussianBlur(scene, (0, 0), blur), np.float64))
    codes += noise * random.standard_normal(codes.shape)
    return np.asarray(np.clip(np.rint(codes), 0, 255), np.uint8)


def outline(thing: Thing) -> Floats:
    """Outer outline (N, 2) of a part in the picture."""
    return _placed(thing.rings[0], thing)


def _placed(ring: Floats, thing: Thing) -> Floats:
    c, s = math.cos(thing.turn), math.sin(thing.turn)
    return np.asarray(ring @ np.array([[c, s], [-s, c]]) + (thing.x, thing.y))


def _lay(scene: Floats, thing: Thing) -> None:
    rings = [_placed(ring, thing) for ring in thing.rings]
    low = np.maximum(np.floor(rings[0].min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(rings[0].max(axis=0)).astype(int) + 3, scene.shape[1::-1])
    w, h = high - low
    fine = np.zeros((h * FINE, w * FINE), np.uint8)
    points = [np.rint(((ring - low + 0.5) * FINE - 0.5) * 256).astype(np.int32)[:, None] for ring in rings]
    cv2.fillPoly(fine, points, (1,), shift=8)
    v, u = np.mgrid[0 : h * FINE, 0 : w * FINE]
    px, py = (u + 0.5) / FINE - 0.5 + low[0] - thing.x, (v + 0.5) / FINE - 0.5 + low[1] - thing.y
    c, s = math.cos(thing.turn), math.sin(thing.turn)
    share = thing.pattern(c * px + s * py, -s * px + c * py)[..., None]
    first, second = (linear_of(code) for code in thing.colours)
    paint_ = (first * (1.0 - share) + second * share) * fine[..., None]
    cover = cv2.resize(fine.astype(np.float64), (int(w), int(h)), interpolation=cv2.INTER_AREA)[..., None]
    shown = cv2.resize(paint_, (int(w), int(h)), interpolation=cv2.INTER_AREA)
    roi = scene[low[1] : high[1], low[0] : high[0]]
    roi[:] = roi * (1.0 - cover) + shown


# --- outlines -----------------------------------------------------------------------------------------


def polygon(sides: int, radius: float = 1.0, turn: float = 0.0) -> Floats:
    """A regular polygon."""
    t = turn + np.arange(sides) * 2 * math.pi / sides
    return radius * np.stack([np.cos(t), np.sin(t)], axis=1)


def star(points: int, inner: float = 0.45) -> Floats:
    """A star."""
    t = np.arange(2 * points) * math.pi / points
    r = np.where(np.arange(2 * points) % 2, inner, 1.0)
    return np.stack([r * np.cos(t), r * np.sin(t)], axis=1)


def _gear(teeth: int = 10) -> Floats:
    t = np.arange(8 * teeth) * 2 * math.pi / (8 * teeth)
    r = np.where(np.arange(8 * teeth) % 8 < 4, 1.0, 0.78)
    return np.stack([r * np.cos(t), r * np.sin(t)], axis=1)


def _heart() -> Floats:
    t = np.arange(120) * 2 * math.pi / 120
    x = 16 * np.sin(t) ** 3
    y = -(13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t))
    return np.stack([x, y], axis=1) / 16.0


def _half_disc() -> Floats:
    t = np.arange(61) * math.pi / 60
    return np.stack([np.cos(t), np.sin(t) - 0.42], axis=1)


def _arrow() -> Floats:
    return np.array([[-1, -0.25], [0.1, -0.25], [0.1, -0.7], [1, 0], [0.1, 0.7], [0.1, 0.25], [-1, 0.25]])


def _bars(*boxes: tuple[float, float, float, float]) -> Floats:
    """The outline of touching boxes (x0, y0, x1, y1), by their picture."""
    mask = np.zeros((220, 220), np.uint8)
    for x0, y0, x1, y1 in boxes:
        low, high = (round(110 + 100 * x0), round(110 + 100 * y0)), (round(110 + 100 * x1), round(110 + 100 * y1))
        cv2.rectangle(mask, low, high, (255,), -1)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return np.asarray((contours[0][:, 0] - 110.0) / 100.0, np.float64)


SQUARE = np.array([[-0.8, -0.8], [0.8, -0.8], [0.8, 0.8], [-0.8, 0.8]])
KINDS: dict[str, list[Floats]] = {
    "L": [_bars((-0.8, -0.9, -0.2, 0.9), (-0.8, 0.3, 0.8, 0.9))],
    "T": [_bars((-0.9, -0.9, 0.9, -0.3), (-0.3, -0.9, 0.3, 0.9))],
    "star": [star(5)],
    "ring": [polygon(72), polygon(72, 0.5)],
    "cross": [_bars((-0.3, -0.95, 0.3, 0.95), (-0.95, -0.3, 0.95, 0.3))],
    "gear": [_gear()],
    "half disc": [_half_disc()],
    "heart": [_heart()],
}
UNKNOWN: dict[str, list[Floats]] = {
    "arrow": [_arrow()],
    "pentagon": [polygon(5)],
    "S": [_bars((-0.9, -0.6, 0.2, 0.0), (-0.2, 0.0, 0.9, 0.6))],
    "U": [_bars((-0.8, -0.8, -0.3, 0.8), (0.3, -0.8, 0.8, 0.8), (-0.8, 0.3, 0.8, 0.8))],
    "nut": [polygon(6), polygon(60, 0.5)],
    "star of eight": [star(8, 0.6)],
    "kite": [np.array([[-1.0, 0.0], [0.2, -0.6], [0.8, 0.0], [0.2, 0.6]])],
    "frame": [SQUARE, 0.55 * SQUARE],
}


def _crescent() -> Floats:
    t, u = np.linspace(-2.2, 2.2, 60), np.linspace(1.75, -1.75, 50)
    outer = np.stack([np.cos(t), np.sin(t)], axis=1)
    inner = np.stack([0.78 * np.cos(u) + 0.05, 0.83 * np.sin(u)], axis=1)
    return np.concatenate([outer, inner - (0.0, 0.0)]) * (-1.0, 1.0)


def _drop() -> Floats:
    t = np.linspace(0.7, 2.0 * math.pi - 0.7, 80)
    ring = np.stack([0.62 * np.cos(t) - 0.3, 0.62 * np.sin(t)], axis=1)
    return np.concatenate([ring, [[1.0, 0.0]]])


def _lens() -> Floats:
    t = np.linspace(-0.85, 0.85, 60)
    arc = np.stack([1.3 * np.sin(t), 1.3 * np.cos(t) - 0.858], axis=1)
    return np.concatenate([arc, -arc])


HELD_OUT: dict[str, list[Floats]] = {
    "house": [np.array([[-0.75, -0.1], [0.0, -0.95], [0.75, -0.1], [0.75, 0.85], [-0.75, 0.85]])],
    "crescent": [_crescent()],
    "drop": [_drop()],
    "lens": [_lens()],
    "H": [_bars((-0.85, -0.9, -0.35, 0.9), (0.35, -0.9, 0.85, 0.9), (-0.4, -0.25, 0.4, 0.25))],
    "F": [_bars((-0.7, -0.95, -0.15, 0.95), (-0.7, -0.95, 0.8, -0.45), (-0.2, -0.2, 0.5, 0.25))],
    "star of six": [star(6, 0.55)],
    "trapezium": [np.array([[-0.95, 0.6], [0.95, 0.6], [0.45, -0.6], [-0.45, -0.6]])],
}
"""Kinds that nothing was tuned on."""


# --- textures -----------------------------------------------------------------------------------------


def plain() -> Pattern:
    """One shade."""
    return lambda x, y: np.zeros_like(x)


def striped(pitch: float, phase: float) -> Pattern:
    """Bars as wide as their gaps."""
    return lambda x, y: (np.mod(x / pitch + phase, 1.0) < 0.5).astype(float)


def checked(pitch: float, phase: float) -> Pattern:
    """A chessboard."""
    return lambda x, y: ((np.mod(x / pitch + phase, 1.0) < 0.5) ^ (np.mod(y / pitch + phase, 1.0) < 0.5)).astype(float)


def dotted(pitch: float, phase: float, radius: float = 0.27) -> Pattern:
    """Round dots in rows."""
    return lambda x, y: (
        np.hypot(np.mod(x / pitch + phase, 1.0) - 0.5, np.mod(y / pitch + phase, 1.0) - 0.5) < radius
    ).astype(float)


def blotched(random: np.random.Generator, correlation: float, contrast: float = 0.33) -> Pattern:
    """Random shades with a correlation length (px): small is rough, large is marbled."""
    field = cv2.GaussianBlur(random.standard_normal((256, 256)), (0, 0), correlation * 2, borderType=cv2.BORDER_REFLECT)
    field = np.clip(0.5 + contrast * field / field.std(), 0.0, 1.0).astype(np.float32)

    def pattern(x: Floats, y: Floats) -> Floats:
        at_x, at_y = (np.clip(v * 2 + 128, 1, 254).astype(np.float32) for v in (x, y))
        return np.asarray(cv2.remap(field, at_x, at_y, cv2.INTER_LINEAR), np.float64)

    return pattern


# --- lamps --------------------------------------------------------------------------------------------


def lamp(kelvin: float) -> Floats:
    """Linear BGR light (3,) of a black body, the same luminance for all, white at 6500 K.

    Source: Planck's law at 610, 550 and 465 nm, the middles of sRGB's primaries.
    """
    waves = np.array([465e-9, 550e-9, 610e-9])

    def planck(t: float) -> Floats:
        return waves**-5.0 / (np.exp(0.014388 / (waves * t)) - 1.0)

    colour = planck(kelvin) / planck(6500.0)
    return np.asarray(colour / (colour @ np.array([0.0722, 0.7152, 0.2126])))


def field(size: tuple[int, int], kelvin: float, gain: float, gradient: float, direction: float) -> Floats:
    """Light (H, W, 3): a lamp's colour, an exposure, and a fall-off across the picture."""
    width, height = size
    v, u = np.mgrid[0:height, 0:width]
    along = (u / width - 0.5) * math.cos(direction) + (v / height - 0.5) * math.sin(direction)
    return np.asarray(gain * lamp(kelvin) * (1.0 - gradient * (along + 0.5))[..., None])

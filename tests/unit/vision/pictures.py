"""Pictures with known truth: convex shapes drawn by exact coverage, for the tests of vision."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.domain import Frame, Shape

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

FINE = 8


def corners(shape: Shape, size: float, turn: float = 0.0, aspect: float = 1.6) -> Floats:
    """Corners (N, 2) about the origin; `turn` is counter-clockwise as displayed, a side along it; y runs down."""
    if shape is Shape.CIRCLE:
        t = np.arange(360) * math.pi / 180.0
        return 0.5 * size * np.stack([np.cos(t), np.sin(t)], axis=1)
    if shape in (Shape.SQUARE, Shape.RECTANGLE):
        long = size * (aspect if shape is Shape.RECTANGLE else 1.0)
        flat = 0.5 * np.array([[-long, -size], [long, -size], [long, size], [-long, size]])
    else:
        sides = 6 if shape is Shape.HEXAGON else 3
        # The side between the first two corners runs along x.
        t = (np.arange(sides) - 0.5) * 2.0 * math.pi / sides + math.pi / 2.0
        flat = 0.5 * size * np.stack([np.cos(t), np.sin(t)], axis=1)
    c, s = math.cos(turn), math.sin(turn)
    return np.asarray(flat @ np.array([[c, -s], [s, c]]))


def at(outline: Floats, x: float, y: float) -> Floats:
    """An outline moved to (x, y), px."""
    return np.asarray(outline + np.array([x, y]))


def paint(
    things: list[tuple[Floats, tuple[float, float, float]]],
    size: tuple[int, int] = (320, 240),
    table: tuple[float, float, float] = (200.0, 200.0, 200.0),
    blur: float = 0.8,
    noise: float = 2.0,
    seed: int = 0,
) -> Image:
    """Outlines (N, 2), px, each in its BGR colour, on a plain table, supersampled, blurred and noisy."""
    picture: NDArray[np.float64] = np.empty((size[1], size[0], 3))
    picture[:] = table
    for outline, colour in things:
        fine = np.zeros((size[1] * FINE, size[0] * FINE), np.uint8)
        points = np.rint(((outline + 0.5) * FINE - 0.5) * 256.0).astype(np.int32)
        cv2.fillPoly(fine, [points[:, None]], (255,), shift=8)
        cover = cv2.resize(fine, size, interpolation=cv2.INTER_AREA).astype(float)[:, :, None] / 255.0
        picture = picture * (1.0 - cover) + np.array(colour) * cover
    soft = cv2.GaussianBlur(picture, (0, 0), blur)
    picture = soft + noise * np.random.default_rng(seed).standard_normal(picture.shape)
    return np.asarray(np.clip(np.rint(picture), 0, 255), np.uint8)


def frame(image: Image) -> Frame:
    """A frame of an image."""
    return Frame(1, 0.0, image, "test")

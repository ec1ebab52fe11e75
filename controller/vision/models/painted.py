"""Painted crops of parts to learn shapes from: outlines, colours, light, blur, noise and neighbours at random.

A part is a polygon with a side wall that a camera off its axis sees, drawn four times as fine as its pixels and
averaged. Parts are 16 to 110 px wide before they are brought to the network's size, as crops from a picture are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.models.crops import square

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Random = np.random.Generator

_FINE = 4
SHAPES = ("square", "rectangle", "circle", "hexagon", "triangle", "other")
"""Classes in order, as `controller.domain.Shape` calls them."""


def crops_of_shapes(count: int, seed: int, side: int, margin: float) -> tuple[Image, NDArray[np.int64]]:
    """Painted crops and their classes.

    Returns:
        ndarray of shape (count, side, side, 3), dtype uint8, BGR; ndarray of shape (count,): indices into SHAPES.
    """
    random = np.random.default_rng([seed, 21])
    # Other parts have many forms: a third of all.
    labels = random.choice(len(SHAPES), count, p=[2 / 15] * 5 + [1 / 3])
    images = np.stack([_crop(random, SHAPES[int(label)], side, margin) for label in labels])
    return images, labels.astype(np.int64)


def _crop(random: Random, kind: str, side: int, margin: float) -> Image:
    ring = _placed(random, _outline(random, kind))
    radius = float(np.sqrt((ring**2).sum(axis=1).max()))
    across = float(np.exp(random.uniform(math.log(16.0), math.log(110.0))))
    ring *= across / (2.0 * radius)
    canvas = math.ceil(margin * across * 1.25) + 4
    center = canvas / 2.0 + random.uniform(-0.5, 0.5, 2)
    picture = _painted(random, ring, kind, canvas, (float(center[0]), float(center[1])))
    # Detection's centre and radius are not exact, and a wall in view shifts both.
    shift = random.normal(0.0, 0.012 * across, 2)
    wide = margin * across * float(np.exp(random.normal(0.0, 0.03)))
    return square(picture, (float(center[0] + shift[0]), float(center[1] + shift[1])), wide, (side, side))


# --- outlines ---------------------------------------------------------------------------------------


def _regular(sides: int, phase: float = 0.0) -> Floats:
    t = phase + 2.0 * math.pi * np.arange(sides) / sides
    return np.stack([np.cos(t), np.sin(t)], axis=1)


def _outline(random: Random, kind: str) -> Floats:
    """A ring (N, 2) of about unit size."""
    if kind == "square":
        return _box(float(random.uniform(1.0, 1.05)))
    if kind == "rectangle":
        return _box(float(random.uniform(1.18, 3.2)))
    if kind == "circle":
        return _regular(64)
    if kind == "hexagon":
        return _regular(6)
    if kind == "triangle":
        ring = _regular(3)
        if random.random() < 0.4:
            ring = ring * (1.0, float(random.uniform(0.7, 1.35)))
        return np.asarray(ring)
    names = list(_OTHERS)
    return _OTHERS[names[int(random.integers(len(names)))]](random)


def _box(aspect: float) -> Floats:
    a, b = aspect / 2.0, 0.5
    return np.array([[-a, -b], [a, -b], [a, b], [-a, b]])


def _star(random: Random) -> Floats:
    points = int(random.integers(4, 9))
    r = np.where(np.arange(2 * points) % 2, float(random.uniform(0.35, 0.75)), 1.0)
    return _regular(2 * points) * r[:, None]


def _gear(random: Random) -> Floats:
    teeth = int(random.integers(6, 16))
    r = np.where(np.arange(8 * teeth) % 8 < 4, 1.0, float(random.uniform(0.72, 0.88)))
    return _regular(8 * teeth) * r[:, None]


def _cross(random: Random) -> Floats:
    w = float(random.uniform(0.2, 0.45))
    return np.array(
        [[w, 1], [w, w], [1, w], [1, -w], [w, -w], [w, -1], [-w, -1], [-w, -w], [-1, -w], [-1, w], [-w, w], [-w, 1]]
    )


def _angle(random: Random) -> Floats:
    t, h = float(random.uniform(0.35, 0.9)), float(random.uniform(0.7, 1.3))
    return np.array([[-1, -h], [-1 + t, -h], [-1 + t, h - t], [1, h - t], [1, h], [-1, h]])


def _tee(random: Random) -> Floats:
    t, w = float(random.uniform(0.4, 0.8)), float(random.uniform(0.2, 0.45))
    return np.array([[-1, -1], [1, -1], [1, -1 + t], [w, -1 + t], [w, 1], [-w, 1], [-w, -1 + t], [-1, -1 + t]])


def _channel(random: Random) -> Floats:
    w, d = float(random.uniform(0.25, 0.6)), float(random.uniform(0.0, 0.6))
    return np.array([[-1, -1], [-1 + w, -1], [-1 + w, d], [1 - w, d], [1 - w, -1], [1, -1], [1, 1], [-1, 1]])


def _part_of_disc(random: Random) -> Floats:
    reach = float(random.uniform(0.6, 1.6)) * math.pi
    t = np.linspace(0.0, reach, 49)
    ring = np.stack([np.cos(t), np.sin(t)], axis=1)
    return ring if random.random() < 0.5 else np.concatenate([ring, [[0.0, 0.0]]])


def _heart(random: Random) -> Floats:
    t = np.arange(96) * 2 * math.pi / 96
    y = -(13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t))
    return np.stack([16 * np.sin(t) ** 3, y], axis=1) / 16.0


def _oval(random: Random) -> Floats:
    return _regular(64) * (1.0, float(random.uniform(0.4, 0.82)))


def _slot(random: Random) -> Floats:
    ring = _regular(64)
    ring[:, 0] += np.where(ring[:, 0] > 0.0, 1.0, -1.0) * float(random.uniform(0.25, 2.0))
    return ring


def _polygon(random: Random) -> Floats:
    return _regular(int(random.choice([5, 7, 8])))


def _slanted(random: Random) -> Floats:
    """A parallelogram or a trapezium, well away from a rectangle."""
    a, s = float(random.uniform(0.6, 1.6)), float(random.uniform(0.3, 0.8)) * float(random.choice([-1.0, 1.0]))
    if random.random() < 0.5:
        return np.array([[-a + s, -0.6], [a + s, -0.6], [a - s, 0.6], [-a - s, 0.6]]) * (0.8, 1.0)
    k = float(random.uniform(0.25, 0.65))
    return np.array([[-a, 0.6], [a, 0.6], [k * a, -0.6], [-k * a, -0.6]])


def _arrow(random: Random) -> Floats:
    w, n = float(random.uniform(0.15, 0.4)), float(random.uniform(-0.3, 0.4))
    return np.array([[-1, -w], [n, -w], [n, -0.75], [1, 0], [n, 0.75], [n, w], [-1, w]])


def _kite(random: Random) -> Floats:
    e, f = float(random.uniform(0.0, 0.6)), float(random.uniform(0.35, 0.75))
    return np.array([[-1.0, 0.0], [e, -f], [0.75, 0.0], [e, f]])


def _pebble(random: Random) -> Floats:
    t = np.arange(72) * 2 * math.pi / 72
    r = 1.0 + sum(float(random.normal(0, 0.13)) * np.cos(k * t + float(random.uniform(0, 6.3))) for k in (2, 3, 4, 5))
    return np.asarray(_regular(72) * np.maximum(np.asarray(r), 0.3)[:, None], np.float64)


def _pair(random: Random) -> Floats:
    """Two parts that touch, seen as one."""
    ring = np.zeros((160, 160), np.uint8)
    for sign in (-1, 1):
        kind = str(random.choice(SHAPES[:5]))
        part = _placed(random, _outline(random, kind))
        part *= 30.0 / float(np.sqrt((part**2).sum(axis=1).max()))
        reach = float((part[:, 0] * -sign).max())
        cv2.fillPoly(ring, [np.rint(part + (80 + sign * (reach - 1.0), 80)).astype(np.int32)], (255,))
    found, _ = cv2.findContours(ring, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    points = np.asarray(max(found, key=cv2.contourArea)[:, 0], np.float64)
    return np.asarray(points - (points.min(axis=0) + points.max(axis=0)) / 2.0, np.float64)


_OTHERS: Mapping[str, Callable[[Random], Floats]] = {
    "star": _star, "gear": _gear, "cross": _cross, "angle": _angle, "tee": _tee, "channel": _channel,
    "part of disc": _part_of_disc, "heart": _heart, "oval": _oval, "slot": _slot, "polygon": _polygon,
    "slanted": _slanted, "arrow": _arrow, "kite": _kite, "pebble": _pebble, "pair": _pair,
}  # fmt: skip


def _placed(random: Random, ring: Floats) -> Floats:
    """The ring about the middle of its circle, turned, and a little out of true as a lens and a tilt leave it."""
    ring = ring - _centroid(ring)
    a = float(random.uniform(-math.pi, math.pi))
    turn: Floats = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    tilt: Floats = np.eye(2) + random.normal(0.0, 0.008, (2, 2))
    return np.asarray(ring @ turn @ tilt, np.float64)


def _centroid(ring: Floats) -> Floats:
    x, y = ring.T
    u, v = np.roll(ring, -1, axis=0).T
    cross = x * v - u * y
    return np.asarray(np.array([((x + u) * cross).sum(), ((y + v) * cross).sum()]) / (3.0 * cross.sum()), np.float64)


# --- paint ------------------------------------------------------------------------------------------


def _painted(random: Random, ring: Floats, kind: str, canvas: int, center: tuple[float, float]) -> Image:
    table, face = _colours(random)
    scene: Floats = np.empty((canvas, canvas, 3))
    scene[:] = table
    across = float(np.ptp(ring, axis=0).max())
    grain = random.normal(0.0, float(random.uniform(0.0, 4.0)), (canvas, canvas, 1))
    scene += cv2.GaussianBlur(grain, (0, 0), 0.6)[..., None]
    if random.random() < 0.5:
        _lay(scene, ring + center + random.normal(0.0, 0.08, 2) * across, table * float(random.uniform(0.7, 0.95)), 3.0)
    if random.random() < 0.45:
        _neighbour(random, scene, ring, center, face)
    if random.random() < 0.6:
        # Seen from the side: the wall between the face and where the part stands.
        to = random.normal(0.0, 0.06, 2) * across
        wall = face * float(random.uniform(0.55, 0.95))
        for step in np.linspace(1.0, 0.0, 8, endpoint=False):
            _lay(scene, ring + center + step * to, wall)
    _lay(scene, ring + center, face, print_=_print(random, ring, face))
    if kind in ("circle", "hexagon", "square", "other") and random.random() < 0.12:
        # A hole changes nothing of the outline.
        size = float(random.uniform(0.15, 0.3)) * across
        _lay(scene, _regular(40) * size + center, table * float(random.uniform(0.75, 1.0)))
    ramp: Floats = (np.arange(canvas) / canvas) - 0.5
    v, u = np.meshgrid(ramp, ramp, indexing="ij")
    a, fall = float(random.uniform(0, 6.3)), float(random.uniform(0.0, 0.3))
    gain = (1.0 - fall * (math.cos(a) * u + math.sin(a) * v)) * float(random.uniform(0.75, 1.1))
    scene = np.asarray(scene * gain[..., None], np.float64)
    blur = float(random.uniform(0.4, min(2.2, 0.5 + across / 40.0)))
    noise = random.normal(0.0, float(np.exp(random.uniform(0.0, math.log(14.0)))), scene.shape)
    codes = np.asarray(cv2.GaussianBlur(scene, (0, 0), blur), np.float64) + noise
    return np.asarray(np.clip(np.rint(codes), 0, 255), np.uint8)


def _colours(random: Random) -> tuple[Floats, Floats]:
    """BGR of table and part, apart enough for an outline."""
    table = np.full(3, float(random.uniform(15, 240))) + random.normal(0.0, 12.0, 3)
    if random.random() < 0.15:
        table = random.uniform(10, 240, 3)
    while True:
        face = random.uniform(5, 250, 3) if random.random() < 0.7 else np.full(3, float(random.uniform(5, 250)))
        if np.abs(face - table).max() > 12.0:
            return np.clip(table, 5, 250), face


def _lay(scene: Floats, ring: Floats, colour: Floats, soft: float = 0.0, print_: Floats | None = None) -> None:
    """Cover the scene with a polygon of one colour, or with a print's."""
    height, width = scene.shape[:2]
    fine = np.zeros((height * _FINE, width * _FINE), np.uint8)
    cv2.fillPoly(fine, [np.rint(((ring + 0.5) * _FINE - 0.5) * 16.0).astype(np.int32)], (255,), shift=4)
    cover: Floats = np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), np.float64) / 255.0
    if soft:
        cover = np.asarray(cv2.GaussianBlur(cover, (0, 0), soft), np.float64)
    shown = np.broadcast_to(colour, scene.shape)
    if print_ is not None:
        shown = shown + np.asarray(cv2.resize(print_, (width, height)), np.float64)[..., None]
    scene[:] = scene + cover[..., None] * (shown - scene)


def _print(random: Random, ring: Floats, face: Floats) -> Floats | None:
    """What a pattern adds to the face's colour, (n, n), or None for a plain one."""
    if random.random() > 0.3:
        return None
    v, u = np.mgrid[0:96, 0:96] / 96.0
    a, pitch = float(random.uniform(0, 3.2)), float(random.uniform(0.08, 0.3))
    p, q = (math.cos(a) * u + math.sin(a) * v) / pitch, (-math.sin(a) * u + math.cos(a) * v) / pitch
    how = int(random.integers(4))
    if how == 0:
        share = np.mod(p, 1.0) < 0.5
    elif how == 1:
        share = np.hypot(np.mod(p, 1.0) - 0.5, np.mod(q, 1.0) - 0.5) < 0.28
    elif how == 2:
        share = np.abs(np.mod(p, 4.0) - 1.0) + np.abs(np.mod(q, 4.0) - 1.0) < 0.7
    else:
        share = cv2.GaussianBlur(random.standard_normal((96, 96)), (0, 0), 2.5) > 0.12
    step = float(random.uniform(10.0, 70.0)) * (-1.0 if face.mean() > 128 else 1.0)
    return np.asarray(share * step, np.float64)


def _neighbour(random: Random, scene: Floats, ring: Floats, center: tuple[float, float], face: Floats) -> None:
    """Another part beside this one, at least a pixel off."""
    other = _placed(random, _outline(random, str(random.choice(SHAPES))))
    own = float(np.ptp(ring, axis=0).max()) / 2.0
    other *= own * float(random.uniform(0.6, 1.2)) / float(np.sqrt((other**2).sum(axis=1).max()))
    a = float(random.uniform(0, 2 * math.pi))
    ahead = np.array([math.cos(a), math.sin(a)])
    apart = float((ring @ ahead).max() - (other @ ahead).min()) + float(random.uniform(1.0, 0.3 * own + 1.5))
    colour = face if random.random() < 0.4 else random.uniform(5, 250, 3)
    _lay(scene, other + center + ahead * apart, colour)

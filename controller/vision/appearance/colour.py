"""Colour of parts: measured on their material, in the light that the table around them tells of, and named.

The light's colour and strength are taken from something known to be gray (the table around each part, or a gray
card), and divided out in linear light: a lamp's warmth, its gradient and the exposure cancel. What remains is the
share of light the part gives back, whose robust centre in OKLab is the part's colour.

Limits: dividing is exact for three narrow bands; real lamps and dyes have spectra, and two dyes that look alike in
one light may differ in another. A lamp without blue gives no blue back, whatever is divided.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.errors import InputError
from controller.vision.appearance.hole import counts
from controller.vision.appearance.oklab import LINEAR, LUMINANCE, Floats32, linear, oklab
from controller.vision.appearance.palette import NAMES, nearest
from controller.vision.appearance.settings import Appearance
from controller.vision.appearance.tiles import SIDE, Tiles

Image = NDArray[np.uint8]

SAMPLES = 100
"""Pixels looked at of each part: their median is good to a tenth of the pixels' own noise."""
_GLARE = 250
"""A pixel whose darkest channel is this bright shows the lamp, not the part."""
_CLIPPED = 254
_SECOND_SHARE = 0.25
"""A second colour covers at least this share of the part ..."""
_APART = 0.10
"""... and differs by this much in a and b together: shading changes lightness and chroma, never hue and neutrality."""
_APART_LIGHTNESS = 0.35
"""... or by this much in lightness between unsaturated colours: no shading on one face is that deep."""
_UNSATURATED = 0.05
"""Chroma below which a colour is a gray."""
_BRIGHT_TABLE = 0.08
"""Luminance from which a table may be taken for gray: below, noise decides its colour."""


@dataclass(frozen=True, slots=True)
class Colour:
    """What colour a part has.

    Attributes:
        name: One of `palette.NAMES`.
        lab: (L, a, b) in OKLab of the share of light it gives back.
        distance: How far from the nearest place of that name, in the palette's measure; below 0.1 is plain.
        second: Name of a second colour, or None.
    """

    name: str
    lab: tuple[float, float, float]
    distance: float
    second: str | None = None


def measure(image: Image, surface: Tiles, settings: Appearance) -> list[Colour]:
    """The colour of each part.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8, BGR: the frame the tiles were taken from.
        surface: Parts.
        settings: What tells the colour of the light.

    Raises:
        InputError: The gray card lies outside the picture, or is too dark or too bright to measure.
    """
    if not surface.which:
        return []
    lab = oklab(linear(_samples(surface)) * balance(image, surface.table, settings)[:, None])
    centers = _medians(lab)
    owners, apart = nearest(centers)
    whole = [
        Colour(NAMES[int(name)], _triple(center), float(far))
        for name, far, center in zip(owners, apart, centers, strict=True)
    ]
    for k, split in _split(lab, *_two_toned(lab)):
        whole[k] = split
    return whole


def balance(image: Image, table: Floats32, settings: Appearance) -> Floats32:
    """Factors (N, 3) that turn the linear BGR light of parts on such tables (N, 3) into the share they give back."""
    ones = np.ones((len(table), 3), np.float32)
    if settings.reference == "none":
        return ones
    around = _light_of(table)
    if settings.reference == "patch":
        assert settings.patch_px is not None
        card, beside = _card(image, settings.patch_px)
        # Where the table is brighter than beside the card, so is the light: whatever colour the table has.
        relative = np.clip(around / np.maximum(beside, 1e-4), 0.33, 3.0) if beside.min() > 0.004 else ones
        return np.asarray(settings.patch_reflectance / (card * relative), np.float32)
    gives = np.full(len(table), settings.table_reflectance)
    if settings.reference == "auto":
        # Nobody vouches for the table's gray: one that looks brighter than told is taken to be so.
        gives = np.maximum(gives, np.minimum(around @ LUMINANCE, 1.0))
    gains = np.asarray(gives[:, None] / np.maximum(around, 0.01), np.float32)
    if settings.reference == "table":
        return gains
    return np.where(_gray_enough(around)[:, None], gains, ones)


def _light_of(codes: NDArray[np.floating[Any]]) -> Floats32:
    """Linear light of codes that need not be whole."""
    return np.asarray(np.interp(codes, np.arange(256), LINEAR), np.float32)


def _gray_enough(light: Floats32) -> NDArray[np.bool_]:
    """Whether linear BGR light (N, 3) can come from a gray table under a lamp of 3300 to 9000 K on a daylight camera.

    Lamps follow a line: log(B/G) is about -1.75 log(R/G) (Planck's law in sRGB). A brown table lies further out or
    beside it.
    """
    blue, green, red = np.log(np.maximum(light, 1e-4)).T
    warm, cold = red - green, blue - green
    near_line = (warm > -0.25) & (warm < 0.45) & (np.abs(cold + 1.75 * warm) < 0.4)
    return np.asarray(near_line & (light @ LUMINANCE >= _BRIGHT_TABLE))


def _card(image: Image, rectangle: tuple[int, int, int, int]) -> tuple[Floats32, Floats32]:
    """Linear BGR light (3,) of the gray card, and of the table beside it."""
    x, y, w, h = rectangle
    if x + w > image.shape[1] or y + h > image.shape[0]:
        raise InputError(
            f"the gray card at {x}, {y} reaches beyond the picture ({image.shape[1]} x {image.shape[0]})",
            "mend patch_px in the recipe",
        )
    middle = image[y + h // 5 : y + h - h // 5, x + w // 5 : x + w - w // 5].reshape(-1, 3)
    codes = np.median(middle, axis=0)
    if codes.max() >= _CLIPPED or codes.max() < 12:
        state = "overexposed" if codes.max() >= _CLIPPED else "too dark"
        raise InputError(f"the gray card is {state} (BGR {codes})", "change the exposure, or the card's place")
    ring = image[max(0, y - h) : y + 2 * h, max(0, x - w) : x + 2 * w]
    keep = np.ones(ring.shape[:2], bool)
    top, left = min(y, h), min(x, w)
    keep[max(0, top - 3) : top + h + 3, max(0, left - 3) : left + w + 3] = False
    beside = np.median(ring[keep], axis=0) if keep.any() else codes
    return np.maximum(_light_of(codes), 1e-3), _light_of(beside)


def _samples(surface: Tiles) -> NDArray[np.uint8]:
    """SAMPLES pixels (N, n, 3) of each part's material, spread evenly, without glare unless there is little else."""
    planes = surface.planes.reshape(3, -1)
    chosen = surface.material.reshape(-1, SIDE * SIDE)
    matt = chosen & (planes.min(axis=0) < _GLARE).reshape(chosen.shape)
    dull = 2 * counts(matt) >= counts(chosen)
    chosen = np.where(dull[:, None], matt, chosen)
    places = np.flatnonzero(chosen)
    count = counts(chosen)
    first = np.cumsum(count) - count
    ranks = np.arange(SAMPLES) * count[:, None] // SAMPLES
    return np.take(planes, places[first[:, None] + ranks], axis=1).transpose(1, 2, 0)


def _medians(lab: Floats32) -> Floats32:
    """Medians (N, 3) of samples (N, n, 3)."""
    ordered = np.sort(lab.transpose(0, 2, 1), axis=2)
    return np.asarray(0.5 * (ordered[:, :, (SAMPLES - 1) // 2] + ordered[:, :, SAMPLES // 2]), np.float32)


def _two_toned(lab: Floats32) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Which n of the parts (N, SAMPLES, 3) may have two colours, and their samples (n, SAMPLES) above the divide."""
    # One colour, noise and shading included, spreads less than two that could be told apart.
    least = _SECOND_SHARE * (1.0 - _SECOND_SHARE) * _APART**2
    mean = np.einsum("nsk->nk", lab) / np.float32(SAMPLES)
    # The sum of the three spreads bounds the largest.
    total = np.einsum("nsk,nsk->n", lab, lab) / np.float32(SAMPLES) - np.einsum("nk,nk->n", mean, mean)
    chosen = np.flatnonzero(total > least)
    if not len(chosen):
        return chosen, np.zeros((0, SAMPLES), bool)
    rest = lab[chosen] - mean[chosen][:, None]
    spreads, axes = np.linalg.eigh(rest.transpose(0, 2, 1) @ rest / SAMPLES)
    wide = spreads[:, 2] > least
    chosen = chosen[wide]
    along = (rest[wide] @ axes[wide][:, :, 2:])[:, :, 0]
    upper = along > 0.0
    for _ in range(6):
        count = np.count_nonzero(upper, axis=1)
        # Their mean is 0: what is missing on one side is on the other.
        above = np.einsum("ns,ns->n", along, upper)
        cut = 0.5 * above * (1.0 / np.maximum(count, 1) - 1.0 / np.maximum(SAMPLES - count, 1))
        moved = along > cut[:, None]
        if np.array_equal(moved, upper):
            break
        upper = moved
    return chosen, upper


def _split(lab: Floats32, chosen: NDArray[np.intp], upper: NDArray[np.bool_]) -> list[tuple[int, Colour]]:
    """The colours of those chosen parts whose two groups of samples are not one paint in two lights."""
    count = np.count_nonzero(upper, axis=1)
    enough = (count >= _SECOND_SHARE * SAMPLES) & (count <= (1.0 - _SECOND_SHARE) * SAMPLES)
    chosen, upper, count = chosen[enough], upper[enough], count[enough]
    if not len(chosen):
        return []
    samples = lab[chosen]
    above, below = _group_medians(samples, upper, count), _group_medians(samples, ~upper, SAMPLES - count)
    larger = (2 * count >= SAMPLES)[:, None]
    main, second = np.where(larger, above, below), np.where(larger, below, above)
    owners, apart = nearest(np.concatenate([main, second]))
    out = []
    for j, k in enumerate(chosen.tolist()):
        name, other = NAMES[int(owners[j])], NAMES[int(owners[j + len(chosen)])]
        if name != other and _two_paints(main[j], second[j]):
            out.append((k, Colour(name, _triple(main[j]), float(apart[j]), other)))
    return out


def _group_medians(samples: Floats32, group: NDArray[np.bool_], count: NDArray[np.intp]) -> Floats32:
    """Medians (n, 3) of those samples (n, SAMPLES, 3) that are in the group, `count` of each part."""
    # What is not in it is sorted behind everything.
    ordered = np.sort(np.where(group[:, None], samples.transpose(0, 2, 1), np.float32(np.inf)), axis=2)
    at = np.arange(len(samples))
    return np.asarray(0.5 * (ordered[at, :, (count - 1) // 2] + ordered[at, :, count // 2]), np.float32)


def _two_paints(main: Floats32, second: Floats32) -> bool:
    """Whether two colours (3,) can not come from one paint in two lights."""
    a, b = _triple(main), _triple(second)
    if max(math.hypot(a[1], a[2]), math.hypot(b[1], b[2])) < _UNSATURATED:
        return abs(b[0] - a[0]) >= _APART_LIGHTNESS
    # Shading scales a colour: what the best scaling leaves of the difference is a difference of paint.
    scaling = sum(p * q for p, q in zip(a, b, strict=True)) / max(sum(p * p for p in a), 1e-6)
    paint = math.hypot(b[1] - scaling * a[1], b[2] - scaling * a[2])
    return paint >= 0.5 * _APART and math.dist(a[1:], b[1:]) >= _APART


def _triple(values: Floats32) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])

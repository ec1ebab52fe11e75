"""Textbook operators on pictures, with the meaning of the MATLAB image processing toolbox.

Pictures are uint8, gray (H, W) or BGR (H, W, 3); nothing is changed in place. Where the toolbox's free twin, GNU
Octave, differs, the docstring says so.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Mask = NDArray[np.uint8]
Floats = NDArray[np.float64]


def _rounded(values: NDArray[np.number]) -> Image:
    """Values rounded half up and clipped to 0..255."""
    return np.asarray(np.clip(np.floor(values + 0.5), 0, 255), np.uint8)


def gray(image: Image) -> Image:
    """Luminance of a picture (`rgb2gray`): 0.2989 R + 0.5870 G + 0.1140 B, the inverse of the NTSC matrix."""
    if image.ndim == 2:
        return image
    weights = np.linalg.inv(np.array([[1.0, 0.956, 0.621], [1.0, -0.272, -0.647], [1.0, -1.106, 1.703]]))[0]
    return _rounded(cv2.transform(image.astype(np.float64), weights[None, ::-1]))


def unsharp_mask(image: Image, radius: float = 1.0, amount: float = 0.8) -> Image:
    """The picture plus `amount` times its difference from a Gaussian blur of sigma `radius` (`imsharpen`).

    Colour is sharpened in the lightness of CIE Lab only, so that hues do not change.
    """
    if image.ndim == 2:
        return _rounded(_sharpened(image.astype(np.float64), radius, amount))
    lab = cv2.cvtColor(image.astype(np.float32) / np.float32(255.0), cv2.COLOR_BGR2Lab)
    lab[:, :, 0] = _sharpened(lab[:, :, 0].astype(np.float64), radius, amount)
    return _rounded(cv2.cvtColor(lab, cv2.COLOR_Lab2BGR) * 255.0)


def _sharpened(values: Floats, radius: float, amount: float) -> Floats:
    size = 2 * int(np.ceil(2.0 * radius)) + 1
    kernel = cv2.getGaussianKernel(size, radius, cv2.CV_64F)
    blurred = cv2.sepFilter2D(values, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(values + amount * (values - blurred))


def median(image: Image, size: int = 3, zero_padding: bool = False) -> Image:
    """Median of every size x size neighbourhood (`medfilt2`).

    The toolbox pads with zeros, which blackens the picture's corners; here the rim is replicated unless asked.
    """
    if not zero_padding:
        return np.asarray(cv2.medianBlur(image, size), np.uint8)
    rim = size // 2
    padded = cv2.copyMakeBorder(image, rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=(0, 0, 0))
    return np.ascontiguousarray(cv2.medianBlur(padded, size)[rim:-rim, rim:-rim])


def average(image: Image, size: int = 3) -> Image:
    """Mean of every size x size neighbourhood, rim replicated (`imfilter` with `fspecial('average')`)."""
    return np.asarray(cv2.blur(image, (size, size), borderType=cv2.BORDER_REPLICATE), np.uint8)


def gaussian(image: Image, sigma: float = 1.0) -> Image:
    """Gaussian blur, rim replicated (`imgaussfilt`)."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE), np.uint8)


def stretch_limits(image: Image, low: float = 0.01, high: float = 0.99) -> tuple[int, int]:
    """Gray levels (`stretchlim` times 255) that leave the shares `low` below and 1 - `high` above.

    Order statistics, as in Octave; the toolbox takes histogram bins, which for 8 bits is the same but for ties.
    """
    count = image.size
    cumulative = np.cumsum(np.bincount(image.ravel(), minlength=256))
    first = max(int(np.floor(low * count)), 0)
    last = min(int(np.ceil(high * count)) - 1, count - 1)
    return int(np.searchsorted(cumulative, first, "right")), int(np.searchsorted(cumulative, last, "right"))


def stretch(image: Image, low: float = 0.01, high: float = 0.99) -> Image:
    """Gray picture whose darkest and brightest shares are saturated (`imadjust`)."""
    bottom, top = stretch_limits(image, low, high)
    if top <= bottom:
        return image.copy()
    table = _rounded((np.clip(np.arange(256.0), bottom, top) - bottom) / (top - bottom) * 255.0)
    return np.asarray(cv2.LUT(image, table), np.uint8)


def equalise(image: Image) -> Image:
    """Gray picture whose histogram is as flat as its levels allow (`histeq`)."""
    return np.asarray(cv2.equalizeHist(image), np.uint8)


def homomorphic(image: Image, sigma_share: float = 0.15, low_gain: float = 0.4, high_gain: float = 1.2) -> Image:
    """Gray picture with uneven light evened out: its logarithm is split into light and reflectance by a Gaussian.

    Args:
        image: Gray picture.
        sigma_share: Width of the Gaussian as a share of the picture's larger side.
        low_gain: What remains of the slow changes (light).
        high_gain: What becomes of the fast ones (reflectance).

    Source: Gonzalez and Woods, Digital Image Processing, homomorphic filtering.
    """
    logarithm = np.log1p(image.astype(np.float32))
    light = cv2.GaussianBlur(logarithm, (0, 0), sigma_share * max(image.shape), borderType=cv2.BORDER_REFLECT)
    level = float(light.mean())
    out = np.expm1(level + low_gain * (light - level) + high_gain * (logarithm - light))
    return _rounded(out)


def otsu_threshold(image: Image) -> int:
    """Gray level t that best separates levels <= t from those above: the largest between-class variance (`graythresh`).

    Of equally good levels the mean, rounded down, as in the toolbox. Source: Otsu, IEEE Trans. SMC 9(1), 1979.
    """
    histogram = np.bincount(image.ravel(), minlength=256) / image.size
    weight = np.cumsum(histogram)
    mean = np.cumsum(histogram * np.arange(256))
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (mean[-1] * weight - mean) ** 2 / (weight * (1.0 - weight))
    between = np.where(np.isfinite(between), between, 0.0)
    best = np.flatnonzero(between >= between.max() * (1.0 - 1e-12))
    return int(best.mean())


def otsu(image: Image) -> Image:
    """Mask (0, 1) of the objects by Otsu's threshold; objects are the side that touches the rim less."""
    bright = (image > otsu_threshold(image)).astype(np.uint8)
    rim = np.concatenate([bright[0], bright[-1], bright[:, 0], bright[:, -1]])
    return np.asarray(1 - bright if rim.mean() > 0.5 else bright, np.uint8)


def frame_difference(image: Image, background: Image, threshold: float, block: int = 5) -> Image:
    """Mask (0, 1) of where the sum of absolute differences to the empty table exceeds `threshold` levels a pixel.

    The sum runs over the channels and a block x block neighbourhood.
    """
    difference = cv2.absdiff(image, background)
    if difference.ndim == 3:
        difference = difference.mean(axis=2)
    mean = cv2.blur(difference.astype(np.float32), (block, block), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(mean > threshold, np.uint8)


def match_template(image: Image, template: Image, scales: Sequence[float], threshold: float) -> Mask:
    """Mask (0, 1) of the places that look like a template at any of several scales.

    The normalised correlation coefficient is taken at every scale; the best match first, its rectangle is marked
    and excludes all others that overlap it. Source: the paper's reference [15], rectangle templates of many sizes.

    Args:
        image: Gray picture.
        template: Gray picture of the object with a little of its surroundings.
        scales: Sizes to try, as factors of the template's.
        threshold: Least correlation, 0 to 1.
    """
    found: list[tuple[float, int, int, int, int]] = []
    for scale in scales:
        width, height = round(template.shape[1] * scale), round(template.shape[0] * scale)
        if min(width, height) < 4 or width > image.shape[1] or height > image.shape[0]:
            continue
        way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
        resized = cv2.resize(template, (width, height), interpolation=way)
        score = cv2.matchTemplate(image, resized, cv2.TM_CCOEFF_NORMED)
        highest = cv2.dilate(score, np.ones((5, 5), np.uint8))
        ys, xs = np.nonzero((score >= highest) & (score >= threshold))
        found += [(float(score[y, x]), int(x), int(y), width, height) for y, x in zip(ys, xs, strict=True)]
    mask = np.zeros(image.shape[:2], np.uint8)
    for _, x, y, width, height in sorted(found, reverse=True):
        place = mask[y : y + height, x : x + width]
        if not place.any():
            place[:] = 1
    return mask

"""Edge detectors with automatic thresholds, with the meaning of the toolbox's `edge`.

All take a gray picture and return a mask (0, 1) of one-pixel edges.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Mask = NDArray[np.uint8]
Floats32 = NDArray[np.float32]

_KERNELS = {
    "sobel": np.array([[1.0, 2.0, 1.0]]) / 8.0,
    "prewitt": np.array([[1.0, 1.0, 1.0]]) / 6.0,
}


def canny(image: Image, sigma: float = math.sqrt(2.0), low: float | None = None, high: float | None = None) -> Mask:
    """Canny's detector: Gaussian derivative, thinning, hysteresis over 8 neighbours.

    Thresholds are shares of the strongest gradient. Left out, `high` is the bin of a 64-bin histogram below
    which 70 % of the pixels lie, and `low` is 0.4 of it.

    Source: Canny, IEEE Trans. PAMI 8(6), 1986; the automatic thresholds are the toolbox's.
    """
    half = max(1, math.ceil(4.0 * sigma))
    t = np.arange(-half, half + 1, dtype=np.float64)
    smooth = np.exp(-(t**2) / (2.0 * sigma**2))
    smooth /= smooth.sum()
    slope = -t * smooth
    slope /= np.abs(slope).sum() / 2.0
    values = image.astype(np.float32)
    dx = cv2.sepFilter2D(values, cv2.CV_32F, slope[::-1], smooth, borderType=cv2.BORDER_REPLICATE)
    dy = cv2.sepFilter2D(values, cv2.CV_32F, smooth, slope[::-1], borderType=cv2.BORDER_REPLICATE)
    magnitude = cv2.magnitude(dx, dy)
    top = float(magnitude.max())
    if top <= 1e-6:
        return np.zeros(image.shape, np.uint8)
    if high is None:
        high = automatic_high(np.asarray(magnitude / top, np.float32))
    if low is None:
        low = 0.4 * high
    # The tracer takes 16-bit gradients: use their range.
    scale = 16000.0 / top
    found = cv2.Canny(
        np.rint(dx * scale).astype(np.int16), np.rint(dy * scale).astype(np.int16), low * 16000.0, high * 16000.0,
        L2gradient=True,
    )  # fmt: skip
    return np.asarray(found > 0, np.uint8)


def automatic_high(magnitude: Floats32, share: float = 0.7) -> float:
    """The upper threshold that leaves `share` of the pixels below, on a histogram with 64 bins.

    Bins are centred on k / 63, as `imhist` has them, so the first is half as wide as the others.
    """
    counts = np.bincount(np.rint(magnitude * 63.0).astype(np.intp).ravel(), minlength=64)
    return (int(np.argmax(np.cumsum(counts) > share * magnitude.size)) + 1) / 64.0


def gradient_edges(image: Image, kernel: str = "sobel", threshold: float | None = None) -> Mask:
    """Thinned edges of the Sobel, Prewitt or Roberts gradient.

    Args:
        image: Gray picture.
        kernel: `sobel`, `prewitt` or `roberts`.
        threshold: Gradient per pixel, as a share of full scale; None for twice its root mean square.
    """
    values = image.astype(np.float64) / 255.0
    if kernel == "roberts":
        # Diagonal differences of a 2 x 2 window, each over a distance of sqrt(2).
        dx = cv2.filter2D(values, cv2.CV_64F, np.array([[1.0, 0.0], [0.0, -1.0]]) / 2.0, anchor=(0, 0))
        dy = cv2.filter2D(values, cv2.CV_64F, np.array([[0.0, 1.0], [-1.0, 0.0]]) / 2.0, anchor=(0, 0))
        across, down = (1, 1), (1, -1)
    else:
        side = _KERNELS[kernel]
        dx = cv2.filter2D(values, cv2.CV_64F, side.T @ np.array([[-1.0, 0.0, 1.0]]), borderType=cv2.BORDER_REPLICATE)
        dy = cv2.filter2D(values, cv2.CV_64F, np.array([[-1.0], [0.0], [1.0]]) @ side, borderType=cv2.BORDER_REPLICATE)
        across, down = (0, 1), (1, 0)
    strength = dx * dx + dy * dy
    limit = 4.0 * float(strength.mean()) if threshold is None else threshold**2
    if not strength.any():
        return np.zeros(image.shape, np.uint8)
    strong = strength > limit
    peak_x = _peak(strength, across) & (dx * dx >= dy * dy)
    peak_y = _peak(strength, down) & (dy * dy >= dx * dx)
    return np.asarray(strong & (peak_x | peak_y), np.uint8)


def _peak(strength: NDArray[np.float64], step: tuple[int, int]) -> NDArray[np.bool_]:
    """Where a value is not below its neighbour one step back and above the one a step ahead."""
    padded = np.pad(strength, 1, mode="edge")
    rows, columns = strength.shape
    dy, dx = step
    ahead = padded[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]
    back = padded[1 - dy : 1 - dy + rows, 1 - dx : 1 - dx + columns]
    return np.asarray((strength >= back) & (strength > ahead))


def zero_crossings(image: Image, sigma: float = 2.0, threshold: float | None = None) -> Mask:
    """Zero crossings of the Laplacian of a Gaussian whose step exceeds the threshold.

    Args:
        image: Gray picture.
        sigma: Width of the Gaussian, px.
        threshold: Smallest step across zero, levels; None for 0.75 of the mean absolute response.

    Source: Marr and Hildreth, Proc. R. Soc. Lond. B 207, 1980; the automatic threshold is the toolbox's.
    """
    half = math.ceil(3.0 * sigma)
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    bell = np.exp(-(x * x + y * y) / (2.0 * sigma**2))
    kernel = bell / bell.sum() * (x * x + y * y - 2.0 * sigma**2) / sigma**4
    kernel -= kernel.mean()
    response = cv2.filter2D(image.astype(np.float64), cv2.CV_64F, kernel, borderType=cv2.BORDER_REPLICATE)
    limit = 0.75 * float(np.abs(response).mean()) if threshold is None else threshold
    limit = max(limit, 1e-6)  # rounding, on a picture of one level
    out = np.zeros(image.shape, np.uint8)
    for a, b, at in (
        (response[:, :-1], response[:, 1:], (slice(None), slice(0, -1))),
        (response[:-1], response[1:], (slice(0, -1), slice(None))),
    ):
        out[at] |= ((a * b < 0.0) & (np.abs(a - b) > limit)).astype(np.uint8)
    return out

"""The still scenery around the work area: whether the camera was moved, the light changed, the lens went soft.

Parts come and go, bins fill, but table, bin walls and the rest stay where they are in the picture. A camera that
was bumped by a few pixels sorts millimetres beside the parts and sees nothing wrong; the scenery tells.

Source: B. Lucas, T. Kanade, "An iterative image registration technique", IJCAI 1981, for the displacement; the
weights of P. Huber and J. Tukey (P. Holland, R. Welsch, "Robust regression using iteratively reweighted
least-squares", 1977) against what has changed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.grain import Grain

Gray = NDArray[np.float32]
Mask = NDArray[np.uint8]

# Work on every fourth pixel: registration good to some hundredths of one is a tenth of a full pixel.
_SCALE = 4
_POINTS = 12_000  # so many still pixels pin the four unknowns down to hundredths
_SMOOTH = 1.0  # px of the reduced picture; takes the noise and makes gradients linear over a step
_ROUNDS = 12
_DONE = 1e-3  # px of the reduced picture
# The arm's shadow falls elsewhere in every look: what is only darker by as much is still the same scenery.
_SHADED = 0.6
_SAME = 4.0  # of 255: noise and grain of the reduced picture stay below
# A shadow brings no edges but its own border, and what hangs before the camera brings its own all over: so much steeper
# than the reference, levels a pixel of the reduced picture, is an edge. Those of a checked cloth have 40.
_STEEPER = 8.0
# The share of the still points, those of the strongest edges, by which sharpness is judged: bin walls, not the table's
# grain or noise.
_EDGES = 0.01
# A soft lens weakens all of them; the arm over a bin hides the better part of some looks' edges. So the best fifth
# tells.
_SHARPEST = 0.8
# A move must explain at least this part of the still points that standing still does not: along the grain of a
# wooden table, little speaks against any move.
_GAIN = 0.003


@dataclass(frozen=True, slots=True)
class Change:
    """How a picture's scenery differs from the reference.

    Attributes:
        displacement: Root mean square over the still pixels of how far they have moved, px of the full picture.
        agreement: Part of the still pixels that look as in the reference, or shaded, after undoing that move; low when
            the view is another one or covered, and the displacement then means nothing.
        brightness: Median ratio to the reference.
        sharpness: How strong the strongest edges of the reference are in this picture, brightness taken out: the least
            ratio of the best fifth.
        grain: Part of the places known for their faint texture that show it; 1 when there are none.
    """

    displacement: float
    agreement: float
    brightness: float
    sharpness: float
    grain: float = 1.0


# Least displacement (px) that counts as a move: a millimetre or so on the table. In simulated runs, filling bins
# and the arm's pose make it seem to move by 0.6 px at most.
MOVED = 2.0
# The bounds of what is usable; simulated runs stay within 0.85.., 0.98..1.02 and 0.95..1.03.
LEAST_AGREEMENT = 0.6
BRIGHTNESS = (0.7, 1.4)
LEAST_SHARPNESS = 0.8
LEAST_GRAIN = 0.5  # simulated runs stay above 0.9; a sheet over three quarters of the view leaves 0.1
# Halfway to the bounds of brightness somebody should look, before the cell has to hold.
DRIFTING = (0.85, 1.2)

_COVERED = "covered", "the view is another one, or something stands in it", "clear the view, or calibrate again"


def trouble(change: Change) -> tuple[str, str, str] | None:
    """Why the scenery says that positions or colours can no longer be trusted: code (see `PictureUnusable`), cause,
    remedy.
    """
    low, high = BRIGHTNESS
    if not low <= change.brightness <= high:
        return "light", f"the light is {change.brightness:.0%} of what it was", "restore the light, or calibrate again"
    if change.agreement < LEAST_AGREEMENT:
        return _COVERED
    if change.sharpness < LEAST_SHARPNESS:
        cause = f"the picture is soft: edges have {change.sharpness:.0%} of their strength"
        return "soft", cause, "clean and focus the lens"
    if change.displacement > MOVED:
        return "moved", f"the camera was moved: the picture is off by {change.displacement:.1f} px", "calibrate again"
    if change.grain < LEAST_GRAIN:
        return _COVERED
    return None


def drift(change: Change) -> str | None:
    """What should be looked after before it becomes trouble, in words."""
    low, high = DRIFTING
    if low <= change.brightness <= high:
        return None
    return f"the light is {change.brightness:.0%} of what it was"


class Scenery:
    """The reference, from a picture taken when all was well.

    Args:
        image: ndarray of shape (H, W, 3), dtype uint8, BGR.
        still: ndarray of shape (H, W), dtype uint8: non-zero where nothing is supposed to change.

    Raises:
        ValueError: Too little of the picture is still, or it shows nothing to hold on to.
    """

    def __init__(self, image: NDArray[np.uint8], still: Mask) -> None:
        self._reference = _reduced(image)
        height, width = self._reference.shape
        mask = cv2.resize(still, (width, height), interpolation=cv2.INTER_AREA) == 255
        # A border of the reduced picture is lost when it is shifted back.
        mask[:3], mask[-3:], mask[:, :3], mask[:, -3:] = False, False, False, False
        self._rows, self._columns = (index[:: len(index) // _POINTS + 1] for index in np.nonzero(mask))
        if len(self._rows) < 1000:
            raise ValueError("too little of the picture is still to tell a move of the camera")
        points = self._rows, self._columns
        gradient_x = cv2.Scharr(self._reference, cv2.CV_32F, 1, 0)[points] / 32.0
        gradient_y = cv2.Scharr(self._reference, cv2.CV_32F, 0, 1)[points] / 32.0
        # Similarity about the middle, in units that make all four unknowns shifts of about the same size.
        self._radius = max(height, width) / 2.0
        x = (self._columns - (width - 1) / 2.0) / self._radius
        y = (self._rows - (height - 1) / 2.0) / self._radius
        self._x, self._y = x, y
        self._jacobian = np.column_stack(
            [gradient_x, gradient_y, gradient_y * x - gradient_x * y, gradient_x * x + gradient_y * y]
        ).astype(np.float64)
        self._wanted = self._reference[points].astype(np.float64)
        self._steepness = _steepness(self._reference)[points].astype(np.float64)
        self._edges = np.argsort(self._steepness)[-max(1, round(_EDGES * len(self._steepness))) :]
        normal = self._jacobian.T @ self._jacobian
        self._ridge = np.eye(4) * 1e-6 * float(np.trace(normal))
        if np.linalg.cond(normal) > 1e6 or self._steepness[self._edges].min() <= 0.0:
            raise ValueError("the still part of the picture shows nothing to hold on to")
        self._grain = Grain(self._reference, mask)

    def compare(self, image: NDArray[np.uint8]) -> Change:
        """How far the scenery of a picture of the same size has changed; blocks for some milliseconds.

        The first sound pictures teach where the scenery has a grain to be looked for.
        """
        picture = _reduced(image)
        # Pixel by pixel: what hides a part of the scenery would shift the median of a picture with a gradient.
        brightness = float(np.median(picture[self._rows, self._columns] / np.maximum(self._wanted, 1.0)))
        levelled = picture / max(brightness, 1e-3)
        # Explanations: nothing has moved and some of the scene is another one, or all has moved a little or much.
        nowhere = np.zeros(4)
        little = self._settle(levelled, nowhere, _tukey)
        much = self._settle(levelled, self._settle(levelled, nowhere, _huber)[0], _tukey)
        move, kept = max(little, much, key=lambda found: found[1])
        unmoved = self._explained(levelled, nowhere)
        if kept < unmoved + _GAIN:
            move, kept = nowhere, unmoved
        steepness = self._seen(_steepness(levelled), move)
        sharpness = float(np.quantile(steepness[self._edges] / self._steepness[self._edges], _SHARPEST))
        dx, dy = self._displacement(move)
        agreement = max(kept, self._shown(self._seen(levelled, move), steepness))
        grain = self._grain.correlations(self._undone(picture, move))
        displacement = float(np.sqrt(np.mean(dx**2 + dy**2))) * _SCALE
        change = Change(displacement, agreement, brightness, sharpness, self._grain.kept(grain))
        if trouble(change) is None:
            self._grain.learn(grain)
        return change

    def _settle(
        self, picture: Gray, move: NDArray[np.float64], weigh: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    ) -> tuple[NDArray[np.float64], float]:
        """The move near `move` that explains the picture best, and the part of the still pixels it explains."""
        for _ in range(_ROUNDS):
            difference = self._seen(picture, move) - self._wanted
            weighted = self._jacobian * weigh(difference)[:, None]
            normal = weighted.T @ self._jacobian + self._ridge
            step = np.linalg.solve(normal, weighted.T @ difference)
            move = move - step
            if float(np.abs(step).max()) < _DONE:
                break
        return move, self._explained(picture, move)

    def _explained(self, picture: Gray, move: NDArray[np.float64]) -> float:
        """The part of the still points that look as in the reference after undoing a move."""
        return float(np.mean(np.abs(self._seen(picture, move) - self._wanted) < _SAME))

    def _shown(self, seen: NDArray[np.float64], steepness: NDArray[np.float64]) -> float:
        """The part of the still pixels that look as in the reference, or as in a shadow."""
        shaded = (seen > _SHADED * self._wanted - _SAME) & (seen < self._wanted / _SHADED + _SAME)
        return float(np.mean(shaded & (steepness < self._steepness + _STEEPER)))

    def _undone(self, picture: Gray, move: NDArray[np.float64]) -> Gray:
        """The whole picture with the move undone."""
        if not move.any():
            return picture
        height, width = picture.shape
        shift_x, shift_y, turn, growth = move / (1.0, 1.0, self._radius, self._radius)
        middle = np.array([(width - 1) / 2.0, (height - 1) / 2.0])
        linear = np.array([[1.0 + growth, -turn], [turn, 1.0 + growth]])
        shift = middle - linear @ middle + (shift_x, shift_y)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        matrix = np.column_stack([linear, shift])
        undone = cv2.warpAffine(picture, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(undone, np.float32)

    def _displacement(self, move: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        shift_x, shift_y, turn, growth = move
        return shift_x - turn * self._y + growth * self._x, shift_y + turn * self._x + growth * self._y

    def _seen(self, picture: Gray, move: NDArray[np.float64]) -> NDArray[np.float64]:
        """The picture where the still pixels would be after the move."""
        dx, dy = self._displacement(move)
        columns = (self._columns + dx).astype(np.float32)[:, None]
        rows = (self._rows + dy).astype(np.float32)[:, None]
        seen = cv2.remap(picture, columns, rows, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        return np.asarray(seen[:, 0], np.float64)


def _steepness(picture: Gray) -> Gray:
    """Length of the gradient, levels a pixel of the reduced picture."""
    dx, dy = (cv2.Scharr(picture, cv2.CV_32F, *along, scale=1.0 / 32.0) for along in ((1, 0), (0, 1)))
    return np.asarray(cv2.magnitude(dx, dy), np.float32)


def _huber(difference: NDArray[np.float64]) -> NDArray[np.float64]:
    size = np.abs(difference)
    return np.minimum(1.0, 1.345 * _spread(size) / np.maximum(size, 1e-9))


def _tukey(difference: NDArray[np.float64]) -> NDArray[np.float64]:
    size = np.abs(difference)
    return np.maximum(0.0, 1.0 - (size / (4.685 * _spread(size))) ** 2) ** 2


def _spread(size: NDArray[np.float64]) -> float:
    """Standard deviation of the undisturbed part, from the median of the absolute differences."""
    return max(1.4826 * float(np.median(size)), 0.25)


def _reduced(image: NDArray[np.uint8]) -> Gray:
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    small = cv2.resize(gray, None, fx=1.0 / _SCALE, fy=1.0 / _SCALE, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small.astype(np.float32), (0, 0), _SMOOTH), np.float32)

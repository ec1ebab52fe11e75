"""Live capture: looks at one picture after the other, says what is still missing, and takes what is steady and new.

A lens is known where corners were seen, and its focal length by tilted boards; people hold boards frontal and in the
middle. So the guide keeps count of the picture's cells, of the directions of tilt and of sizes, and asks for the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from controller.calibration.board_search import BoardNotFound, BoardView, find_board
from controller.calibration.boards import Board, BoardKind
from controller.calibration.guided import NOMINAL_FIELD
from controller.calibration.table import board_pose
from controller.calibration.views import seen_instead
from controller.errors import CalibrationPoorFit, InputError
from controller.geometry import CameraModel

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: Views of a good calibration, and after how many more of them it is taken as it is.
ENOUGH, MOST = 16, 40
#: Cells of the picture that corners are counted in, and the share of them to be reached.
CELLS = (8, 6)
COVERED = 0.8
#: A board tilted by more than this counts for its direction, rad; so many in each of the four are wanted.
TILTED = math.radians(18.0)
EACH_WAY = 2
#: Corners that move by less between two pictures, as a share of the picture's width, are held still.
_STEADY = 0.0015
#: A view whose corners all lie nearer to those of a taken one than this share of the width is no new one ...
_NEW_PLACE = 0.06
#: ... unless the board is turned by this much against it, rad.
_NEW_TURN = math.radians(10.0)


class Seen(StrEnum):
    """What became of one picture."""

    NOTHING = "no board"
    MOVING = "moving"
    KNOWN = "known"
    TAKEN = "taken"


@dataclass(frozen=True, slots=True)
class Progress:
    """How far the capture is.

    Attributes:
        seen: What became of the last picture.
        views: Taken so far.
        covered: Share of the picture's cells that hold corners.
        tilts: Views tilted with their far side up, right, down and left in the picture.
        advice: What to do next, one line.
        done: Enough is there.
    """

    seen: Seen
    views: int
    covered: float
    tilts: tuple[int, int, int, int]
    advice: str
    done: bool


class Capture:
    """Collects views of one board; see the module.

    Args:
        board: What is shown; its corners must keep their numbers from picture to picture.

    Raises:
        InputError: They do not: the board overfills the view.

    Attributes:
        taken: The views, named in order.
        images: Their pictures.
    """

    def __init__(self, board: Board) -> None:
        if board.kind is BoardKind.OVERFILLED:
            raise InputError(
                f"{board.spec}: new views cannot be told from known ones", "take pictures, and name the files"
            )
        self.board = board
        self.taken: list[tuple[str, BoardView]] = []
        self.images: list[Image] = []
        self._normals: list[Array] = []
        self._cells: set[tuple[int, int]] = set()
        self._tilts = [0, 0, 0, 0]
        self._last: BoardView | None = None

    def offer(self, image: Image) -> Progress:
        """Look at the next picture, ndarray of shape (H, W, 3), dtype uint8."""
        try:
            view = find_board(self.board, image)
        except BoardNotFound as error:
            self._last = None
            instead = seen_instead(self.board, image, False)
            advice = "show the board" if instead is None else "show the whole board, or check its SPEC"
            return self._progress(Seen.NOTHING, f"{advice}: {instead or error.cause}")
        steady = self._last is not None and _moved(self._last, view) < _STEADY * view.image_size[0]
        self._last = view
        normal = _normal(view)
        if not self._is_new(view, normal):
            return self._progress(Seen.KNOWN, self._wish())
        if not steady:
            return self._progress(Seen.MOVING, "hold still")
        larger = seen_instead(self.board, image, True)
        if larger is not None:
            return self._progress(Seen.NOTHING, f"check the board's SPEC: {larger}")
        self._take(view, normal, image)
        return self._progress(Seen.TAKEN, self._wish())

    # --- inside ---------------------------------------------------------------------------------------

    def _take(self, view: BoardView, normal: Array, image: Image) -> None:
        self.taken.append((f"view {len(self.taken) + 1}", view))
        self.images.append(image)
        self._normals.append(normal)
        size = np.array(view.image_size)
        cells = np.clip(np.floor(view.image_points / size * CELLS), 0, np.array(CELLS) - 1).astype(int)
        self._cells |= {(int(x), int(y)) for x, y in cells}
        if math.acos(min(1.0, abs(float(normal[2])))) > TILTED:
            self._tilts[_direction(normal)] += 1

    def _is_new(self, view: BoardView, normal: Array) -> bool:
        for (_, other), its in zip(self.taken, self._normals, strict=True):
            near = _moved(other, view) < _NEW_PLACE * view.image_size[0]
            if near and math.acos(min(1.0, float(normal @ its))) < _NEW_TURN:
                return False
        return True

    def _progress(self, seen: Seen, advice: str) -> Progress:
        covered = len(self._cells) / (CELLS[0] * CELLS[1])
        views = len(self.taken)
        done = (views >= ENOUGH and covered >= COVERED and min(self._tilts) >= EACH_WAY) or views >= MOST
        tilts = (self._tilts[0], self._tilts[1], self._tilts[2], self._tilts[3])
        return Progress(seen, views, covered, tilts, "enough" if done else advice, done)

    def _wish(self) -> str:
        """The most urgent lack: directions of tilt first, they pin the focal length; then places."""
        short = min(self._tilts)
        if short < EACH_WAY and (len(self.taken) % 2 == 0 or self._nowhere() is None):
            side = ("upper", "right", "lower", "left")[self._tilts.index(short)]
            return f"tilt the board by 30 degrees, its {side} side away from the camera"
        place = self._nowhere()
        if place is not None:
            return f"move the board to the {place} of the picture"
        return "another distance, another turn"

    def _nowhere(self) -> str | None:
        """The part of the picture, in thirds, that holds fewest corners; None when all is covered well enough."""
        if len(self._cells) >= COVERED * CELLS[0] * CELLS[1]:
            return None
        columns, rows = CELLS
        reached = np.zeros((3, 3))
        total = np.zeros((3, 3))
        for x in range(columns):
            for y in range(rows):
                third = min(2, 3 * y // rows), min(2, 3 * x // columns)
                total[third] += 1
                reached[third] += (x, y) in self._cells
        least = int(np.argmin(reached / total))
        return _PLACES[least // 3][least % 3]


_PLACES = (
    ("upper left", "upper edge", "upper right"),
    ("left edge", "middle", "right edge"),
    ("lower left", "lower edge", "lower right"),
)


def _moved(a: BoardView, b: BoardView) -> float:
    """Largest distance between the corners that two views share, px; infinite when they share none."""
    common, first, second = np.intersect1d(a.ids, b.ids, return_indices=True)
    if len(common) == 0:
        return math.inf
    return float(np.linalg.norm(a.image_points[first] - b.image_points[second], axis=1).max())


def _normal(view: BoardView) -> Array:
    """The board's normal (3,) in `camera`, away from it, by the field of view that common webcams have."""
    width, height = view.image_size
    focal = width / 2 / math.tan(NOMINAL_FIELD / 2)
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    try:
        pose = board_pose(view.object_points, view.image_points, CameraModel(matrix, np.zeros(5), view.image_size))
    except CalibrationPoorFit:
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(pose[:3, 2] * np.sign(pose[2, 2] or 1.0))


def _direction(normal: Array) -> int:
    """Which side is the far one: 0 upper, 1 right, 2 lower, 3 left, as the picture has it.

    A board whose normal (away from the camera) leans to the left of the picture has its right side away.
    """
    x, y = -normal[0], -normal[1]
    if abs(x) > abs(y):
        return 1 if x > 0.0 else 3
    return 2 if y > 0.0 else 0

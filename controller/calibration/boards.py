"""Printed calibration boards: their names, their pictures, and their corners in an image.

Board coordinates are mm with the origin in the middle of the print, x to its right, y to its bottom and
z away from the reader, so that a board held upright before the camera has axes parallel to the camera's.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration import grid
from controller.errors import CalibrationError, InputError

Array = NDArray[np.float64]

#: Maps `board` into `table` when the print lies on the table: y and z turn over.
T_TABLE_BOARD: Array = np.diag([1.0, -1.0, -1.0, 1.0])
#: A view needs more corners than its pose and a share of the lens have unknowns.
MIN_CORNERS = 8
#: Largest half width of the sub-pixel window, px: a wider one sees the lens bend the edges.
MAX_WINDOW = 5
#: A corner this far from where the others put it, as a share of the pitch, was read off something else; lenses bend
#: boards by less.
_STRAY = 0.04
#: Points sampled along each edge.
_EDGE_POINTS = 12
#: Standard deviation of the smoothing before refinement, px.
_SMOOTHING = 0.7

_ALLOWED = (
    "chessboard:COLSxROWS:SQUARE_MM (inner corners), chessboard:any:SQUARE_MM, "
    "charuco:COLSxROWS:SQUARE_MM:MARKER_MM:DICT[:legacy] (squares), circles:COLSxROWS:PITCH_MM, "
    "acircles:COLSxROWS:PITCH_MM (every second row shifted by PITCH, discs 2 PITCH apart in a row)"
)


class BoardKind(StrEnum):
    """What is printed."""

    CHESSBOARD = "chessboard"
    OVERFILLED = "chessboard:any"
    CHARUCO = "charuco"
    CIRCLES = "circles"
    STAGGERED = "acircles"


class BoardNotFound(CalibrationError):
    """The picture does not show this board well enough to be used."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """One board as seen in one image.

    Attributes:
        object_points: ndarray of shape (N, 3), corners (or disc centres) in `board`, mm.
        image_points: ndarray of shape (N, 2), the same in the image, px, sub-pixel.
        ids: ndarray of shape (N,), int: the corner's number, row by row from the print's upper left; for
            a board that overfills the view the numbers mean nothing across images.
        image_size: (width, height), px.
    """

    object_points: Array
    image_points: Array
    ids: NDArray[np.int64]
    image_size: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Board:
    """A printed board.

    Attributes:
        spec: The text it was made from.
        kind: What is printed.
        columns, rows: Inner corners (chessboard), squares (ChArUco) or discs; 0 for an overfilled view.
        pitch: Side of a square or distance of two discs, mm.
        marker: Side of a ChArUco marker, mm; 0 for the others.
        dictionary: Name of the ChArUco dictionary; "" for the others.
        legacy: ChArUco layout of OpenCV before 4.6 (a marker in the first square of even-rowed boards).
    """

    spec: str
    kind: BoardKind
    columns: int
    rows: int
    pitch: float
    marker: float = 0.0
    dictionary: str = ""
    legacy: bool = False

    @property
    def squares(self) -> tuple[int, int]:
        """Cells of the print (columns, rows), each `pitch` wide."""
        extra = 1 if self.kind is BoardKind.CHESSBOARD else 0
        return self.columns + extra, self.rows + extra

    @property
    def print_size(self) -> tuple[float, float]:
        """(width, height) of the print, mm: the cells and a white border of half a cell around them."""
        columns, rows = self.squares
        return (columns + 1) * self.pitch, (rows + 1) * self.pitch

    @property
    def corners(self) -> Array:
        """Every corner (or disc centre) in `board`, mm, row by row; shape (N, 3)."""
        if self.kind is BoardKind.OVERFILLED:
            raise InputError(f"{self.spec} has no fixed corners", "name the number of inner corners")
        columns, rows = self.columns, self.rows
        if self.kind is BoardKind.CHARUCO:
            columns, rows = columns - 1, rows - 1
        x = (np.arange(columns) - (columns - 1) / 2) * self.pitch
        y = (np.arange(rows) - (rows - 1) / 2) * self.pitch
        if self.kind is BoardKind.STAGGERED:
            shifted = 2.0 * np.tile(np.arange(columns), (rows, 1)) + np.arange(rows)[:, None] % 2
            x = (shifted - (2 * columns - 1) / 2).ravel() * self.pitch
            return np.column_stack([x, np.repeat(y, columns), np.zeros(columns * rows)])
        return np.column_stack([np.tile(x, rows), np.repeat(y, columns), np.zeros(columns * rows)])

    @property
    def free(self) -> float:
        """How far from an edge between two squares nothing else is printed, as a share of the pitch.

        Most of the margin between marker and square, or of a square: perspective may narrow it.
        """
        if self.kind is BoardKind.CHARUCO:
            return 0.8 * (self.pitch - self.marker) / 2 / self.pitch
        return 0.4

    def edge_points(self) -> tuple[Array, Array]:
        """Points (N, 3) on the edges between neighbouring corners, and each edge's vector (N, 3), `board`, mm."""
        corners = self.corners
        columns = round((corners[:, 0].max() - corners[0, 0]) / self.pitch) + 1
        grid_ = corners.reshape(-1, columns, 3)
        pairs = ((grid_[:, :-1], grid_[:, 1:]), (grid_[:-1], grid_[1:]))
        starts = np.concatenate([a.reshape(-1, 3) for a, _ in pairs])
        vectors = np.concatenate([(b - a).reshape(-1, 3) for a, b in pairs])
        shares = np.linspace(0.15, 0.85, _EDGE_POINTS)
        points = starts[:, None] + shares[:, None] * vectors[:, None]
        return points.reshape(-1, 3), np.repeat(vectors, _EDGE_POINTS, axis=0)

    def draw(self, pixel_mm: float) -> NDArray[np.uint8]:
        """The print, ndarray of shape (H, W), dtype uint8, one pixel being `pixel_mm` wide.

        Raises:
            InputError: The board has no fixed size, or its details would be smaller than a pixel.
        """
        if self.kind is BoardKind.STAGGERED:
            raise InputError(f"{self.spec} is read, not printed", "print charuco:10x7:28:21:DICT_5X5_100 instead")
        if self.kind is BoardKind.OVERFILLED:
            raise InputError(f"{self.spec} has no size to print", "name its inner corners, e.g. chessboard:13x9:20")
        cell = round(self.pitch / pixel_mm)
        if abs(cell * pixel_mm - self.pitch) > 1e-6 * self.pitch or cell % 2 or cell < 4:
            raise InputError(
                f"{self.pitch:g} mm is not an even number of pixels of {pixel_mm:g} mm",
                f"take a pixel of {self.pitch / max(4, 2 * round(self.pitch / pixel_mm / 2)):.6g} mm",
            )
        columns, rows = self.squares
        if self.kind is BoardKind.CHESSBOARD:
            white = np.add.outer(np.arange(rows), np.arange(columns)) % 2
            cells = (np.kron(white, np.ones((cell, cell))) * 255).astype(np.uint8)
        elif self.kind is BoardKind.CIRCLES:
            cells = self._discs(cell)
        else:
            size = (columns * cell, rows * cell)
            cells = np.asarray(_charuco(self).generateImage(size), np.uint8)
        return np.pad(cells, cell // 2, constant_values=255)

    def find(self, image: NDArray[np.uint8]) -> BoardView:
        """The board in an image of shape (H, W) or (H, W, 3), dtype uint8, sub-pixel refined.

        Raises:
            BoardNotFound: It is not there, or too little of it; the cause says what was seen instead.
        """
        gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        if self.kind is BoardKind.CHARUCO:
            pixels, ids = _find_charuco(self, gray)
            points = self.corners[ids]
        elif self.kind is BoardKind.OVERFILLED:
            rough, cells = grid.find(gray)
            pixels = refine(gray, rough, self.free) if len(rough) else rough
            points = np.column_stack([cells * self.pitch, np.zeros(len(cells))])
            ids = np.arange(len(points))
        else:
            found = _find_chessboard(self, gray) if self.kind is BoardKind.CHESSBOARD else _find_circles(self, gray)
            pixels, ids, points = found, np.arange(len(found)), self.corners
        # At the border the window around a corner is cut off and shifts it by up to 2 px.
        size = np.array(gray.shape[::-1])
        whole = ((pixels > MAX_WINDOW) & (pixels < size - 1 - MAX_WINDOW)).all(axis=1)
        pixels, ids, points = pixels[whole], ids[whole], points[whole]
        if len(pixels) < MIN_CORNERS:
            raise BoardNotFound(f"only {len(pixels)} corners of {self.spec} seen, {MIN_CORNERS} are needed")
        spread = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)
        if spread[1] < 0.5 * self.pitch:
            raise BoardNotFound(f"the {len(pixels)} corners of {self.spec} seen lie on one line")
        return BoardView(points, pixels, ids, (gray.shape[1], gray.shape[0]))

    def _discs(self, cell: int) -> NDArray[np.uint8]:
        """Discs of diameter 0.6 pitch, drawn four times too large and averaged, so that edges are true."""
        axis = (np.arange(4 * cell) + 0.5) / (4 * cell) - 0.5
        inside = np.add.outer(axis**2, axis**2) < 0.3**2
        one = 255 - 255 * inside.reshape(cell, 4, cell, 4).mean(axis=(1, 3))
        return np.asarray(np.rint(np.tile(one, (self.rows, self.columns))), np.uint8)


def parse_board(spec: str) -> Board:
    """The board named by a SPEC of the command line.

    Raises:
        InputError: The text names no board; the remedy lists what is allowed.
    """
    parts = spec.strip().split(":")
    kind, fields = parts[0].lower(), parts[1:]
    try:
        if kind == "chessboard" and len(fields) == 2:
            if fields[0].lower() == "any":
                return Board(spec, BoardKind.OVERFILLED, 0, 0, _length(fields[1]))
            return Board(spec, BoardKind.CHESSBOARD, *_count(fields[0], 3), _length(fields[1]))
        if kind == "acircles" and len(fields) == 2:
            return Board(spec, BoardKind.STAGGERED, *_count(fields[0], 3), _length(fields[1]))
        if kind == "circles" and len(fields) == 2:
            return Board(spec, BoardKind.CIRCLES, *_count(fields[0], 3), _length(fields[1]))
        if kind == "charuco" and (len(fields) == 4 or (len(fields) == 5 and fields[4].lower() == "legacy")):
            return _parse_charuco(spec, fields)
    except ValueError as error:
        raise InputError(f"board {spec!r}: {error}", f"allowed: {_ALLOWED}") from None
    raise InputError(f"board {spec!r} is not known", f"allowed: {_ALLOWED}")


def _parse_charuco(spec: str, fields: list[str]) -> Board:
    columns, rows = _count(fields[0], 3)
    square, marker = _length(fields[1]), _length(fields[2])
    name = fields[3].upper() if fields[3].upper().startswith("DICT_") else f"DICT_{fields[3].upper()}"
    if marker >= square:
        raise ValueError(f"its markers of {marker:g} mm do not fit into squares of {square:g} mm")
    if not isinstance(getattr(cv2.aruco, name, None), int):
        raise ValueError(f"no dictionary {fields[3]!r}; e.g. DICT_4X4_50, DICT_5X5_100, DICT_6X6_250")
    board = Board(spec, BoardKind.CHARUCO, columns, rows, square, marker, name, len(fields) == 5)
    if (size := len(_dictionary(name).bytesList)) < columns * rows // 2:
        raise ValueError(f"{name} has {size} markers, the board needs {columns * rows // 2}")
    return board


def _count(text: str, least: int) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", text)
    if not match:
        raise ValueError(f"{text!r} is not COLSxROWS")
    columns, rows = int(match[1]), int(match[2])
    if min(columns, rows) < least or max(columns, rows) > 100:
        raise ValueError(f"{text!r} must lie between {least}x{least} and 100x100")
    return columns, rows


def _length(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{text!r} is not a length in mm") from None
    if not (math.isfinite(value) and 0.1 <= value <= 1000.0):
        raise ValueError(f"{text} mm is not between 0.1 and 1000 mm")
    return value


# --- ChArUco ------------------------------------------------------------------------------------------


@cache
def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


@cache
def _charuco(board: Board) -> Any:
    printed = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.pitch, board.marker, _dictionary(board.dictionary)
    )
    printed.setLegacyPattern(board.legacy)
    return printed


def _find_charuco(board: Board, gray: NDArray[np.uint8]) -> tuple[Array, NDArray[np.int64]]:
    pixels, ids, _, markers = cv2.aruco.CharucoDetector(_charuco(board)).detectBoard(gray)
    sure = pixels is not None and len(pixels) >= MIN_CORNERS
    if not sure:
        # Too many markers were missed: those that were read tell where the others must be.
        parameters = cv2.aruco.CharucoParameters()
        parameters.tryRefineMarkers = True
        pixels, ids, _, markers = cv2.aruco.CharucoDetector(_charuco(board), parameters).detectBoard(gray)
    if pixels is None or ids is None or len(pixels) == 0:
        seen = 0 if markers is None else len(markers)
        raise BoardNotFound(f"no corner of {board.spec} seen ({seen} of its markers)")
    refined = refine(gray, np.asarray(pixels, np.float64).reshape(-1, 2), board.free)
    found = np.asarray(ids, np.int64).ravel()
    if not sure and len(found) >= MIN_CORNERS:
        # What is found so is not always a marker, and then its corners lie elsewhere.
        limit = max(_STRAY * float(np.median(_neighbour_distance(refined))), 0.5)
        _, good = cv2.findHomography(board.corners[found][:, :2], refined, cv2.RANSAC, limit)
        kept = np.asarray(good).ravel() > 0
        refined, found = refined[kept], found[kept]
    return refined, found


# --- chessboards and discs ----------------------------------------------------------------------------


def refine(gray: NDArray[np.uint8], corners: Array, free: float) -> Array:
    """Corners (N, 2) moved to the saddle points of the image, px.

    The picture is smoothed a little first: a sharp one is undersampled and shifts corners with their place
    in the pixel grid (0.05 px per axis against 0.025).

    Args:
        gray: ndarray of shape (H, W), dtype uint8.
        corners: Starting points.
        free: How far around a corner nothing but its four squares is printed, as a share of the distance to
            its next neighbour: the window ends before that.
    """
    smooth = cv2.GaussianBlur(gray, (0, 0), _SMOOTHING)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)
    windows = np.clip(np.floor(free * _neighbour_distance(corners)), 2, MAX_WINDOW).astype(int)
    out = np.empty_like(corners)
    for window in np.unique(windows):
        mine = windows == window
        start = np.ascontiguousarray(corners[mine].reshape(-1, 1, 2), np.float32)
        out[mine] = cv2.cornerSubPix(smooth, start, (int(window),) * 2, (-1, -1), criteria).reshape(-1, 2)
    return out


def _neighbour_distance(corners: Array) -> Array:
    """Distance (N,) of each point to its closest neighbour, px."""
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return np.asarray(apart.min(axis=1)) if len(corners) > 1 else np.full(1, 20.0)


def _find_chessboard(board: Board, gray: NDArray[np.uint8]) -> Array:
    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(gray, size, flags=flags | cv2.CALIB_CB_FAST_CHECK)
    if not found:  # the quick search misses boards that touch the border or lie very obliquely
        found, corners = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        raise BoardNotFound(f"no {board.columns}x{board.rows} inner corners seen")
    refined = refine(gray, np.asarray(corners, np.float64).reshape(-1, 2), board.free)
    return _reading_order(gray, refined.reshape(board.rows, board.columns, 2)).reshape(-1, 2)


def _reading_order(gray: NDArray[np.uint8], corners: Array) -> Array:
    """Corners (R, C, 2) with x to the print's right and y to its bottom, and its first square black.

    A print whose corner counts add up to an even number looks the same upside down: then x is taken
    to the right of the image.
    """
    if np.linalg.det(np.stack([corners[0, -1] - corners[0, 0], corners[-1, 0] - corners[0, 0]])) < 0:
        corners = corners[:, ::-1]
    rows, columns = corners.shape[:2]
    if (rows + columns) % 2 and rows > 2 and columns > 2:
        centres = (corners[:-1, :-1] + corners[1:, 1:] + corners[1:, :-1] + corners[:-1, 1:]) / 4
        pixels = np.rint(centres).astype(int)
        values = gray[pixels[..., 1], pixels[..., 0]].astype(float)
        sign = (-1.0) ** np.add.outer(np.arange(rows - 1), np.arange(columns - 1))
        turned = float((sign * values).sum()) > 0.0  # the first one must be the darker
    else:
        turned = bool(corners[0, -1, 0] < corners[0, 0, 0])
    return corners[::-1, ::-1] if turned else corners


def _find_circles(board: Board, gray: NDArray[np.uint8]) -> Array:
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea = 20.0
    parameters.maxArea = gray.size / (board.columns * board.rows)
    parameters.minThreshold, parameters.maxThreshold, parameters.thresholdStep = 20.0, 230.0, 10.0
    parameters.minDistBetweenBlobs = 4.0
    detector = cv2.SimpleBlobDetector.create(parameters)
    size = (board.columns, board.rows)
    if board.kind is BoardKind.STAGGERED:
        found, centres = cv2.findCirclesGrid(
            gray, size, flags=cv2.CALIB_CB_ASYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING, blobDetector=detector
        )
        if not found:
            raise BoardNotFound(f"no staggered grid of {board.columns}x{board.rows} discs seen")
        return np.asarray(centres, np.float64).reshape(-1, 2)
    for extra in (0, cv2.CALIB_CB_CLUSTERING):
        found, centres = cv2.findCirclesGrid(
            gray, size, flags=cv2.CALIB_CB_SYMMETRIC_GRID | extra, blobDetector=detector
        )
        if found:
            ordered = np.asarray(centres, np.float64).reshape(board.rows, board.columns, 2)
            if np.linalg.det(np.stack([ordered[0, -1] - ordered[0, 0], ordered[-1, 0] - ordered[0, 0]])) < 0:
                ordered = ordered[:, ::-1]
            if ordered[0, -1, 0] < ordered[0, 0, 0]:
                ordered = ordered[::-1, ::-1]
            return ordered.reshape(-1, 2)
    raise BoardNotFound(f"no grid of {board.columns}x{board.rows} discs seen")

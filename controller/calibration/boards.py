"""Printed calibration boards: what is on them, and their pictures.

Board coordinates are mm with the origin in the middle of the print, x to its right, y to its bottom and
z away from the reader, so that a board held upright before the camera has axes parallel to the camera's.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.errors import InputError

Array = NDArray[np.float64]

#: Maps `board` into `table` when the print lies on the table: y and z turn over.
T_TABLE_BOARD: Array = np.diag([1.0, -1.0, -1.0, 1.0])
#: Points sampled along each edge.
_EDGE_POINTS = 12


class BoardKind(StrEnum):
    """What is printed."""

    CHESSBOARD = "chessboard"
    OVERFILLED = "chessboard:any"
    CHARUCO = "charuco"
    CIRCLES = "circles"
    STAGGERED = "acircles"


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
            cells = np.asarray(charuco_layout(self).generateImage(size), np.uint8)
        return np.pad(cells, cell // 2, constant_values=255)

    def _discs(self, cell: int) -> NDArray[np.uint8]:
        """Discs of diameter 0.6 pitch, drawn four times too large and averaged, so that edges are true."""
        axis = (np.arange(4 * cell) + 0.5) / (4 * cell) - 0.5
        inside = np.add.outer(axis**2, axis**2) < 0.3**2
        one = 255 - 255 * inside.reshape(cell, 4, cell, 4).mean(axis=(1, 3))
        return np.asarray(np.rint(np.tile(one, (self.rows, self.columns))), np.uint8)


@cache
def aruco_dictionary(name: str) -> Any:
    """OpenCV's dictionary of markers of this name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


@cache
def charuco_layout(board: Board) -> Any:
    """OpenCV's description of a ChArUco board."""
    printed = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.pitch, board.marker, aruco_dictionary(board.dictionary)
    )
    printed.setLegacyPattern(board.legacy)
    return printed

"""The names by which boards are called on the command line."""

from __future__ import annotations

import math
import re

import cv2

from controller.calibration.boards import Board, BoardKind, aruco_dictionary
from controller.errors import InputError

_ALLOWED = (
    "chessboard:COLSxROWS:SQUARE_MM (inner corners), chessboard:any:SQUARE_MM, "
    "charuco:COLSxROWS:SQUARE_MM:MARKER_MM:DICT[:legacy] (squares), circles:COLSxROWS:PITCH_MM, "
    "acircles:COLSxROWS:PITCH_MM (every second row shifted by PITCH, discs 2 PITCH apart in a row)"
)


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
    if (size := len(aruco_dictionary(name).bytesList)) < columns * rows // 2:
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

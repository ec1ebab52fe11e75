"""Corners of printed boards in an image, sub-pixel.

OpenCV finds them roughly; what it returns is brought into the print's own reading order and refined.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration import grid
from controller.calibration.boards import Array, Board, BoardKind, charuco_layout
from controller.errors import CalibrationError

#: A view needs more corners than its pose and a share of the lens have unknowns.
_MIN_CORNERS = 8
#: Largest half width of the sub-pixel window, px: a wider one sees the lens bend the edges.
_MAX_WINDOW = 5
#: A corner this far from where the others put it, as a share of the pitch, was read off something else; lenses bend
#: boards by less.
_STRAY = 0.04
#: Standard deviation of the smoothing before refinement, px.
_SMOOTHING = 0.7


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


def find_board(board: Board, image: NDArray[np.uint8]) -> BoardView:
    """A board in an image of shape (H, W) or (H, W, 3), dtype uint8, sub-pixel refined.

    Raises:
        BoardNotFound: It is not there, or too little of it; the cause says what was seen instead.
    """
    gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    if board.kind is BoardKind.CHARUCO:
        pixels, ids = _find_charuco(board, gray)
        points = board.corners[ids]
    elif board.kind is BoardKind.OVERFILLED:
        rough, cells = grid.find(gray)
        pixels = _refine(gray, rough, board.free) if len(rough) else rough
        points = np.column_stack([cells * board.pitch, np.zeros(len(cells))])
        ids = np.arange(len(points))
    else:
        found = _find_chessboard(board, gray) if board.kind is BoardKind.CHESSBOARD else _find_circles(board, gray)
        pixels, ids, points = found, np.arange(len(found)), board.corners
    # At the border the window around a corner is cut off and shifts it by up to 2 px.
    size = np.array(gray.shape[::-1])
    whole = ((pixels > _MAX_WINDOW) & (pixels < size - 1 - _MAX_WINDOW)).all(axis=1)
    pixels, ids, points = pixels[whole], ids[whole], points[whole]
    if len(pixels) < _MIN_CORNERS:
        raise BoardNotFound(f"only {len(pixels)} corners of {board.spec} seen, {_MIN_CORNERS} are needed")
    spread = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)
    if spread[1] < 0.5 * board.pitch:
        raise BoardNotFound(f"the {len(pixels)} corners of {board.spec} seen lie on one line")
    return BoardView(points, pixels, ids, (gray.shape[1], gray.shape[0]))


def _find_charuco(board: Board, gray: NDArray[np.uint8]) -> tuple[Array, NDArray[np.int64]]:
    pixels, ids, _, markers = cv2.aruco.CharucoDetector(charuco_layout(board)).detectBoard(gray)
    sure = pixels is not None and len(pixels) >= _MIN_CORNERS
    if not sure:
        # Too many markers were missed: those that were read tell where the others must be.
        parameters = cv2.aruco.CharucoParameters()
        parameters.tryRefineMarkers = True
        pixels, ids, _, markers = cv2.aruco.CharucoDetector(charuco_layout(board), parameters).detectBoard(gray)
    if pixels is None or ids is None or len(pixels) == 0:
        seen = 0 if markers is None else len(markers)
        raise BoardNotFound(f"no corner of {board.spec} seen ({seen} of its markers)")
    refined = _refine(gray, np.asarray(pixels, np.float64).reshape(-1, 2), board.free)
    found = np.asarray(ids, np.int64).ravel()
    if not sure and len(found) >= _MIN_CORNERS:
        # What is found so is not always a marker, and then its corners lie elsewhere.
        limit = max(_STRAY * float(np.median(_neighbour_distance(refined))), 0.5)
        _, good = cv2.findHomography(board.corners[found][:, :2], refined, cv2.RANSAC, limit)
        kept = np.asarray(good).ravel() > 0
        refined, found = refined[kept], found[kept]
    return refined, found


def _refine(gray: NDArray[np.uint8], corners: Array, free: float) -> Array:
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
    windows = np.clip(np.floor(free * _neighbour_distance(corners)), 2, _MAX_WINDOW).astype(int)
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
    refined = _refine(gray, np.asarray(corners, np.float64).reshape(-1, 2), board.free)
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

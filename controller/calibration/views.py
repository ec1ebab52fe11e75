"""Which pictures show the board that was named, and what they show instead.

OpenCV's search finds a small chessboard inside every larger one, with an origin that is nobody's: so a chessboard
that is seen whole is counted too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.calibration import grid
from controller.calibration.board_search import BoardNotFound, BoardView, find_board
from controller.calibration.boards import Board, BoardKind

Image = NDArray[np.uint8]

#: Pictures in which another board than the named one is looked for, and corners that are one.
_LOOKED_AT, _LEAST_SEEN = 3, 12


def find_views(
    images: Sequence[tuple[str, Image]], board: Board
) -> tuple[list[tuple[str, BoardView]], list[tuple[str, str]]]:
    """The board in each picture: (name, view) of those that can be used, (name, reason) of the others."""
    seen: list[tuple[str, BoardView]] = []
    rejected: list[tuple[str, str]] = []
    sizes = Counter((image.shape[1], image.shape[0]) for _, image in images)
    usual = sizes.most_common(1)[0][0] if sizes else (0, 0)
    for name, image in images:
        size = (image.shape[1], image.shape[0])
        if size != usual:
            rejected.append((name, f"{size[0]}x{size[1]} px, most pictures have {usual[0]}x{usual[1]}"))
            continue
        try:
            seen.append((name, find_board(board, image)))
        except BoardNotFound as error:
            rejected.append((name, error.cause))
    looked_at = images[:_LOOKED_AT]
    others = {name: why for name, image in looked_at if (why := seen_instead(board, image, bool(seen))) is not None}
    # A wrong SPEC is found in every picture, or in none.
    if others and (not seen or len(others) == len({name for name, _ in looked_at})):
        reasons = dict(rejected) | {name: f"{board.spec} is only a part of its board" for name, _ in seen}
        return [], [*(reasons | others).items()]
    return seen, rejected


def seen_instead(board: Board, image: Image, found: bool) -> str | None:
    """What contradicts the board's SPEC: a chessboard of another size, seen whole; None when nothing does.

    Args:
        board: As named.
        image: ndarray of shape (H, W) or (H, W, 3), dtype uint8.
        found: Whether `board` was found there: then only a larger chessboard counts, for part of the right one may
            be covered.
    """
    if board.kind is not BoardKind.CHESSBOARD:
        return None
    gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    _, cells = grid.find(gray)
    extent = np.ptp(cells, axis=0).astype(int) + 1 if len(cells) else np.zeros(2, int)
    if len(cells) < _LEAST_SEEN or len(cells) != int(extent.prod()):
        return None
    more, fewer = int(extent.max()), int(extent.min())
    own = max(board.columns, board.rows), min(board.columns, board.rows)
    if (more, fewer) == own or (found and more + fewer <= sum(own)):
        return None
    return f"no {board.columns}x{board.rows} inner corners seen, but {more}x{fewer}"

"""Boards are named, drawn, and found again where they were drawn."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from controller.calibration.board_search import BoardNotFound, find_board
from controller.calibration.board_spec import parse_board
from controller.calibration.boards import T_TABLE_BOARD, BoardKind
from controller.errors import InputError
from controller.geometry import pose_from_rvec, transform
from tests.unit.calibration.scene import LENS, paint

SPECS = [
    "chessboard:9x6:20",
    "charuco:10x7:25:18:DICT_5X5_100",
    "charuco:5x8:30:22:DICT_4X4_50:legacy",
    "circles:8x6:25",
]


@pytest.mark.parametrize("spec", SPECS)
def test_a_drawn_board_is_found_where_it_was_shown(spec: str) -> None:
    board = parse_board(spec)
    T = pose_from_rvec([0.3, -0.25, 0.2], [15.0, -20.0, 520.0])
    picture = paint(board.draw(board.pitch / 40), board.pitch / 40, T, LENS, samples=3)
    view = find_board(board, picture)
    truth = LENS.project(transform(T, board.corners[view.ids]))
    distance = np.linalg.norm(view.image_points - truth, axis=1)
    assert len(view.ids) == len(board.corners)
    # cornerSubPix on 8-bit pictures of 3x3 rays a pixel: 0.05 px. A disc's centre is not its picture's
    # centre: at this tilt and size perspective alone moves it by 0.1 px.
    limit = 0.3 if board.kind is BoardKind.CIRCLES else 0.15
    assert distance.max() < limit
    assert np.allclose(view.object_points, board.corners[view.ids])


@pytest.mark.parametrize("spec", SPECS)
def test_board_axes_are_the_prints_own(spec: str) -> None:
    """x to the right of the print, y to its bottom: seen upright, ids run like reading."""
    corners = parse_board(spec).corners
    assert np.allclose(corners.mean(axis=0), 0.0)
    assert corners[0, 0] < 0
    assert corners[0, 1] < 0
    assert corners[1, 0] > corners[0, 0]
    assert corners[1, 1] == corners[0, 1]
    assert np.allclose(transform(T_TABLE_BOARD, [1.0, 2.0, 0.0]), [1.0, -2.0, 0.0])


@pytest.mark.parametrize("turn", [0.0, 1.6, 3.1, -1.5])
def test_a_chessboard_of_odd_sum_knows_its_upper_left(turn: float) -> None:
    board = parse_board("chessboard:8x5:20")
    T = pose_from_rvec([0.0, 0.0, turn], [0.0, 0.0, 500.0])
    view = find_board(board, paint(board.draw(0.5), 0.5, T, LENS))
    truth = LENS.project(transform(T, board.corners))
    # An ambiguity would swap far corners: hundreds of px.
    assert np.linalg.norm(view.image_points - truth, axis=1).max() < 0.5


def test_part_of_a_charuco_board_is_enough() -> None:
    board = parse_board("charuco:10x7:25:18:DICT_5X5_100")
    picture = paint(board.draw(0.625), 0.625, pose_from_rvec([0.0, 0.0, 0.0], [200.0, 90.0, 450.0]), LENS)
    view = find_board(board, picture)
    assert 8 <= len(view.ids) < len(board.corners)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.3), (0.5, -0.4, 2.0), (-0.6, 0.3, -1.0)])
def test_an_overfilled_view_is_indexed_consistently(turn: tuple[float, float, float]) -> None:
    shown = parse_board("chessboard:29x29:15")
    T = pose_from_rvec(turn, [10.0, -5.0, 300.0])
    view = find_board(parse_board("chessboard:any:15"), paint(shown.draw(0.375), 0.375, T, LENS))
    assert len(view.ids) > 60
    # Whatever corner is called (0, 0): every found one is one of the print's, and neighbours stay neighbours.
    truth = LENS.project(transform(T, shown.corners))
    apart = np.linalg.norm(truth[:, None] - view.image_points[None], axis=2)
    assert apart.min(axis=0).max() < 0.5
    matched = shown.corners[apart.argmin(axis=0)]
    offset = matched - view.object_points
    turned = [np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), k) for k in range(4)]
    spread = [np.ptp(matched[:, :2] - view.object_points[:, :2] @ R, axis=0).max() for R in turned]
    assert min(spread) < 1e-6
    assert np.ptp(offset[:, 2]) == 0.0


def test_what_is_not_there_is_not_found() -> None:
    board = parse_board("chessboard:9x6:20")
    empty = np.full((480, 640), 128, np.uint8)
    with pytest.raises(BoardNotFound, match="9x6"):
        find_board(board, empty)
    with pytest.raises(BoardNotFound, match="of its markers"):
        find_board(parse_board("charuco:10x7:25:18:DICT_5X5_100"), np.repeat(empty[..., None], 3, axis=2))
    with pytest.raises(BoardNotFound):
        find_board(parse_board("circles:8x6:25"), empty)
    with pytest.raises(BoardNotFound):
        find_board(parse_board("chessboard:any:20"), empty)


def test_the_print_measures_what_it_says() -> None:
    board = parse_board("chessboard:9x6:20")
    picture = board.draw(0.5)
    assert picture.shape == (round(board.print_size[1] / 0.5), round(board.print_size[0] / 0.5))
    # Border of half a square, then the first square, black.
    assert picture[19, 19] == 255
    assert picture[21, 21] == 0
    assert picture[21, 21 + 40] == 255


@pytest.mark.parametrize(
    "spec",
    [
        "",
        "chessboard",
        "chessboard:9:20",
        "chessboard:9x6",
        "chessboard:9x6:nan",
        "chessboard:9x6:-3",
        "chessboard:2x6:20",
        "chessboard:9x6:20:5",
        "chessboard:999999x6:20",
        "charuco:10x7:25:25:DICT_5X5_100",
        "charuco:10x7:25:18:DICT_9X9_7",
        "charuco:10x7:25:18:DICT_5X5_100:new",
        "charuco:30x30:10:7:DICT_4X4_50",
        "charuco:10x7:25:18:__class__",
        "circles:8x6:inf",
        "blanket:9x6:20",
    ],
)
def test_a_wrong_spec_says_what_is_allowed(spec: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_board(spec)
    assert "chessboard:COLSxROWS:SQUARE_MM" in caught.value.remedy


def test_an_overfilled_board_has_nothing_to_print() -> None:
    with pytest.raises(InputError, match="no size"):
        parse_board("chessboard:any:20").draw(0.5)


def test_details_below_a_pixel_are_refused() -> None:
    with pytest.raises(InputError, match="even number of pixels"):
        parse_board("chessboard:9x6:20").draw(0.7)


def test_a_staggered_grid_of_discs_is_read() -> None:
    """The pattern of OpenCV's own samples: 4 x 11 discs, every second row shifted by half their distance."""
    board = parse_board("acircles:4x11:20")
    pixel = 0.5
    half = np.abs(board.corners[:, :2]).max(axis=0) + 30.0
    print_ = np.full((int(2 * half[1] / pixel), int(2 * half[0] / pixel)), 255, np.uint8)
    for x, y, _ in board.corners:
        at = ((np.array([x, y]) + half) / pixel - 0.5) * 16
        centre = (round(float(at[0])), round(float(at[1])))
        cv2.circle(print_, centre, round(7.0 / pixel * 16), (0.0,), -1, cv2.LINE_AA, 4)
    T = pose_from_rvec([0.2, -0.3, 1.4], [10.0, -5.0, 520.0])
    found = find_board(board, paint(print_, pixel, T, LENS))
    assert len(found.ids) == 44
    # Perspective shifts the middle of a disc's ellipse by some tenths of a pixel.
    expected = LENS.project(found.object_points @ T[:3, :3].T + T[:3, 3])
    assert np.abs(found.image_points - expected).max() < 0.5
    with pytest.raises(InputError, match="read, not printed"):
        board.draw(0.5)

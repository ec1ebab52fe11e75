"""The live guide takes what is steady and new, and asks for what is missing until the lens is pinned."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from controller.calibration.board_spec import parse_board
from controller.calibration.camera import fit_views
from controller.calibration.capture import Capture, Progress, Seen
from controller.calibration.coverage import coverage_picture
from controller.calibration.guided import Wanted, board_pose_for, wanted_views
from controller.errors import InputError
from tests.unit.calibration.scene import paint, small_lens

LENS = small_lens()
BOARD = parse_board("charuco:10x7:28:21:DICT_5X5_100")
PRINT = BOARD.draw(0.7)


def picture(wanted: Wanted) -> NDArray[np.uint8]:
    return paint(PRINT, 0.7, board_pose_for(wanted, BOARD, LENS.image_size), LENS, samples=2)


def shown(capture: Capture, wanted: Wanted) -> Progress:
    image = picture(wanted)
    capture.offer(image)
    return capture.offer(image)


def test_a_view_is_taken_when_it_is_steady_and_new() -> None:
    capture = Capture(BOARD)
    empty = np.full((360, 640), 128, np.uint8)
    assert capture.offer(empty).seen is Seen.NOTHING
    first, second = Wanted((0.0, 0.0), 0.5, 0.1, 0.0), Wanted((0.15, 0.0), 0.5, 0.5, 1.0)
    assert capture.offer(picture(first)).seen is Seen.MOVING
    assert "hold still" in capture.offer(picture(second)).advice
    taken = capture.offer(picture(second))
    assert taken.seen is Seen.TAKEN
    assert taken.views == 1
    # The same again brings nothing, however long it is held.
    assert capture.offer(picture(second)).seen is Seen.KNOWN
    assert capture.offer(picture(second)).views == 1


@pytest.mark.parametrize(
    ("towards", "side"), [(0.0, "lower"), (np.pi / 2, "left"), (np.pi, "upper"), (-np.pi / 2, "right")]
)
def test_the_side_that_is_asked_for_is_the_one_that_counts(towards: float, side: str) -> None:
    """A turn about the picture's x axis (to the right) takes the board's lower side away, right-handed."""
    capture = Capture(BOARD)
    progress = shown(capture, Wanted((0.0, 0.0), 0.5, 0.6, towards))
    assert progress.tilts == tuple(int(name == side) for name in ("upper", "right", "lower", "left"))


def test_the_guide_ends_with_a_lens_that_is_pinned() -> None:
    capture = Capture(BOARD)
    progress = None
    for wanted in wanted_views():
        progress = shown(capture, wanted)
        if progress.done:
            break
    assert progress is not None
    assert progress.done
    made = fit_views(capture.taken, [], BOARD)
    assert abs(made.camera.matrix[0, 0] - LENS.matrix[0, 0]) < 4 * made.sigma["fx"] + 0.5
    shown_picture = coverage_picture([view for _, view in capture.taken], made)
    assert shown_picture.shape == (540 + 120, 960, 3)


def test_frontal_views_alone_are_never_enough() -> None:
    capture = Capture(BOARD)
    for x in (-0.2, 0.0, 0.2):
        for y in (-0.2, 0.0, 0.2):
            progress = shown(capture, Wanted((x, y), 0.4, 0.0, 0.0))
    assert not progress.done
    assert "tilt" in progress.advice or "move" in progress.advice
    assert progress.tilts == (0, 0, 0, 0)


@pytest.mark.parametrize("spec", ["chessboard:8x6:20", "chessboard:10x7:20"])
def test_a_chessboard_of_another_size_is_never_taken_and_named(spec: str) -> None:
    held = parse_board("chessboard:9x6:20")
    wanted = Wanted((0.0, 0.0), 0.6, 0.3, 0.0)
    image = paint(held.draw(0.5), 0.5, board_pose_for(wanted, held, LENS.image_size), LENS)
    capture = Capture(parse_board(spec))
    capture.offer(image)
    told = capture.offer(image)
    assert (told.seen, told.views) == (Seen.NOTHING, 0)
    assert f"SPEC: no {spec.split(':')[1]} inner corners seen, but 9x6" in told.advice
    right = Capture(held)
    right.offer(image)
    assert right.offer(image).seen is Seen.TAKEN


def test_a_board_without_lasting_numbers_is_refused() -> None:
    with pytest.raises(InputError, match="known ones"):
        Capture(parse_board("chessboard:any:15"))

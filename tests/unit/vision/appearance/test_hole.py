"""Where the table shows through a part: one large blob of its colour, whatever else is as bright."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.appearance.hole import holes

_TABLE = np.array([200.0, 200.0, 200.0], np.float32)
_SIDE = 32


def _part(*holes: tuple[int, int, int]) -> NDArray[np.uint8]:
    """A dark square with discs (x, y, radius) of the table's colour."""
    picture = np.full((_SIDE, _SIDE, 3), 60, np.uint8)
    for x, y, radius in holes:
        cv2.circle(picture, (x, y), radius, (200, 200, 200), -1)
    return picture


def _found(picture: NDArray[np.uint8], flagged: bool = False) -> NDArray[np.bool_]:
    (found,) = _all_found([picture], [flagged])
    return np.asarray(found)


def _all_found(pictures: list[NDArray[np.uint8]], flagged: list[bool]) -> NDArray[np.bool_]:
    planes = np.stack(pictures).transpose(3, 0, 1, 2)
    material = np.ones(planes.shape[1:], bool)
    return holes(planes, material, np.repeat(_TABLE[None], len(pictures), axis=0), flagged)


def test_a_hole_is_found_where_it_is() -> None:
    found = _found(_part((15, 16, 7)))
    rows, columns = np.nonzero(found)
    assert (round(columns.mean()), round(rows.mean())) == (15, 16)
    # A disc of radius 7 drawn on pixels covers 149; the majority of 3 x 3 takes a few off its corners.
    assert 140 <= len(rows) <= 149


def test_a_speck_above_the_hole_does_not_hide_it() -> None:
    found = _found(_part((4, 4, 2), (18, 18, 7)))
    assert not found[:8].any()
    assert found[18, 18]


def test_dots_of_the_table_s_colour_are_no_hole() -> None:
    assert not _found(_part((7, 7, 3), (24, 7, 3), (7, 24, 3), (24, 24, 3))).any()


def test_a_plain_part_has_none() -> None:
    assert not _found(_part()).any()


def test_a_hole_in_shade_counts_when_its_outline_was_found() -> None:
    picture = _part()
    cv2.circle(picture, (16, 16), 7, (168, 168, 168), -1)
    assert not _found(picture).any()
    assert _found(picture, flagged=True).any()


def test_parts_looked_at_together_are_looked_at_alone() -> None:
    # The second's hole reaches the first row and the third's the last one: beside one another they are not one.
    pictures = [_part((15, 16, 7)), _part((16, 3, 6)), _part((16, 28, 6)), _part(), _part((10, 20, 5))]
    together = _all_found(pictures, [False] * len(pictures))
    for picture, found in zip(pictures, together, strict=True):
        assert np.array_equal(found, _found(picture))
    assert together.any(axis=(1, 2)).tolist() == [True, True, True, False, True]

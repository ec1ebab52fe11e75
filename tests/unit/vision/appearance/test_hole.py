"""Where the table shows through a part: one large blob of its colour, whatever else is as bright."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.appearance.hole import blob_like_table, like_table, may_show_table

_TABLE = np.array([200.0, 200.0, 200.0], np.float32)
_SIDE = 32


def _part(*holes: tuple[int, int, int]) -> NDArray[np.uint8]:
    """A dark square with discs (x, y, radius) of the table's colour."""
    picture = np.full((_SIDE, _SIDE, 3), 60, np.uint8)
    for x, y, radius in holes:
        cv2.circle(picture, (x, y), radius, (200, 200, 200), -1)
    return picture


def _found(picture: NDArray[np.uint8], flagged: bool = False) -> NDArray[np.uint8] | None:
    material = np.full((_SIDE, _SIDE), 255, np.uint8)
    alike = like_table(picture[None], material[None] > 0, _TABLE[None], [flagged])
    if not may_show_table(picture[None], material[None] > 0, alike)[0]:
        return None
    return blob_like_table(picture, material, alike[0])


def test_a_hole_is_found_where_it_is() -> None:
    found = _found(_part((15, 16, 7)))
    assert found is not None
    rows, columns = np.nonzero(found)
    assert (round(columns.mean()), round(rows.mean())) == (15, 16)
    # A disc of radius 7 drawn on pixels covers 149; the majority of 3 x 3 takes a few off its corners.
    assert 140 <= len(rows) <= 149


def test_a_speck_above_the_hole_does_not_hide_it() -> None:
    found = _found(_part((4, 4, 2), (18, 18, 7)))
    assert found is not None
    assert not found[:8].any()
    assert found[18, 18] == 255


def test_dots_of_the_table_s_colour_are_no_hole() -> None:
    assert _found(_part((7, 7, 3), (24, 7, 3), (7, 24, 3), (24, 24, 3))) is None


def test_a_plain_part_has_none() -> None:
    assert _found(_part()) is None


def test_a_hole_in_shade_counts_when_its_outline_was_found() -> None:
    picture = _part()
    cv2.circle(picture, (16, 16), 7, (168, 168, 168), -1)
    assert _found(picture) is None
    assert _found(picture, flagged=True) is not None

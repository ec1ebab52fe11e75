"""What settled outlines say of regions that were proposed around them."""

from __future__ import annotations

import numpy as np

from controller.vision.proposals import Region
from controller.vision.trial import Settled


def _box(x: int, y: int, wide: int, high: int) -> Region:
    contour = np.array([[x, y], [x + wide - 1, y], [x + wide - 1, y + high - 1], [x, y + high - 1]], np.float32)
    return Region(contour, float(wide * high), "level", 1.0)


def _two_parts() -> Settled:
    """Of 20 x 20 px, 10 px apart."""
    owner = np.zeros((60, 100), np.uint16)
    owner[20:40, 20:40], owner[20:40, 50:70] = 1, 2
    return Settled(owner, np.array([[0.0, 0.0], [20.0, 20.0], [20.0, 20.0]]))


def test_a_region_that_several_parts_fill_is_told_from_one_part_and_from_a_wide_surrounding() -> None:
    settled = _two_parts()
    heap, one, wide = _box(18, 18, 54, 24), _box(18, 18, 24, 24), _box(-10, -10, 130, 90)
    assert settled.fills(heap, 0.3)  # 800 of 1296 px
    assert not settled.fills(one, 0.3)
    assert not settled.fills(wide, 0.3)  # 800 of the 6000 px in the picture


def test_regions_are_explained_by_the_outline_in_their_middle_unless_they_are_much_larger() -> None:
    settled = _two_parts()
    assert settled.explained([_box(19, 19, 22, 22), _box(1, 1, 59, 59), _box(80, 5, 10, 10)]) == [True, False, False]
    assert settled.explained([]) == []

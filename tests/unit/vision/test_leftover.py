"""What stands out and is no known object is told of; shadows and slivers are not."""

from __future__ import annotations

import numpy as np
import pytest

from controller.domain import Shape
from controller.vision.leftover import leftovers
from controller.vision.scene import Found


def square(x: float, y: float, side: float) -> Found:
    half = side / 2.0
    corners = np.array([[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]])
    return Found(Shape.SQUARE, 1.0, corners, corners, corners.mean(axis=0), None, frozenset())


def table(*patches: tuple[int, int, int, int, float]) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """Strength of a table with the square at (50, 50), in the searched image, and patches (x, y, width, height)."""
    strength = np.full((120, 160), 5.0, np.float32)
    strength[40:61, 40:61] = 100.0
    for x, y, width, height, level in patches:
        strength[y : y + height, x : x + width] = level
    return strength


@pytest.mark.parametrize(
    ("patch", "told"),
    [
        ((61, 45, 14, 14, 90.0), True),  # a part that leans on the square
        ((61, 45, 14, 14, 50.0), False),  # a shadow
        ((61, 40, 3, 21, 90.0), False),  # the blur of its edge
    ],
)
def test_a_patch_as_strong_as_the_objects_is_one(patch: tuple[int, int, int, int, float], told: bool) -> None:
    found = leftovers(table(patch), [square(100.5, 100.5, 40.0)], 2, None, 6.0)
    assert bool(found) == told
    if told:
        (one,) = found
        x, y, width, height, _ = patch
        assert one.shape is Shape.OTHER
        # Up to the blur beside the square is left out, and pixels of the searched image are two wide.
        assert one.center == pytest.approx([2.0 * x + width + 1.0, 2.0 * y + height - 0.5], abs=3.0)


def test_a_faint_part_is_told_of_where_another_as_faint_is_known() -> None:
    """Two parts of one colour that touch may have no outline that fits; dyes differ in how clearly they stand out."""
    strength = table((61, 45, 14, 14, 60.0), (100, 40, 21, 21, 65.0))
    known = [square(100.5, 100.5, 40.0), square(220.5, 100.5, 40.0)]
    assert len(leftovers(strength, known, 2, None, 6.0)) == 1
    assert leftovers(strength, known[:1], 2, None, 6.0) == []


def test_only_the_region_counts() -> None:
    region = np.zeros((120, 160), np.uint8)
    assert leftovers(table((61, 45, 14, 14, 90.0)), [square(100.5, 100.5, 40.0)], 2, region, 6.0) == []

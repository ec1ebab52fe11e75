"""What stands out and is no known object is told of; shadows and slivers are not."""

from __future__ import annotations

import numpy as np
import pytest

from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.domain import Frame, Shape
from controller.service.manual import by_ruler
from controller.vision.detect import detect
from controller.vision.leftover import leftovers
from controller.vision.recipe import load_recipe
from controller.vision.scene import Found
from tests.unit.vision.pictures import at, corners, paint

TABLE = (170.0, 178.0, 182.0)
PURPLE, SHADE = (160.0, 105.0, 140.0), (129.0, 135.0, 138.0)
DYES = ((180.0, 90.0, 20.0), (30.0, 40.0, 190.0), (40.0, 190.0, 220.0))
"""Blue, red and yellow stand out twice as clearly from the table as purple."""


def square(x: float, y: float, side: float) -> Found:
    half = side / 2.0
    corners = np.array([[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]])
    return Found(Shape.SQUARE, 1.0, corners, corners, corners.mean(axis=0), None, frozenset())


KNOWN = [square(100.5, 100.5, 40.0)]


def gray(where: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Everything has the table's colour."""
    return np.ones(np.count_nonzero(where), bool)


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
    found = leftovers(table(patch), KNOWN, KNOWN, 2, None, 6.0, gray)
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
    known = [*KNOWN, square(220.5, 100.5, 40.0)]
    assert len(leftovers(strength, known, known, 2, None, 6.0, gray)) == 1
    assert leftovers(strength, KNOWN, KNOWN, 2, None, 6.0, gray) == []


def test_only_the_region_counts() -> None:
    region = np.zeros((120, 160), np.uint8)
    assert leftovers(table((61, 45, 14, 14, 90.0)), KNOWN, KNOWN, 2, region, 6.0, gray) == []


def test_a_colour_that_no_shadow_has_tells_at_half_the_strength() -> None:
    strength = table((61, 45, 14, 14, 60.0), (100, 40, 21, 21, 60.0), (100, 80, 21, 21, 40.0))

    def left_half(where: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.asarray(np.nonzero(where)[1] < 80)

    (one,) = leftovers(strength, KNOWN, KNOWN, 2, None, 6.0, left_half)
    assert one.center == pytest.approx([220.5, 100.5], abs=2.0)


def test_a_dye_fainter_than_the_others_is_told_of_though_no_outline_fits_and_a_shadow_is_not() -> None:
    """Above the table, where sides show: a lump that leans on a square of its colour, and a shadow as strong."""
    turns = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)
    radii = 24.0 + 6.0 * np.sin(3.0 * turns)
    lump = at(np.stack([radii * np.cos(turns), radii * np.sin(turns)], axis=1), 45.0, 12.0)
    squares = [corners(Shape.SQUARE, 60.0, 0.3 * k) for k in range(5)]
    tiles = [[(squares[k], DYES[k % 3])] for k in range(4)]
    tiles += [[(lump, PURPLE), (squares[4], PURPLE)], [(lump, SHADE), (squares[4], DYES[0])]]
    picture = np.asarray(TABLE + np.random.default_rng(0).normal(0.0, 2.0, (720, 1280, 3)), np.uint8)
    for k, things in enumerate(tiles):
        x, y = 400 + 160 * (k % 4), 150 + 160 * (k // 4)
        moved = [(at(outline, 80.0, 80.0), colour) for outline, colour in things]
        picture[y : y + 160, x : x + 160] = paint(moved, (160, 160), TABLE, seed=k)
    plane = by_ruler(load_cell(shipped("sim.toml"))).plane(12.0)
    seen = detect(Frame(1, 0.0, picture), load_recipe("precise"), plane=plane).detections
    (other,) = [item for item in seen if item.shape is Shape.OTHER]
    # Of the lump, the half beyond the square.
    assert other.center_px == pytest.approx((527.0, 400.0), abs=8.0)
    assert len(seen) == 7

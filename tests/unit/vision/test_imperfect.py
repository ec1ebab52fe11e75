"""What is not as drawn: worn outlines, glints, prints, stains and crumbs."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.domain import Detection, Shape
from controller.vision.detect import detect
from controller.vision.recipe import load_recipe
from controller.vision.scene import overlap
from controller.vision.wear import round_outline
from tests.unit.vision.pictures import at, corners, frame, paint

RECIPE = load_recipe("precise")
DARK = (70.0, 75.0, 65.0)
TURNS = np.arange(360) * math.pi / 180.0


def found(image: NDArray[np.uint8]) -> tuple[Detection, ...]:
    return detect(frame(image), RECIPE).detections


def shapes(image: NDArray[np.uint8]) -> list[Shape]:
    return sorted(item.shape for item in found(image))


def wavy(radius: float, waves: dict[int, float]) -> NDArray[np.float64]:
    """A disc whose radius changes by these shares, so many times a turn."""
    r = radius * (1.0 + sum(share * np.cos(k * TURNS + k * k) for k, share in waves.items()))
    return np.asarray(np.stack([r * np.cos(TURNS), r * np.sin(TURNS)], axis=1))


def test_a_worn_coin_is_a_circle() -> None:
    # 1.6 % of the radius in all, spread over many waves: what old coins show.
    coin = wavy(40.0, {3: 0.008, 4: 0.008, 5: 0.009, 7: 0.008, 9: 0.006})
    (item,) = found(paint([(at(coin, 160, 120), DARK)]))
    assert item.shape is Shape.CIRCLE
    assert item.score < 0.9


@pytest.mark.parametrize("waves", [{2: 0.03}, {4: 0.025}, {5: 0.025}, {8: 0.02}])
def test_what_repeats_itself_around_is_another_shape(waves: dict[int, float]) -> None:
    assert shapes(paint([(at(wavy(45.0, waves), 160, 120), DARK)])) == [Shape.OTHER]


def test_a_glint_is_no_part_and_breaks_none() -> None:
    disc, glint = at(corners(Shape.CIRCLE, 90.0), 160, 120), at(corners(Shape.CIRCLE, 22.0), 145, 100)
    (item,) = found(paint([(disc, (40.0, 40.0, 190.0)), (glint, (250.0, 250.0, 250.0))], table=(230.0, 230.0, 230.0)))
    assert item.shape is Shape.CIRCLE
    assert item.center_px == pytest.approx((160.0, 120.0), abs=0.3)


def test_prints_on_a_part_of_no_known_shape_are_no_parts() -> None:
    star = [(r * math.cos(t), r * math.sin(t)) for t, r in zip(np.arange(10) * math.pi / 5, [90, 50] * 5, strict=True)]
    prints = [(at(corners(Shape.SQUARE, 18.0), 150 + 30 * k, 120), (240.0, 240.0, 240.0)) for k in range(2)]
    # On a table of another gray, so that the prints do not look like holes.
    picture = paint([(at(np.array(star), 160, 120), DARK), *prints], table=(160.0, 160.0, 160.0))
    assert shapes(picture) == [Shape.OTHER]


def test_a_stain_beside_dark_parts_is_no_part() -> None:
    part = (at(corners(Shape.HEXAGON, 60.0), 90, 120), (40.0, 40.0, 40.0))
    stain = at(corners(Shape.TRIANGLE, 26.0), 220, 120), (193.0, 193.0, 193.0)
    assert shapes(paint([part, stain], blur=1.2)) == [Shape.HEXAGON]


def test_a_faint_part_alone_is_found() -> None:
    assert shapes(paint([(at(corners(Shape.HEXAGON, 60.0), 90, 120), (188.0, 188.0, 188.0))])) == [Shape.HEXAGON]


def test_outlines_that_coincide_overlap_wholly() -> None:
    ring = at(corners(Shape.CIRCLE, 53.0)[::5], 268.7, 117.1)
    assert overlap(ring, ring.copy()) > 0.95
    assert overlap(ring, ring + 1e-4) > 0.95
    assert overlap(ring, ring + 60.0) == 0.0


def test_a_disc_with_a_bite_is_round_and_half_a_disc_is_not() -> None:
    whole = wavy(40.0, {})[::4]
    bitten = whole.copy()
    bitten[:15] *= 0.8
    assert round_outline(whole, 0.5) is not None
    disc = round_outline(bitten, 0.5)
    assert disc is not None
    # A sixth of the outline is missing; the rest is exact.
    assert disc[0] == pytest.approx((0.0, 0.0), abs=0.5)
    assert disc[1] == pytest.approx(40.0, abs=0.5)
    assert round_outline(whole * [1.0, 0.85], 0.5) is None
    half = whole.copy()
    half[half[:, 1] < 0.0, 1] = 0.0
    assert round_outline(half, 0.5) is None
    hexagon = cv2.convexHull(corners(Shape.HEXAGON, 80.0).astype(np.float32))[:, 0].astype(float)
    sides = zip(hexagon, np.roll(hexagon, -1, axis=0), strict=True)
    assert round_outline(np.concatenate([a + (b - a) * np.linspace(0, 1, 16)[:, None] for a, b in sides]), 0.5) is None


def test_touching_parts_are_flagged_and_others_are_not() -> None:
    left, right = at(corners(Shape.SQUARE, 50.0), 80, 120), at(corners(Shape.CIRCLE, 44.0), 80 + 25 + 22, 120)
    alone = at(corners(Shape.HEXAGON, 50.0), 250, 120)
    items = found(paint([(left, DARK), (right, (90.0, 70.0, 160.0)), (alone, DARK)]))
    assert {item.shape: sorted(item.flags) for item in items} == {
        Shape.SQUARE: ["touching"], Shape.CIRCLE: ["touching"], Shape.HEXAGON: [],
    }  # fmt: skip


def test_things_on_a_sheet_are_found_and_the_sheet_is_none() -> None:
    sheet = at(np.array([[0, 0], [200, 10], [190, 160], [-10, 150]], float), 60, 40), (235.0, 238.0, 240.0)
    things = [
        (at(corners(Shape.SQUARE, 40.0, 0.3), 110, 90), DARK),
        (at(corners(Shape.CIRCLE, 36.0), 180, 130), (60.0, 60.0, 200.0)),
        (at(corners(Shape.HEXAGON, 30.0), 290, 210), (200.0, 90.0, 40.0)),
    ]
    items = found(paint([sheet, *things], table=(60.0, 80.0, 110.0)))
    assert sorted(item.shape for item in items) == [Shape.CIRCLE, Shape.HEXAGON, Shape.SQUARE]
    places = {item.shape: item.center_px for item in items}
    assert places[Shape.SQUARE] == pytest.approx((110.0, 90.0), abs=0.1)
    assert places[Shape.HEXAGON] == pytest.approx((290.0, 210.0), abs=0.1)


def test_a_large_part_with_one_print_is_a_part() -> None:
    plate, mark = at(corners(Shape.SQUARE, 180.0), 160, 120), at(corners(Shape.CIRCLE, 30.0), 150, 110)
    assert shapes(paint([(plate, DARK), (mark, (240.0, 240.0, 240.0))], table=(150.0, 150.0, 150.0))) == [Shape.SQUARE]


def test_a_shadow_as_dark_as_its_part_is_left_out() -> None:
    outline = at(corners(Shape.HEXAGON, 60.0, 0.3), 150.0, 110.0)
    shade: NDArray[np.float64] = np.zeros((240, 320))
    cv2.fillPoly(shade, [np.rint(at(outline, 7, 8)).astype(np.int32)], (1.0,))
    light = 1.0 - 0.4 * cv2.GaussianBlur(shade, (0, 0), 3.0)
    cover = paint([(outline, (0.0, 0.0, 0.0))], table=(255.0, 255.0, 255.0), noise=0.0)[:, :, :1] / 255.0
    # Of the gray of the shadow's core, 200 * 0.6, but greenish.
    colour = np.array([105.0, 135.0, 105.0])
    picture = paint([]).astype(float) * light[:, :, None] * cover + colour * (1.0 - cover)
    (item,) = found(np.asarray(np.clip(picture, 0, 255), np.uint8))
    assert item.shape is Shape.HEXAGON
    assert item.center_px == pytest.approx((150.0, 110.0), abs=0.3)


def striped(things: list[tuple[NDArray[np.float64], tuple[float, float, float]]], seed: int) -> NDArray[np.uint8]:
    """A table with broad dark stripes and a printed ring, with things on it."""
    table = np.where((np.arange(320) // 40) % 2, 120.0, 190.0)[None, :, None] * np.ones((240, 320, 3))
    cv2.circle(table, (60, 180), 30, (60.0, 60.0, 60.0), 6)
    for outline, colour in things:
        cover = paint([(outline, (255.0, 255.0, 255.0))], table=(0.0, 0.0, 0.0), blur=0.3, noise=0.0) / 255.0
        table = table * (1.0 - cover) + np.array(colour) * cover
    noisy = cv2.GaussianBlur(table, (0, 0), 0.8) + np.random.default_rng(seed).normal(0.0, 2.0, table.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)


def test_a_picture_of_the_empty_table_takes_out_what_is_printed_on_it() -> None:
    empty = striped([], 1)
    assert detect(frame(striped([], 2)), RECIPE, background=empty).detections == ()
    things = [(at(corners(Shape.HEXAGON, 60.0), 120, 70), (30.0, 40.0, 200.0))]
    items = detect(frame(striped(things, 3)), RECIPE, background=empty).detections
    assert [item.shape for item in items] == [Shape.HEXAGON]
    assert items[0].center_px == pytest.approx((120.0, 70.0), abs=0.1)

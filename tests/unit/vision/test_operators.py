"""Operators and edge detectors on pictures whose answer is known."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from controller.domain import Descriptors, Shape
from controller.errors import ConfigError, InputError
from controller.vision import edges, morphology, operators
from controller.vision.descriptors import classify, corners, describe
from controller.vision.detect import detect
from controller.vision.recipe import Ranges, Recipe, load_recipe
from tests.unit.vision.pictures import at, frame, paint
from tests.unit.vision.pictures import corners as outline_of


def step(levels: tuple[int, int] = (50, 200)) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    picture = np.full((40, 60), levels[0], np.uint8)
    picture[:, 30:] = levels[1]
    return picture


@pytest.mark.parametrize("kernel", ["sobel", "prewitt", "roberts"])
def test_gradient_edges_lie_on_the_step_and_nowhere_else(kernel: str) -> None:
    found = edges.gradient_edges(step(), kernel)
    ys, xs = np.nonzero(found)
    assert set(xs) <= {28, 29, 30}
    assert len(set(ys)) >= 37


def test_zero_crossings_and_canny_lie_on_the_step() -> None:
    for found in (edges.zero_crossings(step()), edges.canny(step())):
        ys, xs = np.nonzero(found)
        assert set(xs) <= {28, 29, 30}
        assert len(set(ys)) >= 36


def test_a_flat_picture_has_no_edges() -> None:
    flat = np.full((30, 30), 90, np.uint8)
    for found in (edges.canny(flat), edges.gradient_edges(flat), edges.zero_crossings(flat)):
        assert not found.any()


def test_the_automatic_threshold_leaves_seven_tenths_below() -> None:
    magnitude = np.linspace(0.0, 1.0, 10_000, dtype=np.float32).reshape(100, 100)
    # Bins are 1/63 wide and centred: the bin that passes 70 % is the 45th.
    assert edges.automatic_high(magnitude) == pytest.approx(45 / 64)


def test_otsu_parts_two_levels_and_takes_the_inner_side_as_objects() -> None:
    picture = np.full((40, 40), 180, np.uint8)
    picture[10:30, 10:30] = 40
    assert 40 <= operators.otsu_threshold(picture) < 180
    mask = operators.otsu(picture)
    assert mask.sum() == 400
    assert mask[20, 20] == 1


def test_homomorphic_filter_evens_out_a_gradient() -> None:
    light = np.linspace(0.4, 1.0, 200)[None].repeat(100, 0)
    picture = np.rint(150.0 * light).astype(np.uint8)
    out = operators.homomorphic(picture).astype(float)
    spread = (out.max() - out.min()) / out.mean()
    assert spread < 0.75 * (picture.max() - float(picture.min())) / picture.mean()


def test_equalised_levels_spread_over_the_range() -> None:
    picture = np.arange(100, 140, dtype=np.uint8)[None].repeat(40, 0)
    out = operators.equalise(picture)
    assert out.min() == 0
    assert out.max() == 255


def test_bwarea_weighs_the_sixteen_windows() -> None:
    assert morphology.bwarea(np.array([[1]], np.uint8)) == 4 * 0.25
    # Two pixels across a diagonal: two windows of one pixel each at the ends are six, one window of 3/4.
    assert morphology.bwarea(np.array([[1, 0], [0, 1]], np.uint8)) == 6 * 0.25 + 0.75


def test_descriptors_of_an_upright_square() -> None:
    found = describe(np.ones((24, 24), np.uint8))
    # bwarea of a 24 x 24 block: 23^2 whole windows, 4 * 23 half ones, 4 corners of a quarter.
    assert found.extent == pytest.approx(576 / (529 + 46 + 1))
    assert found.compactness == pytest.approx((4 * 23) ** 2 / (4 * math.pi * 576))
    assert found.side_difference == 0.0


def test_corners_of_a_rectangle_are_its_corners() -> None:
    found = corners(np.ones((20, 40), np.uint8))
    wanted = np.array([[0, 0], [39, 0], [39, 19], [0, 19]], float)
    for corner in wanted:
        # The Harris response peaks up to two pixels inside.
        assert np.abs(found - corner).sum(axis=1).min() <= 4.0


@pytest.mark.parametrize(
    ("values", "shape"),
    [
        (Descriptors(1.0, 1.2, 0.5), Shape.SQUARE),
        (Descriptors(1.05, 1.4, 20.0), Shape.RECTANGLE),
        (Descriptors(1.27, 1.01, 3.0), Shape.CIRCLE),
        (Descriptors(1.36, 1.1, 3.0), Shape.HEXAGON),
        (Descriptors(1.9, 1.6, 3.0), Shape.OTHER),
    ],
)
def test_ranges_sort_ideal_values(values: Descriptors, shape: Shape) -> None:
    assert classify(values, 60.0**2, Ranges()) is shape


def test_the_paper_finds_an_upright_square_and_its_ellipse_angle() -> None:
    things = [
        (at(outline_of(Shape.SQUARE, 50), 80, 120), (60.0, 60.0, 60.0)),
        (at(outline_of(Shape.RECTANGLE, 40, math.radians(30)), 220, 120), (60.0, 60.0, 60.0)),
    ]
    trace: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]] = {}
    found = detect(frame(paint(things)), load_recipe("paper"), trace=trace).detections
    square = min(found, key=lambda d: abs(d.center_px[0] - 80))
    turned = min(found, key=lambda d: abs(d.center_px[0] - 220))
    assert square.shape is Shape.SQUARE
    # Filled edges include the edge pixel; the centroid does not mind.
    assert square.center_px == pytest.approx((80, 120), abs=0.2)
    assert turned.angle == pytest.approx(math.radians(30), abs=math.radians(1.5))
    assert next(iter(trace)) == "01_unsharp_mask"
    assert "05_canny" in trace


CLOSED = ('op = "close_disk"\nradius = 3', 'op = "fill_holes"', 'op = "open_disk"')


def chain(*stages: str) -> str:
    tables = "\n".join(f"[[stages]]\n{stage}" for stage in stages)
    return f'name = "mine"\nmethod = "stages"\n{tables}\n'


@pytest.mark.parametrize(
    "stages",
    [
        ('op = "average"\nsize = 3', 'op = "otsu"', 'op = "fill_holes"', 'op = "area_open"\npixels = 50'),
        ('op = "gaussian"', 'op = "sobel"', *CLOSED),
        ('op = "gaussian"\nsigma = 3', 'op = "equalise"', 'op = "prewitt"\nthreshold = 0.04', *CLOSED),
        ('op = "otsu"', 'op = "fill_holes"', 'op = "roberts"', *CLOSED),
        ('op = "homomorphic"', 'op = "otsu"', 'op = "area_open"\npixels = 50'),
        ('op = "zero_crossings"', 'op = "close_disk"\nradius = 2', 'op = "fill_holes"', 'op = "open_disk"\nradius = 4'),
        ('op = "frame_difference"\nthreshold = 20', 'op = "area_open"'),
    ],
)
def test_every_operator_is_reachable_from_a_recipe_file(stages: tuple[str, ...], tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(chain(*stages))
    image = paint([(at(outline_of(Shape.SQUARE, 60), 150, 120), (40.0, 40.0, 40.0))])
    empty = paint([], seed=1)
    found = detect(frame(image), load_recipe(str(path)), background=empty).detections
    assert any(np.hypot(d.center_px[0] - 150, d.center_px[1] - 120) < 3.0 for d in found)


def test_a_template_is_found_at_another_size(tmp_path: Path) -> None:
    import cv2

    small = paint([(at(outline_of(Shape.HEXAGON, 40.0), 100, 100), (40.0, 40.0, 40.0))])[70:130, 70:130]
    assert cv2.imwrite(str(tmp_path / "one.png"), small)
    path = tmp_path / "mine.toml"
    path.write_text(chain(f'op = "template_match"\ntemplate = "{tmp_path / "one.png"}"\nscales = [0.7, 1.0, 1.5]'))
    things = [
        (at(outline_of(Shape.HEXAGON, 60.0), 80, 110), (40.0, 40.0, 40.0)),
        (at(outline_of(Shape.SQUARE, 50.0), 230, 120), (40.0, 40.0, 40.0)),
    ]
    found = detect(frame(paint(things)), load_recipe(str(path))).detections
    assert any(np.hypot(d.center_px[0] - 80, d.center_px[1] - 110) < 4.0 for d in found)


def test_frame_difference_needs_the_empty_table(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(chain('op = "frame_difference"'))
    with pytest.raises(InputError, match="empty table"):
        detect(frame(paint([])), load_recipe(str(path)))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('name = "x"\nmethod = "precise"\n[precise]\nlevel = nan\n', "level"),
        ('name = "x"\nmethod = "precise"\n[precise]\nlevell = 4.0\n', "levell"),
        ('name = "x"\nmethod = "stages"\n', "stages"),
        (chain('op = "canny"\nlow = 0.5\nhigh = 0.2'), "low"),
        (chain('op = "cany"'), "cany"),
    ],
)
def test_a_wrong_recipe_names_its_key(text: str, named: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=named):
        load_recipe(str(path))


EVERY_NUMBER = (
    'name = "x"\nmethod = "precise"\n[precise]\nsmallest_px = 12.0\nlevel = 4.5\nminimum_contrast = 6.0\n'
    "square_aspect = 1.1\nvisible = 0.8\nmisfit_px = 0.1\nmisfit_share = 0.005",
    chain(
        'op = "unsharp_mask"\nradius = 1.0\namount = 0.8', 'op = "median"\nsize = 3', 'op = "average"\nsize = 3',
        'op = "gaussian"\nsigma = 1.0', 'op = "stretch"\nlow = 0.01\nhigh = 0.99',
        'op = "homomorphic"\nsigma_share = 0.15\nlow_gain = 0.4\nhigh_gain = 1.2',
        'op = "canny"\nsigma = 1.4\nlow = 0.1\nhigh = 0.2', 'op = "sobel"\nthreshold = 0.1',
        'op = "zero_crossings"\nsigma = 2.0\nthreshold = 0.1', 'op = "frame_difference"\nthreshold = 12.0\nblock = 5',
        'op = "template_match"\ntemplate = "a.png"\nscales = [0.5, 2.0]\nthreshold = 0.8',
        'op = "area_open"\npixels = 100', 'op = "open_disk"\nradius = 3',
    )
    + "[ranges]\nfour_sided_extent = 1.13\ncircle_extent = 1.303\ncircle_compactness = 1.05\n"
    "hexagon_extent = [1.303, 1.5]\nhexagon_compactness = [1.05, 1.19]\nsquare_difference = 0.1",
)  # fmt: skip


@pytest.mark.parametrize("recipe", EVERY_NUMBER, ids=["precise", "stages"])
def test_no_number_of_a_recipe_may_be_infinite_or_none(recipe: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(recipe)
    load_recipe(str(path))
    for number in re.finditer(r"(?m)^(\w+) = .*?(\b\d[\d.]*)|(?<=, )\d[\d.]*(?=\])", recipe):
        first, last = number.span(2) if number.group(2) else number.span()
        for bad in ("nan", "inf", "-inf"):
            path.write_text(recipe[:first] + bad + recipe[last:])
            with pytest.raises(ConfigError, match=number.group(1) or "hexagon|scales"):
                load_recipe(str(path))


def test_shipped_recipes_load() -> None:
    assert load_recipe("precise").method == "precise"
    assert isinstance(load_recipe("paper"), Recipe)

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from controller.config.cell import ColourName
from controller.config.loader import validate
from controller.domain import Frame
from controller.errors import ConfigError, InputError
from controller.vision.appearance import palette
from controller.vision.appearance.colour import Colour, measure
from controller.vision.appearance.oklab import oklab, oklab_of
from controller.vision.appearance.settings import Appearance
from controller.vision.appearance.tiles import tiles
from controller.vision.detect import detect
from controller.vision.read import read_image
from controller.vision.recipe import load_recipe
from tests.benchmarks import surfaces
from tests.benchmarks.colour import CARD_PX, lamps
from tests.benchmarks.surfaces import SQUARE, Floats, Thing, polygon
from tests.benchmarks.texture import detection_of

# Named colours of CSS that carry a name of the palette; none but the pure ones is a place of it.
CSS = {
    "red": "8b0000 b22222 dc143c", "orange": "ff8c00 ffa500", "yellow": "ffd700 f0e68c",
    "green": "008000 006400 2e8b57 228b22 9acd32", "cyan": "008b8b 00ced1 afeeee", "blue": "000080 4169e1 1e90ff",
    "purple": "800080 9400d3 4b0082 663399", "pink": "ffc0cb ff69b4 ff1493", "brown": "8b4513 a0522d",
    "black": "000000", "gray": "808080 a9a9a9 696969", "white": "f5f5f5",
}  # fmt: skip


def _seen(things: list[Thing], settings: Appearance, light: Floats | None = None) -> list[Colour]:
    size = (240, 160)
    picture = surfaces.paint(things, size, np.random.default_rng(1), light=light)
    found = [detection_of(thing, Frame(1, 0.0, picture)) for thing in things]
    return measure(picture, tiles(picture, found), settings)


def test_rules_may_ask_for_the_names_of_the_palette() -> None:
    assert get_args(ColourName) == palette.NAMES


@pytest.mark.parametrize("name", CSS)
def test_colours_of_the_web_have_their_names(name: str) -> None:
    for code in CSS[name].split():
        bgr = np.array(list(bytes.fromhex(code)[::-1]), np.uint8)
        assert palette.name_of(oklab_of(bgr))[0] == name, code


def test_red_is_one_colour_on_both_sides_of_hue_zero() -> None:
    orange_side, pink_side = np.array([24, 30, 190], np.uint8), np.array([44, 24, 190], np.uint8)
    assert palette.name_of(oklab_of(orange_side))[0] == palette.name_of(oklab_of(pink_side))[0] == "red"


def test_a_gray_card_makes_any_lamp_white() -> None:
    # 3 of the 50 lampfuls would be 1 %; none is wrong at this seed.
    right, count, mistaken, _ = lamps(3, Appearance(reference="patch", patch_px=CARD_PX), surfaces.TABLE)
    assert right >= 0.99 * count, mistaken


def test_a_gradient_is_divided_out_part_by_part() -> None:
    gray = (120, 120, 120)
    things = [Thing([SQUARE * 25.0], (gray, gray), x, 80.0, 0.3) for x in (50.0, 190.0)]
    light = surfaces.field((240, 160), 6500.0, 0.9, 0.6, 0.0)
    left, right = _seen(things, Appearance(reference="table"), light)
    # The dark side has 55 % of the bright side's light: uncorrected, L would differ by 0.12.
    assert abs(left.lab[0] - right.lab[0]) < 0.02


def test_glare_and_a_hole_do_not_count() -> None:
    def glare(x: Floats, y: Floats) -> Floats:
        return (np.hypot(x - 8, y - 8) < 7).astype(float)

    blue, white = (180, 80, 35), (255, 255, 255)
    drop = Thing([polygon(48, 25.0)], (blue, white), 60.0, 80.0, 0.0, glare)
    ring = Thing([polygon(48, 25.0), polygon(48, 11.0)], (blue, blue), 180.0, 80.0, 0.0)
    light = surfaces.field((240, 160), 6500.0, 1.3, 0.0, 0.0)
    for seen in _seen([drop, ring], Appearance(reference="table"), light):
        assert (seen.name, seen.second) == ("blue", None)


def test_two_colours_are_both_named() -> None:
    red, white = (40, 36, 190), (240, 240, 240)
    half = Thing([SQUARE * 25.0], (red, white), 120.0, 80.0, 0.4, lambda x, y: (x > 8).astype(float))
    (seen,) = _seen([half], Appearance())
    assert (seen.name, seen.second) == ("red", "white")


def test_shading_is_no_second_colour() -> None:
    red, dark = (40, 36, 190), (22, 20, 120)
    shaded = Thing([SQUARE * 25.0], (red, dark), 120.0, 80.0, 0.4, lambda x, y: (x > 0).astype(float))
    assert _seen([shaded], Appearance())[0].second is None


def test_a_card_that_cannot_be_measured_is_refused() -> None:
    thing = Thing([SQUARE * 25.0], ((0, 0, 200), (0, 0, 200)), 120.0, 80.0, 0.0)
    with pytest.raises(InputError, match="beyond the picture"):
        _seen([thing], Appearance(reference="patch", patch_px=(220, 0, 40, 40)))
    with pytest.raises(InputError, match="overexposed"):
        _seen([thing], Appearance(reference="patch", patch_px=(0, 0, 20, 20)), np.full((160, 240, 3), 4.0))
    with pytest.raises(ConfigError, match="patch_px is missing"):
        validate({"reference": "patch"}, Appearance, "recipe")


@pytest.mark.parametrize("name", ["sick_colour_dots/Testbild_good.jpg", "sick_colour_dots/Testbild_false1.jpg"])
def test_glossy_drops_are_named(shared: Path, name: str) -> None:
    path = shared / "data" / name
    entries = json.loads((path.parent / "annotations.json").read_text(encoding="utf-8"))["images"]
    wanted = next(entry for entry in entries if entry["file"] == path.name)["objects"]
    found = detect(Frame(1, 0.0, read_image(path)), load_recipe("precise")).detections
    for thing in wanted:
        # Drops seen from the side: a centre is good to a third of a drop.
        near = min(found, key=lambda item: math.dist(item.center_px, thing["centre_px"]))
        assert near.colour == thing["colour"]


def test_black_ends_where_a_sixteenth_of_the_light_comes_back() -> None:
    # Black plastic and card give back 4 to 6 %, dark gray paint from 8 % on.
    for share, name in ((0.04, "black"), (0.055, "black"), (0.08, "gray")):
        assert palette.name_of(oklab(np.full(3, share, np.float32)))[0] == name

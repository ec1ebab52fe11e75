"""Prints told by keypoints: the same one at any turn, place and size; another one, or none, is another."""

from __future__ import annotations

import numpy as np
import pytest

from controller.domain import Frame
from controller.errors import InputError
from controller.vision.appearance.look import look
from controller.vision.appearance.settings import Appearance
from controller.vision.classes.features import features
from controller.vision.classes.markings import best_likeness, marking, tiles_of
from controller.vision.classes.store import TaughtClass
from controller.vision.classes.taught import Taught, admit
from tests.benchmarks import surfaces
from tests.benchmarks.surfaces import SQUARE, Floats, Image, Pattern, Thing
from tests.benchmarks.texture import detection_of

BLUE, BLACK = (170, 90, 40), (30, 30, 30)


def _arrow(x: Floats, y: Floats) -> Floats:
    return (((np.abs(y) < 3) & (x > -16) & (x < 3)) | ((x >= 2) & (x + 1.1 * np.abs(y) < 16))).astype(float)


def _cross(x: Floats, y: Floats) -> Floats:
    return (((np.abs(x) < 4) | (np.abs(y) < 4)) & (np.maximum(np.abs(x), np.abs(y)) < 16)).astype(float)


def _picture(print_: Pattern, seed: int) -> tuple[Image, list[Thing]]:
    random = np.random.default_rng(seed)
    # A slanting view moves the print against the outline, here by up to 3 px.
    shift = random.uniform(-3, 3, 2)
    things = [
        Thing([SQUARE * 34.0], (BLUE, BLACK), 70.0 + 110.0 * k, 70.0, float(random.uniform(-3, 3)),
              lambda x, y: print_(x - shift[0], y - shift[1]))
        for k in range(4)
    ]  # fmt: skip
    return surfaces.paint(things, (480, 140), random, blur=0.8, noise=3.0), things


def _class(name: str, print_: Pattern, seed: int) -> TaughtClass:
    picture, things = _picture(print_, seed)
    found = [detection_of(thing, Frame(1, 0.0, picture)) for thing in things]
    values = features(found, look(picture, found, Appearance()), None)
    return TaughtClass(name, "px", values, tuple(f"{name}{k}" for k in range(len(found))), tiles_of(picture, found))


def test_the_same_print_is_found_at_any_turn_and_another_is_not() -> None:
    arrows, crosses = ([marking(tile) for tile in _class("x", p, s).prints] for p, s in ((_arrow, 1), (_cross, 2)))
    plain = [marking(tile) for tile in _class("x", surfaces.plain(), 3).prints]
    for one in arrows:
        own = best_likeness(one, [other for other in arrows if other is not one])
        # Laid over one another the same prints agree but for noise and sampling; others in outlines at best.
        assert own > 0.85
        assert own > best_likeness(one, crosses) + 0.08
        assert best_likeness(one, plain) < 0.3


def test_classes_that_differ_by_a_print_only_are_told_apart() -> None:
    arrow, cross = _class("arrow", _arrow, 1), _class("cross", _cross, 2)
    admitted = admit(cross, [arrow])
    taught = admitted.taught
    assert admitted.confusion == {"arrow": {"arrow": 4}, "cross": {"cross": 4}}
    for name, print_ in (("arrow", _arrow), ("cross", _cross)):
        picture, things = _picture(print_, 9)
        found = [detection_of(thing, Frame(1, 0.0, picture)) for thing in things]
        assert taught.names(found, look(picture, found, Appearance()), None) == [name] * 4


def test_the_same_print_under_another_name_is_refused() -> None:
    with pytest.raises(InputError, match="look like 'arrow'"):
        admit(_class("again", _arrow, 5), [_class("arrow", _arrow, 1)])
    assert Taught((_class("arrow", _arrow, 1),)).is_marked("arrow")
    assert not Taught((_class("blank", surfaces.plain(), 1),)).is_marked("blank")

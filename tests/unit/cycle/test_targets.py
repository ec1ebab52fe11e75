"""One part stays one target over its retries."""

from __future__ import annotations

import dataclasses

import numpy as np

from controller.cycle.targets import GONE_AFTER, STRAY_LOOKS, TargetBook
from controller.domain import Descriptors, Detection, Frame, LocatedObject, Shape

FRAME = Frame(1, 0.0, np.zeros((4, 4, 3), np.uint8))


def thing(x: float, y: float, shape: Shape = Shape.SQUARE, size: float = 40.0) -> LocatedObject:
    outline = np.zeros((4, 2))
    detection = Detection(
        FRAME, shape, 1.0, outline, (0.0, 0.0), (size, size), 0.0, 1.0, (0.0, 0.0, 1.0, 1.0), Descriptors(1, 1, 0)
    )
    return LocatedObject(detection, (x, y), 0.0, (size, size), 20.0, outline, 0.1, "c")


def test_a_nudged_part_keeps_its_target() -> None:
    book = TargetBook()
    target = book.choose(thing(0, 0), 1.0)
    target.attempts = 1
    named, gone = book.identify([thing(100, 0), thing(10, 5)])
    assert [item.target_id for item in named] == ["", target.target_id]
    assert gone == []
    assert book.choose(named[1], 9.0) is target
    assert target.located.center == (10.0, 5.0)
    assert target.started_at == 1.0


def test_what_lies_in_its_very_place_is_the_target_whatever_it_looks_like() -> None:
    book = TargetBook()
    book.choose(thing(0, 0), 1.0).attempts = 1
    named, gone = book.identify([thing(5, 5, Shape.OTHER, size=47.0)])
    assert named[0].target_id == "t1"
    assert gone == []


def test_another_shape_or_size_beside_its_place_is_not_the_target() -> None:
    for other in (thing(20, 0, Shape.CIRCLE), thing(20, 0, size=45.0)):
        book = TargetBook()
        book.choose(thing(0, 0), 1.0).attempts = 1
        named, gone = book.identify([other])
        assert named[0].target_id == ""
        assert [target.target_id for target in gone] == ["t1"]


def test_a_target_never_tried_is_not_missed_when_it_is_gone() -> None:
    book = TargetBook()
    book.choose(thing(0, 0), 1.0)
    assert book.identify([])[1] == []


def test_a_lost_part_is_found_again_only_where_nothing_lay_before() -> None:
    book = TargetBook()
    book.identify([thing(0, 0), thing(200, 0)])
    target = book.choose(thing(0, 0), 1.0)
    target.attempts, target.lost = 1, True
    named, gone = book.identify([thing(200, 0), thing(90, 90)])
    assert [item.target_id for item in named] == ["", "t1"]
    assert gone == []
    assert [target.lost for target in book.open] == [False]


def test_two_targets_never_share_an_object() -> None:
    book = TargetBook()
    for x in (0.0, 15.0):
        book.choose(thing(x, 0), 1.0).attempts = 1
    named, gone = book.identify([thing(7, 0)])
    assert len(gone) == 1
    assert sum(bool(item.target_id) for item in named) == 1


def test_a_closed_target_is_forgotten() -> None:
    book = TargetBook()
    target = book.choose(thing(0, 0), 1.0)
    book.close(target)
    assert book.open == ()
    again = book.choose(dataclasses.replace(thing(0, 0), target_id=target.target_id), 2.0)
    assert again.target_id == "t2"


def test_what_was_given_up_is_known_again_where_it_lies() -> None:
    book = TargetBook()
    book.give_up(book.choose(thing(0, 0), 1.0))
    assert book.is_given_up(thing(3, 3, Shape.OTHER))
    assert book.is_given_up(thing(20, 0))
    assert not book.is_given_up(thing(20, 0, Shape.CIRCLE))
    assert not book.is_given_up(thing(60, 0))


def test_what_was_given_up_is_new_again_when_it_was_gone_for_some_looks() -> None:
    book = TargetBook()
    old = thing(0, 0)
    book.identify([old])
    book.give_up(book.choose(old, 0.0))
    for _ in range(GONE_AFTER - 1):
        book.identify([])
    book.identify([old])  # a look that missed it is no proof that it was taken
    assert book.is_given_up(old)
    for _ in range(GONE_AFTER):
        book.identify([])
    assert not book.is_given_up(old)


def test_what_the_jaws_may_have_toppled_is_no_known_shape_any_more() -> None:
    book = TargetBook()
    book.choose(thing(0, 0), 1.0).attempts = 1
    for place in (8, 9, 24):  # pushed about by further attempts, it stays in doubt
        [seen], gone = book.identify([thing(place, 0, Shape.RECTANGLE)])
        assert (seen.target_id, seen.shape, seen.detection.label, gone) == ("t1", Shape.OTHER, "other", [])


def test_what_was_taken_for_something_else_where_it_lies_gets_its_name() -> None:
    book = TargetBook()
    book.choose(thing(0, 0), 1.0).attempts = 1
    [seen], _ = book.identify([thing(1, 1, Shape.RECTANGLE)])
    assert seen.shape is Shape.RECTANGLE


def test_what_turns_up_unlike_the_part_that_was_dropped_is_no_known_shape() -> None:
    book = TargetBook()
    book.identify([thing(0, 0), thing(200, 0, Shape.CIRCLE)])
    target = book.choose(thing(0, 0), 1.0)
    target.attempts, target.lost = 1, True
    _, gone = book.identify([thing(200, 0, Shape.CIRCLE)])
    book.close(gone[0])  # its outcome: dropped
    stray, old = thing(100, 50, Shape.RECTANGLE), thing(200, 0, Shape.CIRCLE)
    for _ in range(STRAY_LOOKS + 2):  # once in doubt, for good
        named, _ = book.identify([stray, old])
        assert [item.shape for item in named] == [Shape.OTHER, Shape.CIRCLE]
    named, _ = book.identify([stray, old, thing(-100, 50)])  # laid down by somebody later on
    assert [item.shape for item in named] == [Shape.OTHER, Shape.CIRCLE, Shape.SQUARE]


def test_what_was_pushed_far_is_not_taken_for_the_part_that_was_dropped() -> None:
    book = TargetBook()
    circle = thing(0, 0, Shape.CIRCLE)
    target = book.choose(thing(100, 0), 0.0)
    target.attempts, target.lost = 1, True
    book.identify([circle])
    book.pushed([thing(0, 30, Shape.CIRCLE)])
    named, _ = book.identify([thing(2, 33, Shape.CIRCLE), thing(5, 60, Shape.RECTANGLE)])
    assert [item.shape for item in named] == [Shape.CIRCLE, Shape.OTHER]

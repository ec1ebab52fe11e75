"""What a look has overlooked is in the way for as long as the picture shows it."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from controller.cycle.machine import State
from controller.cycle.memory import Memory
from controller.domain import Frame, LocatedObject, Result
from tests.unit.cycle.bench import Bench, part


def frame(index: int, *, there: bool) -> Frame:
    """A grey table, with a part in its middle or without; 1 px is 1 mm."""
    image = np.full((200, 200, 3), 170, np.uint8)
    if there:
        cv2.rectangle(image, (80, 80), (120, 120), (60, 110, 160), -1)
    return Frame(index, float(index), image)


def seen_in(first: Frame) -> LocatedObject:
    """The part as located in a frame."""
    thing = part(100.0, 100.0)
    detection = dataclasses.replace(thing.detection, frame=first, outline_px=thing.footprint)
    return dataclasses.replace(thing, detection=detection)


@pytest.mark.parametrize(
    ("there", "others", "remembered"),
    [
        (True, (), True),
        (False, (), False),
        (True, (part(142.0, 100.0),), True),  # a neighbour is no answer
        (True, (part(110.0, 104.0),), False),  # it was found again, a little further
    ],
)
def test_a_part_is_remembered_while_the_picture_shows_it(
    there: bool, others: tuple[LocatedObject, ...], remembered: bool
) -> None:
    memory = Memory()
    first = frame(1, there=True)
    assert memory.look([seen_in(first)], first) == ()
    for index in (2, 3, 4, 5, 6):
        found = memory.look(others, frame(index, there=there))
        assert [thing.center for thing in found] == [(100.0, 100.0)] * remembered
    memory.forget()
    assert memory.look(others, frame(7, there=there)) == ()


@pytest.mark.safety("SR-34")
def test_jaws_keep_clear_of_what_a_look_has_overlooked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its neighbours stay unseen until the end: only another look, without them, lets the part be taken."""
    places = ((43.0, 90.0), (-43.0, 90.0), (0.0, 133.0), (0.0, 47.0))
    around = [part(x, y, score=0.0) for x, y in places]  # none to be picked itself
    bench = Bench(monkeypatch, part(0.0, 90.0), *around)
    monkeypatch.setattr("controller.cycle.memory.still_shows", lambda *_: True)
    locate = bench.locate

    def blind(*_: object) -> object:
        found = locate()
        bench.table = bench.table[:1]
        return found

    monkeypatch.setattr("controller.cycle.looking.locate", blind)
    bench.run()
    before = bench.ledger.lines[: bench.ledger.lines.index(("intend", "t1/1"))]
    assert before.count(("note", "nudge")) > 1  # the first push has not brought the others to light
    assert bench.results == [Result.PLACED]
    assert bench.states[-1] is State.STOPPED

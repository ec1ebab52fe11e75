"""What still lies where a part was taken from is not what the jaws hold."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.cycle.looking import Looker
from controller.cycle.source import still_shows
from controller.domain import Frame, Result, Shape
from tests.unit.cycle.bench import Bench, part

SPOT = np.array([[600.0, 300.0], [660.0, 300.0], [660.0, 360.0], [600.0, 360.0]])


def picture(*, there: bool, light: float = 1.0, colour: tuple[int, int, int] = (60, 110, 160)) -> NDArray[np.uint8]:
    """A grey table, with a part at `SPOT`."""
    image = np.full((720, 1280, 3), 170, np.uint8)
    if there:
        cv2.fillPoly(image, [SPOT.astype(np.int32)], colour)
    noise = np.random.default_rng(0).normal(0.0, 6.0, image.shape)
    return np.clip(light * image + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("there", "light", "colour", "told"),
    [
        (True, 1.0, (60, 110, 160), True),
        (True, 0.95, (60, 110, 160), True),  # the arm's shadow comes near
        (False, 1.0, (60, 110, 160), False),
        (True, 1.0, (160, 60, 60), False),  # somebody has laid another one down
    ],
)
def test_a_part_that_lies_there_still_is_seen(
    there: bool, light: float, colour: tuple[int, int, int], told: bool
) -> None:
    before = Frame(1, 0.0, picture(there=True))
    taken = dataclasses.replace(part(0.0, 0.0).detection, frame=before, outline_px=SPOT)
    assert still_shows(taken, Frame(2, 1.0, picture(there=there, light=light, colour=colour))) == told


def test_a_part_as_bright_as_the_table_is_not_judged() -> None:
    faint = (165, 168, 170)
    before = Frame(1, 0.0, picture(there=True, colour=faint))
    taken = dataclasses.replace(part(0.0, 0.0).detection, frame=before, outline_px=SPOT)
    assert not still_shows(taken, Frame(2, 1.0, picture(there=True, colour=faint)))


def test_what_is_not_what_was_to_be_taken_goes_to_the_rejects(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0.0, 0.0), part(0.0, 70.0, Shape.CIRCLE))
    monkeypatch.setattr(Looker, "shows_still", lambda looker, taken: taken.shape is Shape.SQUARE)
    bench.run()
    ends = {outcome.target.shape: (outcome.result, outcome.plan.bin.name) for outcome in bench.outcomes if outcome.plan}
    assert ends[Shape.SQUARE] == (Result.REJECTED, "rejects")
    assert ends[Shape.CIRCLE] == (Result.PLACED, "circles")
    assert bench.commands.count("carry") == 3


def test_without_a_bin_for_rejects_somebody_takes_it_out_of_the_jaws(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0.0, 0.0))
    bench.change("sorting", otherwise="leave")
    monkeypatch.setattr(Looker, "shows_still", lambda looker, taken: True)
    sorter = bench.run()
    assert sorter.fault is not None
    assert "something else" in str(bench.held_for[0])
    assert bench.commands.count("carry") == 1

"""Disturbances: what a wish means, and what a person does to the parts while the camera sees the hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from controller.config.arm import load_arm
from controller.errors import ConfigError
from sim_backends.cell import SimulatedCell
from sim_backends.cell_spec import CellSpec
from sim_backends.disturbances import KINDS, Disturbance, disturbances


def cell(disturb: str, parts: int = 5) -> SimulatedCell:
    spec = CellSpec(arm=load_arm("reactorx_150"), parts=parts, seed=5, level="ideal", disturb=disturb)
    return SimulatedCell(spec)


def work(made: SimulatedCell, seconds: float, state: str = "PICK") -> None:
    assert made.disturber is not None
    made.disturber.entered(state)
    made.world.advance(seconds)


def test_a_wish_is_read() -> None:
    assert disturbances("slip@PLACE:3, add@12.5", 0, 8) == (
        Disturbance("slip", None, "PLACE", 3),
        Disturbance("add", 12.5),
    )
    assert {event.kind for event in disturbances("all", 7, 8)} == set(KINDS)
    assert disturbances("all", 7, 8) == disturbances("all", 7, 8)
    assert disturbances("all", 7, 8) != disturbances("all", 8, 8)
    assert disturbances("", 7, 8) == ()


@pytest.mark.parametrize("wish", ["earthquake", "swap@NOWHERE", "swap@", "add@-1"])
def test_what_is_no_wish_is_refused(wish: str) -> None:
    with pytest.raises(ConfigError):
        disturbances(wish, 0, 8)


def test_a_part_is_taken_away_under_a_hand_that_the_camera_sees() -> None:
    made = cell("remove@0.5")
    made.camera.open()
    before = made.camera.capture(0.0).image
    work(made, 1.0)
    during = made.camera.capture(made.clock.now()).image
    made.world.advance(2.0)
    after = made.camera.capture(made.clock.now()).image
    places = [part.place for part in made.truth()]
    assert sorted(places) == ["away", "table", "table", "table", "table"]
    # The hand covers a twentieth of the picture and more; afterwards only the part is missing.
    assert _changed(before, during) > 0.03
    assert 0.0 < _changed(before, after) < 0.02


def _changed(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Share of the pixels that differ by more than noise."""
    return float((np.abs(a.astype(int) - b.astype(int)).max(axis=2) > 30).mean())


def test_a_spare_part_is_added_where_there_is_room() -> None:
    made = cell("add@0.1")
    assert [part.place for part in made.truth()].count("away") == 1
    work(made, 3.0)
    assert [part.place for part in made.truth()] == ["table"] * 6
    assert all(part.upright for part in made.truth())


def test_two_parts_change_places() -> None:
    made = cell("swap@0.1")
    before = {part.part_id: np.array(part.center) for part in made.truth()}
    work(made, 4.0)
    after = {part.part_id: np.array(part.center) for part in made.truth()}
    gone = [i for i in before if np.linalg.norm(after[i] - before[i]) > 10.0]
    assert len(gone) == 2
    first, second = gone
    # They are laid down within a millimetre: physics lets them settle.
    assert np.linalg.norm(after[first] - before[second]) < 1.0
    assert abs(made.world.parts[first].grip - made.world.parts[second].grip) > 2.0


def test_a_knocked_part_slides() -> None:
    made = cell("knock@0.1")
    before = np.array([part.center for part in made.truth()])
    work(made, 1.0)
    after = np.array([part.center for part in made.truth()])
    assert np.linalg.norm(after - before, axis=1).max() > 2.0


def test_the_same_seed_disturbs_in_the_same_way() -> None:
    ends = []
    for _ in range(2):
        made = cell("all")
        for _ in range(3):
            work(made, 1.0)
        assert made.disturber is not None
        ends.append((made.truth(), made.disturber.happened))
    assert ends[0] == ends[1]

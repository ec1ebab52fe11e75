"""The clock of a simulated world."""

from __future__ import annotations

import pytest

from controller.ports import Clock
from sim_backends.clock import SimClock
from tests.unit.sim_backends.rig import world


def test_waiting_and_computing_let_the_world_move_on() -> None:
    plant = world()
    clock = SimClock(plant)
    assert isinstance(clock, Clock)
    clock.sleep(0.5)
    clock.charge(0.05)
    assert clock.now() == plant.now() == pytest.approx(0.55)


def test_no_wait_ever_turns_time_back() -> None:
    clock = SimClock(world())
    clock.sleep(0.1)
    before = clock.now()
    clock.sleep(-1.0)
    clock.sleep(0.0)
    assert clock.now() == before

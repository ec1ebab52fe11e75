"""What a run claims, against the world's truth."""

from __future__ import annotations

from collections.abc import Sequence
from unittest.mock import Mock

import pytest

from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.domain import Outcome, Result, Shape, TruePart
from controller.insight.statistics import Statistics
from tests.unit.cycle.bench import part


class World:
    """Two squares on the table, and where they lie in the end."""

    def __init__(self) -> None:
        self.places = ["table", "table"]

    def at(self, at: float) -> Sequence[TruePart]:
        return self.now()

    def now(self) -> Sequence[TruePart]:
        return [
            TruePart(i, Shape.SQUARE, "red", (0.0, 90.0 * i), 0.0, (40.0, 40.0), 20.0, True, place, True, "")
            for i, place in enumerate(self.places)
        ]

    def tool(self) -> tuple[float, float, float]:
        return 0.0, 0.0, 0.0

    def collisions(self) -> int:
        return 0


def placed(y: float) -> Outcome:
    plan = Mock()
    plan.bin.name = "squares"
    return Outcome(part(0.0, y), plan, Result.PLACED, "in squares", 1, 0.0, 1.0)


@pytest.mark.parametrize(
    ("second", "verdict"),
    [("table", {"correct": 1, "silent": 1, "missorted": 0, "left": 1}),
     ("squares", {"correct": 2, "silent": 0, "missorted": 0, "left": 0})],
    ids=["nothing was placed", "another was placed"],
)  # fmt: skip
def test_a_part_placed_twice_was_not_placed_the_first_time(second: str, verdict: dict[str, int]) -> None:
    world = World()
    statistics = Statistics(load_cell(shipped("sim.toml")), world)
    statistics.concluded(placed(0.0))
    statistics.concluded(placed(0.0))
    world.places = ["squares", second]
    figures = statistics.summary(1, [3.0])
    assert {key: figures[key] for key in verdict} == verdict


def test_a_part_in_another_bin_than_its_own_is_missorted() -> None:
    world = World()
    statistics = Statistics(load_cell(shipped("sim.toml")), world)
    statistics.concluded(placed(0.0))
    world.places = ["circles", "table"]
    figures = statistics.summary(1, [3.0])
    assert (figures["correct"], figures["missorted"], figures["left"]) == (0, 1, 1)

"""Two evaluations beside each other."""

from __future__ import annotations

from typing import Any

import pytest

from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.insight import evaluation_report
from controller.insight.comparison import BEYOND_CHANCE, Difference, Evaluation, differences, settings
from controller.insight.evaluation import summary
from tests.unit.insight.test_evaluation import record

HEAD = {"level": "static", "arm": "a", "parts_per_table": 1, "seeds": "0-9"}
RIGHT = "in the right bin, of reachable"


def evaluation(records: list[dict[str, Any]], speed: int = 100, **head: object) -> Evaluation:
    configuration = {"arm": {"speed_percent": speed}, "bins": [{"name": "squares"}]}
    return Evaluation(summary({**HEAD, **head}, records), configuration, records)


def found(now: Evaluation, before: Evaluation) -> dict[str, Difference]:
    return {difference.name: difference for difference in differences(now, before)}


def test_an_evaluation_does_not_differ_from_itself() -> None:
    same = evaluation([record(seed) for seed in range(10)])
    assert settings(same, same) == []
    for difference in differences(same, same):
        assert difference.chance is None
        assert difference.now == pytest.approx(difference.before)


def test_settings_are_told_key_by_key() -> None:
    before, now = evaluation([record(1)], arm="a"), evaluation([record(1)], 50, arm="b")
    assert settings(now, before) == [("arm", "a", "b"), ("arm.speed_percent", "100", "50")]
    # An evaluation that kept no configuration is compared by what it kept.
    old = Evaluation(before.figures, {}, before.records)
    assert settings(now, old) == [("arm", "a", "b")]


@pytest.mark.parametrize("seeds", [range(10), range(50, 60)], ids=["the same tables", "other tables"])
def test_one_part_may_be_chance_and_ten_are_not(seeds: range) -> None:
    before = evaluation([record(seed) for seed in range(10)])
    once = evaluation([record(seed, correct=int(seed % 10 != 0)) for seed in seeds])
    always = evaluation([record(seed, correct=0) for seed in seeds])
    difference = found(once, before)[RIGHT]
    assert difference.before == 100.0
    assert difference.now == pytest.approx(90.0)
    assert difference.chance is not None
    # Whichever of the two tables is exchanged, it differs as much.
    assert difference.chance == pytest.approx(1.0)
    clear = found(always, before)[RIGHT]
    assert clear.chance is not None
    assert clear.chance < BEYOND_CHANCE
    assert clear.row() == (RIGHT, "100 %", "0 %", "-100 %", f"yes (p = {clear.chance:.2g})")


def test_ten_pairs_that_differ_alike_do_so_by_chance_in_two_of_1024() -> None:
    before, now = (evaluation([record(seed, correct=right) for seed in range(10)]) for right in (1, 0))
    assert found(now, before)[RIGHT].chance == pytest.approx(2 / 1024)


def test_what_cannot_be_compared_is_left_open() -> None:
    empty = Evaluation(summary(HEAD, []), {}, [])
    for difference in differences(evaluation([record(1)]), empty):
        assert difference.before is None
        assert difference.chance is None
        assert difference.row()[3:] == ("-", "-")


def test_the_page_names_what_it_is_compared_with_and_what_was_set_otherwise() -> None:
    before, now = evaluation([record(1)], seeds="1-1"), evaluation([record(1)], 50, seeds="1-1", level="ideal")
    page = evaluation_report.page(now, load_cell(shipped("sim.toml")), before, "first/evaluation.json")
    assert "Compared with first/evaluation.json" in page
    assert "controller evaluate --sim --seeds 1-1 --parts 1 --level static" in page
    assert "<tr><td>arm.speed_percent</td><td>100</td><td>50</td></tr>" in page
    assert "<th>beyond chance</th>" in page

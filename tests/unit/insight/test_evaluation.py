"""Runs put together: rates and their bounds, cycles, sums, comparison."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.insight import evaluation_report
from controller.insight.comparison import Evaluation
from controller.insight.evaluation import bounds, breakdown, cycles_of, median_cycle, summary

STATES = ["HOMING", "CAPTURE", "DETECT", "PICK", "PLACE", "CAPTURE", "DETECT", "PICK", "CAPTURE", "IDLE", "STOPPED"]


def spans(states: list[str], step: float = 1.0) -> list[dict[str, Any]]:
    return [
        {"lane": "state", "name": name, "begin": index * step, "end": (index + 1) * step}
        for index, name in enumerate(states)
    ]


def record(seed: int, **figures: int) -> dict[str, Any]:
    """A run of one square that went into its bin."""
    every = {"parts": 1, "reachable": 1, "sorted": 1, "correct": 1, "attempts": 1, "first_try": 1, "sim_s": 8.0}
    look = {"look": 1, "part": 0, "true": "square", "seen": "square", "x": 0.0, "y": 0.0, "dx": 0.3, "dy": -0.4}
    outcome = {"result": "placed", "verdict": "correct", "true": "square", "seen": "square", "bin": "squares"}
    return {
        "seed": seed,
        "cpu_s": 2.0,
        "figures": {**every, "wall_s": 2.0, **figures},
        "seen": [{**look, "angle_deg": 0.5, "size_mm": 0.1}],
        "missed": [],
        "false": 0,
        "refused": [],
        "outcomes": [outcome],
        "spans": spans(STATES[:6]),
        "failures": [],
    }


def test_bounds_are_those_of_the_literature() -> None:
    """Source: Brown, Cai, DasGupta (2001), Interval estimation for a binomial proportion, the Wilson interval."""
    assert bounds(0, 100) == {"value": 0.0, "low": 0.0, "high": pytest.approx(0.03699, abs=1e-5)}
    assert bounds(10, 10) == {"value": 1.0, "low": pytest.approx(0.72247, abs=1e-5), "high": 1.0}
    assert bounds(0, 0) == {"value": None, "low": None, "high": None}


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_a_rate_lies_between_its_bounds_and_more_trials_narrow_them(case: tuple[int, int]) -> None:
    hits, trials = case
    widths = []
    for found in (bounds(hits, trials), bounds(hits * 100, trials * 100)):
        value, low, high = found["value"], found["low"], found["high"]
        assert value is not None
        assert low is not None
        assert high is not None
        # Figures are rounded to 1e-5.
        assert 0.0 <= low <= value + 1e-5
        assert value - 1e-5 <= high <= 1.0
        widths.append(high - low)
    assert widths[0] > widths[1]


def test_only_what_took_a_part_to_a_bin_is_a_cycle() -> None:
    assert cycles_of(spans(STATES)) == [(1.0, 5.0)]
    assert cycles_of(spans(["CAPTURE", "PICK", "PLACE", "IDLE", "CAPTURE"])) == [(0.0, 3.0)]
    assert cycles_of(spans(["CAPTURE", "PICK", "FAULT"])) == []


def test_the_breakdown_of_a_cycle_adds_up_to_it() -> None:
    assert sum(breakdown([spans(STATES, 0.5), spans(STATES, 1.5)])["state"].values()) == pytest.approx(4.0)


def test_the_median_cycle_is_one_that_was() -> None:
    runs = [{"seed": seed, "spans": spans(STATES, step)} for seed, step in ((1, 2.0), (2, 1.0), (3, 9.0))]
    found = median_cycle(runs)
    assert found is not None
    seed, cycle = found
    assert seed == 1
    assert (cycle[0]["begin"], cycle[-1]["end"]) == (0.0, 8.0)


def test_a_run_that_broke_off_is_told_and_does_not_hide_the_others() -> None:
    figures = summary(
        {"level": "static"}, [record(1), {"seed": 2, "error": "no camera"}, record(3, correct=0, silent=1)]
    )
    assert figures["runs"] == 3
    assert figures["broken_runs"] == [{"seed": 2, "error": "no camera"}]
    assert (figures["parts"], figures["correct"], figures["silent"]) == (2, 1, 1)
    assert figures["rates"]["silent of sorted"]["value"] == 0.5
    assert figures["localization_error_mm"]["max"] == 0.5
    assert figures["times_real_time"] == 4.0


def test_the_page_shows_every_failure_with_the_command_that_repeats_it() -> None:
    head = {"arm": "reactorx_150", "level": "static", "parts_per_table": 1, "seeds": "7-7", "config": None}
    bad = record(7, correct=0, missorted=1)
    bad["failures"] = [{"kind": "missorted", "text": "a <square> in circles", "at_s": 3.0, "before": "QUJD"}]
    records = [bad]
    page = evaluation_report.page(Evaluation(summary(head, records), {}, records), load_cell(shipped("sim.toml")))
    assert "a &lt;square&gt; in circles" in page
    assert "controller run --sim --seed 7 --parts 1 --level static" in page
    assert "data:image/jpeg;base64,QUJD" in page
    assert "http" not in page


@pytest.mark.parametrize(
    ("more", "again", "one"),
    [
        ({}, "controller evaluate --sim --seeds 3-4", "controller run --sim --seed 4"),
        ({"seeds": "3 5 8"}, "controller evaluate --sim --seeds 3-8", "controller run --sim --seed 4"),
        (
            {"pick_proof": False, "disturb": "slip, knock", "config": "my cell.toml"},
            "controller evaluate --sim --seeds 3-4 --config 'my cell.toml' --disturb 'slip, knock' --no-pick-proof",
            # `controller run` always proves its grasps.
            "controller evaluate --sim --seeds 4 --config 'my cell.toml' --disturb 'slip, knock' --no-pick-proof",
        ),
    ],
)
def test_what_the_page_says_to_type_is_the_same_evaluation(more: dict[str, Any], again: str, one: str) -> None:
    figures = {"arm": "a", "level": "static", "parts_per_table": 2, "seeds": "3-4", **more}
    shared = " --parts 2 --level static"

    def plain(command: str) -> str:
        assert shared in command
        return command.replace(shared, "")

    assert plain(evaluation_report.command(figures)) == again
    assert plain(evaluation_report.replay(figures, 4)) == one

"""Runs put together: rates and their bounds, cycles, sums, comparison."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.insight import evaluation_report
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


def test_a_comparison_shows_what_differs() -> None:
    head = {"level": "static", "arm": "a"}
    before, now = summary(head, [record(1)]), summary({**head, "arm": "b"}, [record(1, correct=0, missorted=1)])
    assert evaluation_report.comparison(before, before) == []
    changed = {name: (old, new) for name, old, new in evaluation_report.comparison(now, before)}
    assert changed["arm"] == ("a", "b")
    assert changed["in a wrong bin, by the world's truth"] == ("0", "1")
    assert "missorted of sorted" in changed


def test_the_page_shows_every_failure_with_the_command_that_repeats_it() -> None:
    head = {"arm": "reactorx_150", "level": "static", "parts_per_table": 1, "seeds": "7-7", "config": None}
    bad = record(7, correct=0, missorted=1)
    bad["failures"] = [{"kind": "missorted", "text": "a <square> in circles", "at_s": 3.0, "before": "QUJD"}]
    records = [bad]
    page = evaluation_report.page(summary(head, records), records, load_cell(shipped("sim.toml")))
    assert "a &lt;square&gt; in circles" in page
    assert "controller run --sim --level static --parts 1 --seed 7" in page
    assert "data:image/jpeg;base64,QUJD" in page
    assert "http" not in page

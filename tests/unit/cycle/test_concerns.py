"""What is not in order and no reason to hold: told once, and over once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from controller.backends import nominal_camera
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.cycle.concerns import SLOW
from controller.cycle.view import region_mask, still_mask
from controller.domain import CellCalibration, PickPlan, Result, Shape, Trajectory
from tests.unit.cycle.bench import Bench, part

SIZE = (1280, 720)


def test_what_the_devices_say_is_told_when_it_begins_and_when_it_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, -60), part(0, 60))
    bench.concerns = {"bus_noisy": "2 %"}

    def calm(now: float) -> None:
        if bench.outcomes:
            bench.concerns = {}

    bench.on_sleep = calm
    bench.run()
    assert bench.results == [Result.PLACED] * 2
    assert bench.warnings == ["bus_noisy: 2 %", "bus_noisy is over"]


def test_a_full_bin_is_told_when_something_waits_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, -60), part(0, 60))
    bench.filled["squares"] = bench.config.bins[0].capacity - 1
    bench.run()
    assert bench.results == [Result.PLACED]
    assert bench.warnings == ["bin_full: squares is full, 1 part waits"]


def test_every_bin_that_gets_full_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(
        monkeypatch, *(part(20 * (i % 2), -120 + 40 * i, [Shape.SQUARE, Shape.CIRCLE][i % 2]) for i in range(6))
    )
    one = tuple(bin_.model_copy(update={"capacity": 1}) for bin_ in bench.config.bins)
    bench.config = bench.config.model_copy(update={"bins": one})
    bench.run()
    assert len(bench.outcomes) == 2
    first, both = bench.warnings
    assert first.endswith("is full, 2 parts wait")
    assert "squares is full, 2 parts wait" in both
    assert "circles is full, 2 parts wait" in both


def test_an_arm_with_a_weak_supply_moves_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    durations: dict[bool, float] = {}
    for weak in (False, True):
        bench = Bench(monkeypatch, part(0, 0))
        state = bench.arm.state

        def read(state=state, weak=weak):  # type: ignore[no-untyped-def]
            return replace(state(), voltage=10.2 if weak else 12.0)

        monkeypatch.setattr(bench.arm, "state", read)
        bench.run()
        durations[weak] = sum(move.duration for outcome in bench.outcomes for move in _moves(outcome.plan))
        assert bench.warnings == (["supply_low: 10.2 V at the servos"] if weak else [])
    # Halved speeds double the time of what is bounded by speed, not of what is bounded by acceleration.
    assert durations[True] > 1.3 * durations[False]
    assert SLOW < 1.0


def _moves(plan: PickPlan | None) -> Sequence[Trajectory]:
    assert plan is not None
    return plan.trajectories


def test_the_still_scenery_leaves_out_the_work_area_and_the_inside_of_the_bins() -> None:
    config = load_cell(shipped("sim.toml"))
    camera, T_table_camera = nominal_camera(config)
    calibration = CellCalibration("nominal", camera, T_table_camera, config.table.T_base_table())
    still = still_mask(config, calibration, SIZE)
    assert still[region_mask(config, calibration, SIZE) > 0].mean() < 0.05 * 255  # but for the bins that stand in it
    pixels = calibration.plane(0.0).to_pixels([bin_.center for bin_ in config.bin_values()])
    for u, v in np.rint(pixels).astype(int):
        assert not (0 <= u < SIZE[0] and 0 <= v < SIZE[1]) or still[v, u] == 0
    assert 0.2 < (still > 0).mean() < 0.9

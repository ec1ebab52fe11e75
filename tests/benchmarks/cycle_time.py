"""Prints where the time of a cycle goes, and whether seeing and planning keep the budgets that simulation charges.

Run: python -m tests.benchmarks.cycle_time [--cells 5] [--parts 10] [--level dynamic] [--first-seed 5000]

Seeing is detection and localisation of one picture, planning one `plan_pick` for each part of it, both in processor
time of one thread, which other programs do not spoil. The cycle is sorted in simulation, where each is charged its
budget instead.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from time import process_time

import cv2
import numpy as np

from controller.backends import Level
from controller.cli.evaluate_sim import Job, sort_one
from controller.config.arm import load_arm
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.cycle.view import region_mask
from controller.errors import PlanError
from controller.insight.evaluation import breakdown, cycle_durations
from controller.localization.locate import locate
from controller.motion.planner import Planner
from controller.vision.detect import detect
from controller.vision.recipe import load_recipe
from tests.benchmarks.cell_vision import Seen, look_at_cell

REPEATS = 5


def seeing_times(seen: Seen, config: CellConfig, stages: defaultdict[str, float]) -> list[float]:
    """Times of detection and localisation of one picture, s; the first, which warms caches, aside.

    Args:
        seen: The picture.
        config: Of the cell.
        stages: Has the time of every stage added, s.
    """
    recipe = load_recipe(config.vision.recipe)
    region = region_mask(config, seen.calibration, seen.frame.size)
    times = []
    for _ in range(REPEATS + 1):
        began = process_time()
        detected = detect(seen.frame, recipe, plane=seen.calibration.plane(12.0), region=region)
        found = process_time()
        locate(detected.detections, seen.calibration, config.part_height)
        times.append(process_time() - began)
        stages["locate"] += process_time() - found
        whole = sum(detected.timing_ms.values()) - detected.timing_ms["total"]
        for stage, time_ms in detected.timing_ms.items():
            if stage != "total":
                stages[stage] += (found - began) * time_ms / whole
    return times[1:]


def planning_times(seen: Seen, config: CellConfig) -> list[float]:
    """Time of one plan for each located part, s, from the ready pose."""
    arm = load_arm(config.arm.description)
    planner = Planner(arm, seen.calibration, config.bin_values())
    bins = config.bin_values()
    things = seen.located.objects
    times = []
    for index, thing in enumerate(things):
        bin_ = bins[index % len(bins)]
        began = process_time()
        others = [other for other in things if other is not thing]
        with suppress(PlanError):  # to find that there is no way takes its time, too
            planner.plan_pick(thing, others, bin_, bin_.center, np.array(arm.ready))
        times.append(process_time() - began)
    return times


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=5)
    parser.add_argument("--parts", type=int, default=10)
    parser.add_argument("--level", type=Level, default=Level.DYNAMIC)
    parser.add_argument("--first-seed", type=int, default=5000)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    config = load_cell(shipped("sim.toml"))
    seeing: list[float] = []
    planning: list[float] = []
    stages: defaultdict[str, float] = defaultdict(float)
    runs = []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.cells):
        with tempfile.TemporaryDirectory() as folder:
            seen = look_at_cell(seed, arguments.parts, str(arguments.level), Path(folder))
        seeing += seeing_times(seen, config, stages)
        planning += planning_times(seen, config)
        runs.append(sort_one(Job(config, arguments.parts, seed, arguments.level)).get("spans", []))
    print(f"{arguments.cells} cells of {arguments.parts} parts, level {arguments.level}")
    for name, times, budget in (
        ("seeing", seeing, config.cycle.vision_budget_s),
        ("planning", planning, config.cycle.planning_budget_s),
    ):
        ms, limit = 1e3 * np.array(times), 1e3 * budget
        over = 100.0 * float((ms > limit).mean())
        print(
            f"{name:9s} median {np.median(ms):6.1f} ms  p95 {np.percentile(ms, 95):6.1f}  max {ms.max():6.1f}  "
            f"budget {limit:.0f} ms, exceeded by {over:.0f} % of {len(ms)}"
        )
    whole = sum(stages.values())
    ordered = sorted(stages.items(), key=lambda item: -item[1])
    print("seeing is " + ", ".join(f"{stage} {100 * time / whole:.0f} %" for stage, time in ordered))
    durations = [duration for spans in runs for duration in cycle_durations(spans)]
    if durations:
        print(f"cycle     median {np.median(durations):6.3f} s   p95 {np.percentile(durations, 95):6.3f}")
    for lane, parts in breakdown(runs).items():
        shares = ", ".join(f"{name} {time:.3f}" for name, time in parts.items())
        print(f"  {lane:9s} {shares}  (mean s of a cycle)")


if __name__ == "__main__":
    main()

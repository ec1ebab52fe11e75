"""Prints where the time of a cycle goes, and whether seeing and planning keep the budgets that simulation charges.

Run: python -m tests.benchmarks.cycle_time [--cells 5] [--parts 10] [--level dynamic] [--first-seed 5000]

Seeing is detection and localisation of one picture, planning one `plan_pick` for each part of it, pushing one
`plan_nudge` for each part without a free grasp of a crowded cell, and of one whose arm has no wrist roll; all in
processor time of one thread, which other programs hardly spoil. The cycle is sorted in simulation, where each is
charged its budget instead. Its bound is what its own moves would take if they were time-optimal on their paths (no
limit of jerk, no settling), plus the times the jaws take. Exit code 1 when a target is missed.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Any
from unittest import mock

import cv2
import numpy as np

from controller.backends import Level
from controller.cli import keep_memory
from controller.cli.evaluate_sim import Job, sort_one
from controller.config.arm import load_arm
from controller.config.cell import CellConfig, load_cell
from controller.config.files import shipped
from controller.cycle.motions import Motions
from controller.domain import ArmDescription, MoveReport, Trajectory
from controller.errors import NoClearGrasp, PlanError
from controller.insight.evaluation import breakdown, cycles_of, within
from controller.localization.locate import locate
from controller.motion import moves
from controller.motion.path import Path as Way
from controller.motion.path import speed_limits
from controller.motion.planner import Planner
from controller.motion.trajectory import acceleration_limits, fastest, generate
from controller.vision.detect import detect
from controller.vision.recipe import load_recipe
from tests.benchmarks.cell_vision import Seen, look_at_cell

REPEATS = 5
PUSHED = (("sim.toml", 20), ("cells/open_manipulator_x.toml", 10))
"""Cells in which pushes are looked for, and how many parts lie in each."""
CYCLE, RATIO, WAITS, OVER = 3.4, 1.2, 0.1, 0.05
"""Targets: median cycle, s; over its bound; what charged budgets add to it, s; share of times that may exceed one."""


@dataclass(slots=True)
class Bounds:
    """Notes how long every move that is carried out would take at least, s, in their order."""

    moves: list[float] = field(default_factory=list)
    _known: dict[int, tuple[Trajectory, float]] = field(default_factory=dict)

    @contextmanager
    def noting(self) -> Iterator[None]:
        """While it lasts."""
        follow = Motions.follow

        def generated(arm: ArmDescription, path: Way, name: str, **how: Any) -> Trajectory:
            made = generate(arm, path, name, **how)
            least = float(fastest(path, speed_limits(arm), acceleration_limits(arm)).times[-1])
            self._known[id(made.positions)] = made, least
            return made

        def followed(motions: Motions, trajectory: Trajectory, *how: Any) -> MoveReport:
            self.moves.append(self._known[id(trajectory.positions)][1])
            return follow(motions, trajectory, *how)

        with mock.patch.object(moves, "generate", generated), mock.patch.object(Motions, "follow", followed):
            yield

    def of_cycles(self, spans: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
        """(duration, bound) of every cycle of a run, s."""
        arm = sorted((span for span in spans if span["lane"] == "arm"), key=lambda span: float(span["begin"]))
        # Calibration moves the arm by other means, parking is no part of a cycle.
        least = dict(zip((span["begin"] for span in arm), self.moves, strict=False))
        found = []
        for begin, end in cycles_of(spans):
            inside = within(spans, begin, end)
            grips = sum(span["end"] - span["begin"] for span in inside if span["lane"] == "gripper")
            moves = sum(bound for at, bound in least.items() if begin - 1e-9 <= at < end)
            found.append((end - begin, moves + grips))
        return found


def waits_of(spans: Sequence[Mapping[str, Any]]) -> list[float]:
    """For how long the arm stood in every cycle of a run while budgets of vision and planning were charged, s."""
    return [
        sum(
            span["end"] - span["begin"]
            for span in within(spans, begin, end)
            if span["lane"] == "computing" and span["name"] != "look ahead"
        )
        for begin, end in cycles_of(spans)
    ]


def seeing_times(seen: Seen, config: CellConfig, stages: defaultdict[str, float]) -> list[float]:
    """Times of detection and localisation of one picture, s; the first, which warms caches, aside.

    Args:
        seen: The picture.
        config: Of the cell.
        stages: Has the time of every stage added, s.
    """
    recipe = load_recipe(config.vision.recipe)
    plane = seen.calibration.plane(config.shape_plane_mm)
    times = []
    for _ in range(REPEATS + 1):
        began = process_time()
        detected = detect(seen.frame, recipe, plane=plane, region=seen.region, hidden=seen.hidden)
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


def pushing_times(seen: Seen, config: CellConfig) -> list[float]:
    """Time of every search for a push, for each located part that has no free grasp, s, from the ready pose."""
    arm, bins = load_arm(config.arm.description), config.bin_values()
    planner = Planner(arm, seen.calibration, bins)
    ready, area = np.array(arm.ready), config.work_area_outline(seen.calibration.T_base_table)
    things = seen.located.objects
    times = []
    for thing in things:
        others = [other for other in things if other is not thing]
        try:
            planner.plan_pick(thing, others, bins[0], bins[0].center, ready)
        except NoClearGrasp:
            for unsure in (False, True):
                began = process_time()
                with suppress(PlanError):
                    planner.plan_nudge(thing, others, area, ready, unsure=unsure)
                times.append(process_time() - began)
        except PlanError:
            continue  # it is not in the way of the jaws that it fails
    return times


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=5)
    parser.add_argument("--parts", type=int, default=10)
    parser.add_argument("--level", type=Level, default=Level.DYNAMIC)
    parser.add_argument("--first-seed", type=int, default=5000)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    keep_memory()
    config = load_cell(shipped("sim.toml"))
    seeing: list[float] = []
    planned: list[float] = []
    pushed: list[float] = []
    stages: defaultdict[str, float] = defaultdict(float)
    runs, cycles, waits = [], [], []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.cells):
        with tempfile.TemporaryDirectory() as folder:
            seen = look_at_cell(seed, arguments.parts, str(arguments.level), Path(folder))
        seeing += seeing_times(seen, config, stages)
        planned += planning_times(seen, config)
        for name, count in PUSHED:
            with tempfile.TemporaryDirectory() as folder:
                crowd = look_at_cell(seed, count, str(arguments.level), Path(folder), name)
            pushed += pushing_times(crowd, load_cell(shipped(name)))
        bounds = Bounds()
        with bounds.noting():
            spans = sort_one(Job(config, arguments.parts, seed, arguments.level)).get("spans", [])
        runs.append(spans)
        cycles += bounds.of_cycles(spans)
        waits += waits_of(spans)
    print(f"{arguments.cells} cells of {arguments.parts} parts, level {arguments.level}")
    met = [
        _within_budget("seeing", seeing, config.cycle.vision_budget_s),
        _within_budget("planning", planned, config.cycle.planning_budget_s),
        _within_budget("pushing", pushed, config.cycle.pushing_budget_s),
    ]
    whole = sum(stages.values())
    ordered = sorted(stages.items(), key=lambda item: -item[1])
    print("seeing is " + ", ".join(f"{stage} {100 * time / whole:.0f} %" for stage, time in ordered))
    if cycles:
        durations, least = np.array(cycles).T
        median, ratio = float(np.median(durations)), float(np.median(durations / least))
        added = float(np.median(waits))
        met += [median <= CYCLE, ratio <= RATIO, added <= WAITS]
        print(
            f"cycle     median {median:6.3f} s   p95 {np.percentile(durations, 95):6.3f}   "
            f"{_told(median <= CYCLE)}: <= {CYCLE} s"
        )
        print(
            f"bound     median {np.median(least):6.3f} s   cycle over bound {ratio:.3f}   "
            f"{_told(ratio <= RATIO)}: <= {RATIO}"
        )
        print(
            f"waits     median {added:6.3f} s   p95 {np.percentile(waits, 95):6.3f}   "
            f"{_told(added <= WAITS)}: <= {WAITS} s of a cycle for vision and planning at their budgets"
        )
    for lane, parts in breakdown(runs).items():
        shares = ", ".join(f"{name} {time:.3f}" for name, time in parts.items())
        print(f"  {lane:9s} {shares}  (mean s of a cycle)")
    return 0 if cycles and all(met) else 1


def _within_budget(name: str, times: Sequence[float], budget: float) -> bool:
    ms, limit = 1e3 * np.array(times), 1e3 * budget
    over = float((ms > limit).mean())
    print(
        f"{name:9s} median {np.median(ms):6.1f} ms  p95 {np.percentile(ms, 95):6.1f}  max {ms.max():6.1f}  "
        f"{_told(over <= OVER)}: budget {limit:.0f} ms, exceeded by {100 * over:.0f} % of {len(ms)}"
    )
    return over <= OVER


def _told(met: bool) -> str:
    return "met" if met else "MISSED"


if __name__ == "__main__":
    sys.exit(main())

"""Prints what motion costs and yields: planning time, durations beside the time-optimal ones, jerk, finger room.

Run: python -m tests.benchmarks.motion [count]
"""

from __future__ import annotations

import math
import sys
import time
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from controller.config.arm import load_arm
from controller.domain import ArmDescription, LocatedObject, Shape
from controller.errors import PlanError
from controller.motion import kinematics
from controller.motion.path import Path, join, line, speed_limits, stroke
from controller.motion.planner import Planner
from controller.motion.trajectory import PERIOD, acceleration_limits, fastest, generate
from tests.unit.motion.scene import PARTS, RX150, at, bins, calibration, part

AREA = np.vstack(
    [
        r * np.column_stack([np.cos(a), np.sin(a)])
        for r, a in ((285.0, np.radians(np.arange(-50, 51, 5))), (125.0, np.radians(np.arange(50, -51, -5))))
    ]
) - np.array([230.0, 0.0])


def inverse_time() -> None:
    """Time of one top-down solution."""
    repeats = 5000
    start = time.perf_counter()
    for _ in range(repeats):
        kinematics.inverse(RX150, (200.0, 40.0, 20.0), roll=0.3)
    print(f"top-down solution: {(time.perf_counter() - start) / repeats * 1e6:.0f} us")


def cycles(count: int) -> None:
    """Whole picks, each starting where the last one's retreat ended."""
    rng = np.random.default_rng(11)
    boxes = bins()
    planner = Planner(RX150, calibration(), boxes)
    q = np.array(RX150.ready)
    planning, motion, jerk = [], [], []
    for k in range(count):
        radius, azimuth = math.sqrt(rng.uniform(150.0**2, 260.0**2)), rng.uniform(-50.0, 50.0)
        target = part(PARTS[k % 5], rng.uniform(34.0, 45.0), at(radius, azimuth), rng.uniform(0.0, 6.28))
        box = boxes[int(rng.integers(len(boxes)))]
        start = time.perf_counter()
        plan = planner.plan_pick(target, (), box, box.center, q, pile=0.0, view=AREA)
        planning.append((time.perf_counter() - start) * 1e3)
        motion.append([move.duration for move in plan.trajectories])
        for move in plan.trajectories:
            jerk.append(np.abs(np.diff(move.positions, 3, axis=0)).max(axis=0) / PERIOD**3)
        q = plan.retreat.positions[-1]
    seconds = np.array(motion)
    total = seconds.sum(axis=1)
    print(
        f"planning of one pick (approach, carry, retreat, gate): median {np.median(planning):.1f} ms, "
        f"p95 {np.percentile(planning, 95):.1f} ms"
    )
    print("durations, median s: approach {:.2f}, carry {:.2f}, retreat {:.2f}".format(*np.median(seconds, axis=0)))
    print(f"approach + carry: median {np.median(seconds[:, :2].sum(axis=1)):.2f} s; all three {np.median(total):.2f} s")
    print("largest jerk by joint, rad/s^3:", np.max(jerk, axis=0).round().tolist())


def moves(count: int) -> tuple[list[Path], list[float]]:
    """Random moves from over a bin to a part, and their durations."""
    rng = np.random.default_rng(12)
    paths, seconds = [], []
    for _ in range(count):
        start = kinematics.inverse(RX150, (*_polar(rng, (230.0, 230.0), (80.0, 140.0)), 90.0))[0]
        place = _polar(rng, (150.0, 255.0), (-50.0, 50.0))
        low = kinematics.inverse(RX150, (*place, 19.0), roll=rng.uniform(-1.5, 1.5))[0]
        down = stroke(RX150, low, 60.0).reversed()
        paths.append(join(RX150, [line(RX150, start, down.start), down], [(100.0, 30.0)]))
        seconds.append(generate(RX150, paths[-1], "move").duration)
    return paths, seconds


def against_optimum(count: int) -> None:
    """Durations beside those without a jerk limit, own and (when installed) toppra's."""
    paths, seconds = moves(count)
    limits = speed_limits(RX150), acceleration_limits(RX150)
    own = np.array([fastest(path, *limits).times[-1] for path in paths])
    print(
        f"{count} moves: {np.median(seconds):.3f} s, own time-optimal {np.median(own):.3f} s, "
        f"ratio {np.median(np.array(seconds) / own):.3f} (worst {np.max(np.array(seconds) / own):.3f})"
    )
    if find_spec("toppra") is None:
        print("toppra is not installed: no outside oracle")
        return
    peer = np.array([_toppra(path) for path in paths])
    print(
        f"toppra {np.median(peer):.3f} s, ratio {np.median(np.array(seconds) / peer):.3f} "
        f"(worst {np.max(np.array(seconds) / peer):.3f}); own without jerk limit {np.median(own / peer):.3f}"
    )


def _toppra(path: Path) -> float:
    toppra: Any = import_module("toppra")

    toppra.setup_logging("ERROR")
    knots = np.linspace(0.0, path.length, 200)
    constraints: list[Any] = [
        toppra.constraint.JointVelocityConstraint(speed_limits(RX150)),
        toppra.constraint.JointAccelerationConstraint(acceleration_limits(RX150)),
    ]
    spline = toppra.SplineInterpolator(knots, path.spline(knots))
    solver = toppra.algorithm.TOPPRA(constraints, spline, parametrizer="ParametrizeConstAccel")
    return float(solver.compute_trajectory().duration)


def _polar(rng: np.random.Generator, radius: tuple[float, float], degrees: tuple[float, float]) -> tuple[float, float]:
    r, a = rng.uniform(*radius), math.radians(rng.uniform(*degrees))
    return r * math.cos(a), r * math.sin(a)


def finger_room(layouts: int) -> None:
    """Share of scattered parts the jaws can take at once, and after clearing whatever can be taken."""
    for name, radius in (("reactorx_150", 230.0), ("open_manipulator_x", 200.0)):
        arm = load_arm(name)
        for count in (4, 8, 12):
            now, cleared, total = 0, 0, 0
            for seed in range(layouts):
                things = pile(np.random.default_rng(seed), count)
                total += count
                free, left = _clear(arm, things, radius)
                now += free
                cleared += count - left
            print(
                f"finger room, {len(arm.joints)} joints, {count:2d} parts: {now / total:.0%} at once, "
                f"{cleared / total:.0%} after clearing"
            )


def pile(rng: np.random.Generator, count: int) -> list[LocatedObject]:
    """Parts scattered at random, touching at most (by their true outlines)."""
    from tests.unit.motion.scene import polygon_gap

    found: list[LocatedObject] = []
    while len(found) < count:
        radius, azimuth = math.sqrt(rng.uniform(150.0**2, 240.0**2)), rng.uniform(-50.0, 50.0)
        shape = PARTS[int(rng.integers(5))]
        size = rng.uniform(34.0, 44.0)
        thing = part(
            shape if shape is not Shape.RECTANGLE else Shape.SQUARE, size, at(radius, azimuth), rng.uniform(0, 6.3)
        )
        if all(polygon_gap(thing.footprint, other.footprint) > 1.0 for other in found):
            found.append(thing)
    return found


def _clear(arm: ArmDescription, things: list[LocatedObject], radius: float) -> tuple[int, int]:
    boxes = bins(radius)[::3]
    planner = Planner(arm, calibration(), boxes)
    at_once, left = 0, list(things)
    first = True
    while True:
        gone = []
        for thing in left:
            others = [other for other in left if other is not thing]
            try:
                planner.plan_pick(thing, others, boxes[0], boxes[0].center, np.array(arm.ready), pile=0.0)
            except PlanError:
                continue
            gone.append(thing)
        if first:
            at_once, first = len(gone), False
        if not gone:
            return at_once, len(left)
        left = [thing for thing in left if thing not in gone]


def main() -> None:
    """Run everything."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    inverse_time()
    cycles(count)
    against_optimum(count)
    finger_room(max(count // 10, 2))


if __name__ == "__main__":
    main()

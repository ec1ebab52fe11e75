"""Prints what motion costs and yields: planning time, durations beside the time-optimal ones, jerk.

Times are processor times. Ends in verdicts; 1 when something wanted is missed. toppra, where it is installed, is the
outside oracle: the same path without a jerk limit.

Run: python -m tests.benchmarks.motion [count]
"""

from __future__ import annotations

import math
import sys
import time
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from controller.errors import LimitViolation
from controller.motion import kinematics
from controller.motion.path import Path, join, line, speed_limits, stroke
from controller.motion.planner import Planner
from controller.motion.trajectory import PERIOD, SMOOTHING, acceleration_limits, fastest, generate
from tests.unit.motion.scene import PARTS, RX150, at, bins, calibration, part

_ORACLE_STEP = 0.005  # phase, of toppra's grid: our own
SOLUTION_US, PLANNING_MS, RATIO = 50.0, 10.0, 1.12  # what is wanted at most
JERK_SHARE = 1.1  # of 2 a / SMOOTHING: from full acceleration to full braking within the moving average
AREA = np.vstack(
    [
        r * np.column_stack([np.cos(a), np.sin(a)])
        for r, a in ((285.0, np.radians(np.arange(-50, 51, 5))), (125.0, np.radians(np.arange(50, -51, -5))))
    ]
) - np.array([230.0, 0.0])


def inverse_time() -> float:
    """Time of one top-down solution."""
    repeats = 5000
    start = time.process_time()
    for _ in range(repeats):
        kinematics.inverse(RX150, (200.0, 40.0, 20.0), roll=0.3)
    microseconds = (time.process_time() - start) / repeats * 1e6
    print(f"top-down solution: {microseconds:.0f} us")
    return microseconds


def cycles(count: int) -> tuple[float, float]:
    """Whole picks, each from where the last one ended: (median planning of all three moves, ms; jerk's share)."""
    rng = np.random.default_rng(11)
    boxes = bins()
    planner = Planner(RX150, calibration(), boxes).filled({box.name: 0.0 for box in boxes})
    q = np.array(RX150.ready)
    planning, motion, jerk = [], [], []
    for k in range(count):
        radius, azimuth = math.sqrt(rng.uniform(150.0**2, 260.0**2)), rng.uniform(-50.0, 50.0)
        target = part(PARTS[k % 5], rng.uniform(34.0, 45.0), at(radius, azimuth), rng.uniform(0.0, 6.28))
        box = boxes[int(rng.integers(len(boxes)))]
        start = time.process_time()
        plan = planner.plan_pick(target, (), box, box.center, q, view=AREA)
        planning.append((time.process_time() - start) * 1e3)
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
    bound = 2.0 * acceleration_limits(RX150) / SMOOTHING
    largest = np.max(jerk, axis=0)
    print("largest jerk by joint, rad/s^3:", largest.round().tolist(), "beside 2 a / window", bound.round().tolist())
    return float(np.median(planning)), float((largest / bound).max())


def moves(count: int) -> tuple[list[Path], list[float], float]:
    """Random moves from over a bin to a part, their durations, and the median time to plan one, ms."""
    rng = np.random.default_rng(12)
    gate = Planner(RX150, calibration(), bins()).gate
    paths, seconds, planning = [], [], []
    for _ in range(count):
        start = kinematics.inverse(RX150, (*_polar(rng, (230.0, 230.0), (80.0, 140.0)), 90.0))[0]
        place = _polar(rng, (150.0, 255.0), (-50.0, 50.0))
        roll = rng.uniform(-1.5, 1.5)
        began = time.process_time()
        low = kinematics.inverse(RX150, (*place, 19.0), roll=roll)[0]
        down = stroke(RX150, low, 60.0).reversed()
        paths.append(join(RX150, [line(RX150, start, down.start), down], [(100.0, 30.0)]))
        move = generate(RX150, paths[-1], "move")
        with suppress(LimitViolation):  # random starts may lie too near to a bin: to find that out costs as much
            gate.check(move, start)
        planning.append((time.process_time() - began) * 1e3)
        seconds.append(move.duration)
    print(
        f"planning of one move (inverse kinematics, path, timing, gate): median {np.median(planning):.1f} ms, "
        f"p95 {np.percentile(planning, 95):.1f} ms"
    )
    return paths, seconds, float(np.median(planning))


def against_optimum(count: int) -> tuple[float, float]:
    """Random moves: (duration beside the time-optimal one without a jerk limit, time to plan one, ms), medians.

    The optimum is toppra's where it is installed, else our own.
    """
    paths, seconds, planning = moves(count)
    limits = speed_limits(RX150), acceleration_limits(RX150)
    own = np.array([fastest(path, *limits).times[-1] for path in paths])
    print(
        f"{count} moves: {np.median(seconds):.3f} s, own time-optimal {np.median(own):.3f} s, "
        f"ratio {np.median(np.array(seconds) / own):.3f} (worst {np.max(np.array(seconds) / own):.3f})"
    )
    if find_spec("toppra") is None:
        print("toppra is not installed: no outside oracle")
        return float(np.median(np.array(seconds) / own)), planning
    peer = np.array([_toppra(path) for path in paths])
    print(
        f"toppra {np.median(peer):.3f} s, ratio {np.median(np.array(seconds) / peer):.3f} "
        f"(worst {np.max(np.array(seconds) / peer):.3f}); own without jerk limit {np.median(own / peer):.3f}"
    )
    return float(np.median(np.array(seconds) / peer)), planning


def _toppra(path: Path) -> float:
    toppra: Any = import_module("toppra")

    toppra.setup_logging("ERROR")
    knots = np.linspace(0.0, path.length, 200)
    constraints: list[Any] = [
        toppra.constraint.JointVelocityConstraint(speed_limits(RX150)),
        toppra.constraint.JointAccelerationConstraint(acceleration_limits(RX150)),
    ]
    spline = toppra.SplineInterpolator(knots, path.spline(knots))
    grid = np.linspace(0.0, path.length, max(int(path.length / _ORACLE_STEP), 200))
    solver = toppra.algorithm.TOPPRA(constraints, spline, gridpoints=grid, parametrizer="ParametrizeConstAccel")
    return float(solver.compute_trajectory().duration)


def _polar(rng: np.random.Generator, radius: tuple[float, float], degrees: tuple[float, float]) -> tuple[float, float]:
    r, a = rng.uniform(*radius), math.radians(rng.uniform(*degrees))
    return r * math.cos(a), r * math.sin(a)


def _verdict(what: str, value: float, wanted: float, unit: str = "") -> bool:
    good = value <= wanted
    print(f"{what}: {value:.3g}{unit}, wanted {wanted:g}{unit}: {'pass' if good else 'FAIL'}")
    return good


def main() -> int:
    """Run everything."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    solution = inverse_time()
    pick, jerk = cycles(count)
    ratio, planning = against_optimum(count)
    good = [
        _verdict("top-down solution", solution, SOLUTION_US, " us"),
        _verdict("planning of one move with its gate", planning, PLANNING_MS, " ms"),
        _verdict("duration beside the time-optimal one without a jerk limit", ratio, RATIO),
        _verdict("jerk beside 2 a / window", jerk, JERK_SHARE),
    ]
    print(f"for comparison, a whole pick (choice of the grasp, three moves, gate): {pick:.1f} ms, no verdict")
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())

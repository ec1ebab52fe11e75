"""Parts let go over a bin in physics: do they stay in it until it is full?

Without an arm: parts of one shape and three sizes are let go one by one where and as high as the cell would, their
sides along the bin's, into the bin that the shipped rules send them to. 1 when one slides over a wall.

    python -m tests.benchmarks.drops [--shapes rectangle ...] [--fills N] [--seed N]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

import numpy as np

from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.cycle.stock import drop_points, pile_of
from controller.domain import Array, Bin, Shape
from controller.geometry import transform
from controller.motion.gate import WALL_MARGIN
from controller.motion.overhead import PART_BELOW_TIPS
from controller.motion.postures import SETTLING
from sim_backends.imperfections import draw
from sim_backends.parts import SHAPES, Part
from sim_backends.world import World

CONFIG = load_cell(shipped("sim.toml"))
T_BASE_TABLE = CONFIG.table.T_base_table()
GRIPS = (36.0, 43.0, 50.0)
ASTRAY = 2.0  # mm: a part hangs a little beside its place
FALLING = 0.9  # s until all lie still


def parts_for(shape: Shape, count: int, rng: np.random.Generator) -> list[Part]:
    """Parts of one shape as the simulated cell makes them."""
    height = {section.shape: section.height_mm for section in CONFIG.parts}[shape]
    return [
        Part(
            shape=shape, colour="red", grip=float(rng.choice(GRIPS)), height=height, mass=0.02,
            friction=float(rng.uniform(0.3, 0.8)), x=0.0, y=0.0, yaw=0.0,
        )
        for _ in range(count)
    ]  # fmt: skip


def lost_of(bin_: Bin, parts: Sequence[Part], rng: np.random.Generator, seed: int) -> int:
    """How many of the parts do not stay in the bin."""
    arm, bins = load_arm(CONFIG.arm.description), CONFIG.bin_values()
    world = World(arm, bins, T_BASE_TABLE, parts, draw("dynamic", seed), spares=len(parts))
    longest = 0.0
    for count, part in enumerate(parts):
        at = np.array(drop_points(bin_)[count % 4]) + rng.uniform(-ASTRAY, ASTRAY, 2)
        x, y, _ = transform(T_BASE_TABLE, [*at, 0.0])
        # It hangs below the tips, which stay over the brim and over what may lie there.
        foot = max(bin_.height + WALL_MARGIN + SETTLING - PART_BELOW_TIPS, pile_of(bin_, count, longest) + 1.0)
        world.loose.lay_at(count, float(x), float(y), float(rng.integers(12)) * turn_of(part.shape), foot)
        world.advance(FALLING)
        longest = max(longest, *part.size)
    half = np.array(bin_.size) / 2.0
    middle = transform(T_BASE_TABLE, [*bin_.center, 0.0])[:2]
    apart: Array = np.abs(world.loose.poses()[:, :2] - middle)
    return int((apart > half).any(axis=1).sum())


def turn_of(shape: Shape) -> float:
    """Between the directions in which the jaws, which stand along the bin's sides, may hold a shape, rad."""
    return math.pi / 2.0 if shape in (Shape.SQUARE, Shape.RECTANGLE) else math.pi / 6.0


def main() -> int:
    """Print what stayed; 1 when something did not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", nargs="+", type=Shape, default=SHAPES)
    parser.add_argument("--fills", type=int, default=20, help="of the bin, of each shape")
    parser.add_argument("--seed", type=int, default=1000)
    options = parser.parse_args()
    total = 0
    for shape in options.shapes:
        name = CONFIG.bin_for(shape, str(shape), GRIPS[1], None)
        bin_ = next(bin_ for bin_ in CONFIG.bin_values() if bin_.name == name)
        lost = 0
        for seed in range(options.seed, options.seed + options.fills):
            rng = np.random.default_rng([seed, SHAPES.index(shape)])
            lost += lost_of(bin_, parts_for(shape, bin_.capacity, rng), rng, seed)
        size = f"{bin_.size[0]:g} x {bin_.size[1]:g} x {bin_.height:g} mm"
        print(f"{shape}: {lost} of {options.fills * bin_.capacity} slid out of a bin of {size}", flush=True)
        total += lost
    print(f"lost: {total}, wanted 0: {'FAIL' if total else 'pass'}")
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())

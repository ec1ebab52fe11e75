"""Parts let go over a bin in physics: do they stay in it until it is full?

Without an arm: parts of one shape and three sizes are let go one by one where and as high as the cell would, into the
bin that the shipped rules send them to: their sides along the bin's, or anyhow for an arm that cannot turn its wrist.
Counts what slides over a wall, and what comes to lie over one, where jaws go for the bin beside. 1 when one slides out.

    python -m tests.benchmarks.drops [--arm NAME] [--shapes rectangle ...] [--parts N] [--fills N] [--seed N]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

import mujoco
import numpy as np

from controller.cli.config import default_config
from controller.config.arm import load_arm
from controller.config.cell import CellConfig, load_cell
from controller.cycle.stock import drop_points, pile_of
from controller.domain import Array, Bin, Shape
from controller.geometry import transform
from controller.motion.gate import WALL, WALL_MARGIN
from controller.motion.overhead import PART_BELOW_TIPS
from controller.motion.postures import SETTLING, between_walls
from sim_backends.imperfections import draw
from sim_backends.parts import SHAPES, Part, placed
from sim_backends.world import World

GRIPS = (36.0, 43.0, 50.0)
ASTRAY = 2.0  # mm: a part hangs a little beside its place
FALLING = 0.9  # s until all lie still


def parts_for(config: CellConfig, shape: Shape, count: int, rng: np.random.Generator) -> list[Part]:
    """Parts of one shape as the simulated cell makes them."""
    height = {section.shape: section.height_mm for section in config.parts}[shape]
    return [
        Part(
            shape=shape, colour="red", grip=float(rng.choice(GRIPS)), height=height, mass=0.02,
            friction=float(rng.uniform(0.3, 0.8)), x=0.0, y=0.0, yaw=0.0,
        )
        for _ in range(count)
    ]  # fmt: skip


def fill(
    config: CellConfig, bin_: Bin, parts: Sequence[Part], rng: np.random.Generator, seed: int
) -> tuple[int, int]:
    """How many of the parts do not stay in the bin, and how many lie over its walls."""
    arm, bins, T_base_table = load_arm(config.arm.description), config.bin_values(), config.table.T_base_table()
    world = World(arm, bins, T_base_table, parts, draw("dynamic", seed), spares=len(parts))
    longest = 0.0
    for count, part in enumerate(parts):
        turns = len(arm.joints) > 4
        yaw = float(rng.integers(12)) * turn_of(part.shape) if turns else float(rng.uniform(0.0, 2.0 * math.pi))
        aim = between_walls(bin_, drop_points(bin_)[count % 4], placed(part.outline, 0.0, 0.0, yaw))
        at = np.array(aim) + rng.uniform(-ASTRAY, ASTRAY, 2)
        x, y, _ = transform(T_base_table, [*at, 0.0])
        # It hangs below the tips, which stay over the brim and over what may lie there.
        foot = max(bin_.height + WALL_MARGIN + SETTLING - PART_BELOW_TIPS, pile_of(bin_, count, longest) + 1.0)
        world.loose.lay_at(count, float(x), float(y), yaw, foot)
        world.advance(FALLING)
        longest = max(longest, *part.size)
    half = np.array(bin_.size) / 2.0
    middle = transform(T_base_table, [*bin_.center, 0.0])
    lost = over = 0
    for part, pose in zip(parts, world.loose.poses(), strict=True):
        apart = np.abs(_corners(part, pose)[:, :2] - middle[:2])
        out = bool((np.abs(pose[:2] - middle[:2]) > half).any())
        lost += out
        over += not out and bool((apart > half + WALL).any())
    return lost, over


def _corners(part: Part, pose: Array) -> Array:
    """Corners (N, 3) in `base` of a part whose centre and quaternion are given (7,), mm."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, pose[3:])
    ring = part.outline
    both = np.vstack([np.column_stack([ring, np.full(len(ring), z * part.height / 2.0)]) for z in (-1.0, 1.0)])
    return np.asarray(both @ rotation.reshape(3, 3).T + pose[:3])


def turn_of(shape: Shape) -> float:
    """Between the directions in which the jaws, which stand along the bin's sides, may hold a shape, rad."""
    return math.pi / 2.0 if shape in (Shape.SQUARE, Shape.RECTANGLE) else math.pi / 6.0


def main() -> int:
    """Print what stayed; 1 when something did not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="reactorx_150", help="whose cell")
    parser.add_argument("--shapes", nargs="+", type=Shape, default=SHAPES)
    parser.add_argument("--parts", type=int, help="into a bin; as many as it is said to hold when not given")
    parser.add_argument("--fills", type=int, default=20, help="of the bin, of each shape")
    parser.add_argument("--seed", type=int, default=1000)
    options = parser.parse_args()
    config = load_cell(default_config(options.arm))
    total = 0
    for shape in options.shapes:
        name = config.bin_for(shape, str(shape), GRIPS[1], None)
        bin_ = next(bin_ for bin_ in config.bin_values() if bin_.name == name)
        count = options.parts or bin_.capacity
        lost = over = 0
        for seed in range(options.seed, options.seed + options.fills):
            rng = np.random.default_rng([seed, SHAPES.index(shape)])
            out, across = fill(config, bin_, parts_for(config, shape, count, rng), rng, seed)
            lost, over = lost + out, over + across
        size = f"{bin_.size[0]:g} x {bin_.size[1]:g} x {bin_.height:g} mm"
        told = f"{lost} of {options.fills * count} slid out of a bin of {size}, {over} lie over its walls"
        print(f"{shape}: {told}", flush=True)
        total += lost
    print(f"lost: {total}, wanted 0: {'FAIL' if total else 'pass'}")
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())

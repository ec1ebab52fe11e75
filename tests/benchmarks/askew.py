"""Parts that lie askew before an arm without wrist roll, taken in physics: which turns do its jaws hold?

A part alone on the table, turned from the closing direction by so much, is gripped, proved and carried to a bin.

    python -m tests.benchmarks.askew [triangle|square] [--turns 10 15 20 25 28 30] [--friction 0.3 0.6]

Exit code 1 when one is lost.
"""

from __future__ import annotations

import argparse
import math
import sys

from controller.cli.config import default_config
from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.cycle import proof
from controller.domain import Shape
from controller.motion.planner import Planner
from controller.service.manual import by_ruler
from drivers.arm.dynamixel import DynamixelArm
from sim_backends.cell import SimulatedCell
from sim_backends.cell_spec import HEIGHTS, CellSpec
from sim_backends.parts import DENSITY, Part, area, outline
from sim_backends.virtual_dynamixel import BusStream, ServoSpec, VirtualBus
from tests.unit.motion.scene import part

ARM = "open_manipulator_x"
GRIPS = (34.0, 45.0)
RADIUS, AZIMUTH = 200.0, 0.3
TURNS = {Shape.TRIANGLE: [10.0, 15.0, 20.0, 25.0, 28.0, 30.0], Shape.SQUARE: [28.0, 32.0, 38.0, 44.0]}


def take(shape: Shape, grip: float, turn: float, friction: float) -> str | None:
    """Take one part; None when it came to its bin, else what went wrong.

    Args:
        shape, grip, friction: Of the part.
        turn: Between one of its flats and the closing direction, deg.
    """
    config, kind, height = load_cell(default_config(ARM)), load_arm(ARM), HEIGHTS[shape]
    x, y = RADIUS * math.cos(AZIMUTH), RADIUS * math.sin(AZIMUTH)
    mass = DENSITY * height * area(outline(shape, grip))
    lies = Part(shape, "red", grip, height, mass, friction, x, y, AZIMUTH + math.radians(turn))
    rows = tuple(tuple(float(value) for value in row) for row in config.table.T_base_table())
    spec = CellSpec(arm=kind, bins=config.bin_values(), T_base_table=rows, level="ideal")
    cell = SimulatedCell(spec, [lies])
    bus = VirtualBus(cell.plant, [ServoSpec(*servo) for servo in cell.bus_servos], baud=kind.baud)
    arm = DynamixelArm(kind, BusStream(bus), cell.clock)
    arm.open()
    arm.energise()
    planner = Planner(kind, by_ruler(config), config.bin_values())
    arm.follow(planner.home(arm.state().positions))
    truth = cell.truth()[0]
    thing = part(shape, grip, truth.center, truth.yaw or 0.0, height)
    bin_ = planner.bins[0]
    plan = planner.plan_pick(thing, (), bin_, bin_.center, arm.state().positions, corners=True)
    arm.follow(plan.approach, plan.grasp.opening)
    report = arm.grip(proof.closing_target(plan.grasp, kind.gripper))
    refusal = proof.refusal(report, plan.grasp, thing.sigma)
    if refusal is None:
        refusal = proof.lost(arm.follow(plan.carry).state, plan.grasp)
    return refusal


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shape", nargs="?", type=Shape, choices=tuple(TURNS), default=Shape.TRIANGLE)
    parser.add_argument("--turns", type=float, nargs="+", help="deg")
    parser.add_argument("--friction", type=float, nargs="+", default=[0.3, 0.6])
    asked = parser.parse_args()
    tried = held = 0
    for turn in asked.turns or TURNS[asked.shape]:
        for friction in asked.friction:
            for grip in GRIPS:
                refusal = take(asked.shape, grip, turn, friction)
                tried, held = tried + 1, held + (refusal is None)
                what = f"{asked.shape} of {grip:g} mm, {turn:g} deg, friction {friction:g}"
                print(f"{what}: {refusal or 'held'}", flush=True)
    print(f"{'met' if held == tried else 'MISSED'}: {held} of {tried} came to their bin")
    return 0 if held == tried else 1


if __name__ == "__main__":
    sys.exit(main())

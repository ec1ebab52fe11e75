"""Crowded tables in physics: do the jaws ever touch a neighbour, and does a push make room?

Eight parts, 1 mm apart at least, in a cell whose link masses and servo gains are off by up to 10 %; the planner is
told where everything lies within 0.3 mm and 0.3 degrees (standard deviations), as the camera would. Without `--clear`
the tightest grasp of every layout is carried out once; with it the table is cleared, by pushes where no grasp is free.
A touch is any contact of the arm with what it does not mean to take or to push; 1 when there is one.

    python -m tests.benchmarks.crowded [--arm NAME] [--layouts N] [--seed N] [--parts N] [--clear]
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections import Counter

import numpy as np

from controller.cli.config import default_config
from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.cycle import proof
from controller.domain import LocatedObject, NudgePlan, PickPlan
from controller.errors import NoClearGrasp, PlanError
from controller.motion.grasps import release_opening
from controller.motion.planner import Planner
from controller.service.manual import by_ruler
from drivers.arm.dynamixel import DynamixelArm
from sim_backends.cell import SimulatedCell
from sim_backends.cell_spec import CellSpec
from sim_backends.parts import WorkArea
from sim_backends.virtual_dynamixel import BusStream, ServoSpec, VirtualBus
from tests.benchmarks.identification import OffGains
from tests.unit.motion.scene import part

NOISE_MM, NOISE_DEG = 0.3, 0.3
MOST_NUDGES = 3


class Table:
    """One layout, the arm that works on it, and what became of it."""

    def __init__(self, name: str, parts: int, seed: int, found: Counter[str]) -> None:
        self.config = load_cell(default_config(name)).model_copy()
        self.arm_kind = load_arm(name)
        self.found = found
        self.rng = np.random.default_rng([seed, 5])
        scale = tuple(float(v) for v in 1.0 + self.rng.uniform(-0.1, 0.1, 6))
        area = self.config.table.work_area
        low, high = np.radians(area.azimuth_deg)
        spec = CellSpec(
            arm=self.arm_kind,
            bins=self.config.bin_values(),
            T_base_table=tuple(tuple(float(v) for v in row) for row in self.config.table.T_base_table()),
            parts=parts,
            seed=seed,
            level="ideal",
            overrides={"link_scale": scale, "part_gap": 1.0},
            grips=(34.0, 38.0, 42.0),
            work_area=WorkArea((area.inner_radius_mm + 5.0, area.outer_radius_mm - 5.0), (low + 0.05, high - 0.05)),
        )
        self.cell = SimulatedCell(spec)
        ids = [joint.servo_id for joint in self.arm_kind.joints]
        gains = dict(zip(ids, (1.0 + self.rng.uniform(-0.1, 0.1, len(ids))).tolist(), strict=True))
        servos = [ServoSpec(*servo) for servo in self.cell.bus_servos]
        bus = VirtualBus(OffGains(self.cell.plant, gains), servos, baud=self.arm_kind.baud)
        self.arm = DynamixelArm(self.arm_kind, BusStream(bus), self.cell.clock)
        self.arm.open()
        self.arm.energise()
        self.planner = Planner(self.arm_kind, by_ruler(self.config), self.config.bin_values())
        self.area = self.config.work_area_outline(self.config.table.T_base_table())
        self.arm.follow(self.planner.home(self.arm.state().positions))
        self.tries: Counter[int] = Counter()

    def seen(self) -> dict[int, LocatedObject]:
        """What still lies on the table, as a camera would see it, by part."""
        things = {}
        for truth, made in zip(self.cell.truth(), self.cell.world.parts, strict=True):
            if truth.place == "table" and truth.upright:
                dx, dy = self.rng.normal(0.0, NOISE_MM, 2)
                yaw = (truth.yaw or 0.0) + np.radians(self.rng.normal(0.0, NOISE_DEG))
                place = (truth.center[0] + dx, truth.center[1] + dy)
                things[truth.part_id] = part(truth.shape, made.grip, place, float(yaw), truth.height)
        return things

    def plans(self, things: dict[int, LocatedObject]) -> tuple[dict[int, PickPlan], list[int]]:
        """What can be taken, tightest first, and what lacks room."""
        start = self.arm.state().positions
        plans, stuck = {}, []
        for index, thing in things.items():
            others = [other for other in things.values() if other is not thing]
            bin_ = self.planner.bins[index % len(self.planner.bins)]
            try:
                plans[index] = self.planner.plan_pick(thing, others, bin_, bin_.center, start)
            except NoClearGrasp:
                stuck.append(index)
            except PlanError:
                self.found["out of reach"] += 1
        return dict(sorted(plans.items(), key=lambda item: item[1].grasp.clearance)), stuck

    def take(self, index: int, plan: PickPlan) -> None:
        """Carry a pick out and count what happens."""
        before = len(self.cell.collisions)
        arm, kind = self.arm, self.arm_kind
        arm.follow(plan.approach, plan.grasp.opening)
        report = arm.grip(proof.closing_target(plan.grasp, kind.gripper))
        self.found["picks"] += 1
        if proof.refusal(report, plan.grasp, plan.target.sigma) is None:
            self.found["held"] += 1
            arm.follow(plan.carry)
            arm.grip(release_opening(plan.grasp))
            arm.follow(plan.retreat)
        else:
            arm.grip(plan.grasp.opening)
            arm.follow(self.planner.home(arm.state().positions))
        self._count(before, index)

    def nudge(self, index: int, things: dict[int, LocatedObject], unsure: bool) -> bool:
        """Push for one part, surely or not; False when there is no push."""
        others = [other for k, other in things.items() if k != index]
        start = self.arm.state().positions
        try:
            plan: NudgePlan = self.planner.plan_nudge(things[index], others, self.area, start, unsure=unsure)
        except PlanError:
            return False
        self.tries[index] += 1
        moved = next(k for k, thing in things.items() if thing is plan.moved)
        before = len(self.cell.collisions)
        self.arm.follow(plan.approach, plan.opening)
        self.arm.follow(plan.push)
        self.arm.follow(plan.retreat)
        self.found["nudges"] += 1
        self._count(before, moved)
        self.found["freed"] += index in self.plans(self.seen())[0]
        return True

    def _count(self, before: int, meant: int) -> None:
        touched = {touch.other for touch in self.cell.collisions[before:]} - {f"part{meant}"}
        self.found["touches"] += bool(touched)
        for other in touched:
            self.found[f"touched {other.rstrip('0123456789')}"] += 1

    def clear(self) -> None:
        """Take what can be taken and push where nothing can, until neither helps."""
        while True:
            things = self.seen()
            plans, stuck = self.plans(things)
            if plans:
                self.take(*next(iter(plans.items())))
                if self.found["picks"] > 400:
                    return
                continue
            ways = itertools.product((False, True), stuck)
            if not any(self.tries[k] < MOST_NUDGES and self.nudge(k, things, unsure) for unsure, k in ways):
                return


def main() -> int:
    """Print the counts; 1 when anything was touched."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="reactorx_150")
    parser.add_argument("--layouts", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--parts", type=int, default=8)
    parser.add_argument("--clear", action="store_true")
    options = parser.parse_args()
    found: Counter[str] = Counter()
    left = 0
    for seed in range(options.seed, options.seed + options.layouts):
        table = Table(options.arm, options.parts, seed, found)
        if options.clear:
            table.clear()
            left += len(table.seen())
            continue
        plans, _ = table.plans(table.seen())
        if plans:
            table.take(*next(iter(plans.items())))
    print(f"{options.arm}: {options.layouts} layouts of {options.parts} parts: {dict(found)}")
    if options.clear:
        total = options.layouts * options.parts
        print(f"cleared {total - left} of {total}")
    touches = found["touches"]
    print(f"touches of neighbours: {touches}, wanted 0: {'FAIL' if touches else 'pass'}")
    return 1 if touches else 0


if __name__ == "__main__":
    sys.exit(main())

"""Prints how well the arm follows its plans before and after identification, in physics whose arm is not as described.

Link masses are off by up to 20 %, so are the servos' gains; link play and joint offsets are left out, for encoders
cannot see them. Vertical strokes and picks at places that were not part of the identification. Ends in verdicts.

Run: python -m tests.benchmarks.identification [cells] [gain error] [mass error]
"""

from __future__ import annotations

import sys
from functools import partial

import numpy as np

from controller.cli.config import default_config
from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.domain import ArmDescription, Array, ServoCycle
from controller.geometry import transform
from controller.motion.identification import Identification, identified, identify, ordinary_moves
from controller.motion.kinematics import inverse
from controller.motion.path import join, line, stroke
from controller.motion.planner import Planner
from controller.motion.trajectory import generate
from controller.service.manual import by_ruler
from drivers.arm.dynamixel import DynamixelArm
from sim_backends.cell import SimulatedCell
from sim_backends.cell_spec import CellSpec
from sim_backends.plant import Drive, Plant
from sim_backends.virtual_dynamixel import ServoSpec, VirtualBus
from tests.unit.drivers.bench import WireTap
from tests.unit.motion.scene import RX150

STRAIGHT, TIP = 1.5, 1.0  # mm, what is wanted at most after identification
GRASP, LIFT = 19.0, 60.0  # mm; the jaw tips end 4 mm above the table


class OffGains:
    """A plant whose servos push harder or softer per angle than their registers say."""

    def __init__(self, plant: Plant, gains: dict[int, float]) -> None:
        self.now, self.advance, self.shaft, self.on_step = plant.now, plant.advance, plant.shaft, plant.on_step
        self._plant = plant
        self._gains = gains

    def drive(self, servo_id: int, drive: Drive) -> None:
        self._plant.drive(servo_id, drive._replace(stiffness=drive.stiffness * self._gains.get(servo_id, 1.0)))


class Bench:
    """An arm in physics, with masses and gains of its own.

    Args:
        seed: Of masses and gains.
        gain: Largest error of a servo's gain, as a share of it.
        mass: Largest error of a link's mass, as a share of it.
        name: Which arm.
        load: Mass that is fixed in its hand, kg.
    """

    def __init__(self, seed: int, gain: float, mass: float, name: str = "reactorx_150", load: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        self.kind = load_arm(name)
        self.config = load_cell(default_config(name))
        links = len(self.kind.links)
        scale = 1.0 + rng.uniform(-mass, mass, 6)
        scale[links - 1] += load / self.kind.links[-1].mass
        spec = CellSpec(
            arm=self.kind,
            bins=self.config.bin_values(),
            T_base_table=_rows(self.config.table.T_base_table()),
            parts=1,
            seed=seed,
            level="ideal",
            overrides={"link_scale": tuple(scale.tolist())},
        )
        self.cell = SimulatedCell(spec)
        self.cell.set_aside()
        servos = [ServoSpec(*servo) for servo in self.cell.bus_servos]
        self.gains = 1.0 + rng.uniform(-gain, gain, len(self.kind.joints))
        ids = [joint.servo_id for joint in self.kind.joints]
        plant = OffGains(self.cell.plant, dict(zip(ids, self.gains.tolist(), strict=True)))
        self.bus = VirtualBus(plant, servos, baud=self.kind.baud, seed=seed)
        self.stream = WireTap(self.bus, self.cell.plant)
        self.arm = DynamixelArm(self.kind, self.stream, self.cell.clock)
        self.arm.open()
        self.arm.energise()

    def planner(self, speed: float = 1.0, part_mass: float = 0.02) -> Planner:
        """Of its cell as described."""
        calibration = by_ruler(self.config)
        return Planner(self.kind, calibration, self.config.bin_values(), speed=speed, part_mass=part_mass)

    def tool(self) -> Array:
        """Where the grasp point truly is, `base`, mm."""
        return transform(self.config.table.T_base_table(), self.cell.tool())


def _rows(pose: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in pose)


def learn(bench: Bench) -> Identification:
    """What the arm's ordinary moves say about it."""
    planner = bench.planner(speed=0.7)
    moves: list[list[ServoCycle]] = []
    cycles: list[ServoCycle] = []
    bench.arm.listen(cycles.append)
    bench.arm.follow(planner.home(bench.arm.state().positions))
    for goal in (*ordinary_moves(RX150, 90.0), np.array(RX150.ready)):
        cycles.clear()
        bench.arm.follow(planner.plan_move("identify", bench.arm.state().positions, goal))
        moves.append(list(cycles))
    bench.arm.listen(None)
    return identify(RX150, moves)


def strokes(bench: Bench, model: ArmDescription, count: int = 10) -> Array:
    """Descents from above to a grasp at full speed: ndarray of shape (count, 2): largest sideways distance from the
    vertical in the lowest 30 mm, and distance of the grasp point from where it should be at the end, mm.
    """
    rng = np.random.default_rng(99)
    out = []
    q = np.array(RX150.ready)
    bench.arm.follow(bench.planner().home(bench.arm.state().positions))
    for _ in range(count):
        radius, azimuth = rng.uniform(155.0, 255.0), rng.uniform(-0.85, 0.85)
        goal = (radius * np.cos(azimuth), radius * np.sin(azimuth), GRASP)
        low = inverse(model, goal, roll=rng.uniform(-1.2, 1.2))[0]
        down = stroke(model, low, LIFT).reversed()
        way: list[Array] = []
        bench.arm.listen(partial(_note, bench, way))
        bench.arm.follow(generate(model, join(model, [line(model, q, down.start), down], [(100.0, 30.0)]), "descent"))
        bench.arm.listen(None)
        track = np.array(way)
        deep = track[track[:, 2] < GRASP + 30.0]
        sideways = np.linalg.norm(deep[:, :2] - goal[:2], axis=1).max()
        out.append((sideways, float(np.linalg.norm(track[-1] - goal))))
        bench.arm.follow(generate(model, join(model, [stroke(model, low, LIFT)], []), "lift"))
        q = down.start
    return np.array(out)


def _note(bench: Bench, way: list[Array], cycle: ServoCycle) -> None:
    way.append(bench.tool())


def main() -> int:
    """Print the figures and verdicts; 1 when something wanted is missed."""
    cells = int(sys.argv[1]) if len(sys.argv) > 1 else 4
    gain, mass = (float(sys.argv[k]) if len(sys.argv) > k else 0.2 for k in (2, 3))
    figures: dict[str, list[Array]] = {"before": [], "after": []}
    for seed in range(cells):
        bench = Bench(seed, gain, mass)
        figures["before"].append(strokes(bench, RX150))
        found = learn(bench)
        figures["after"].append(strokes(bench, identified(RX150, found.joints, found.link_scale)))
        described = [joint.dynamics.stiffness for joint in RX150.joints]
        ratio = np.array([joint.stiffness for joint in found.joints]) / described
        print(f"cell {seed}: gains {bench.gains.round(2).tolist()}, found {ratio.round(2).tolist()}")
        print(f"  links {np.round(bench.cell.imperfections.link_scale, 2).tolist()}, ", end="")
        print(f"found {np.round(found.link_scale, 2).tolist()}; {found.samples} samples")
        off, left = ((rms * 1e3).round(1).tolist() for rms in (found.before, found.after))
        print(f"  model off by, mrad: {off} -> {left}")
        for name, rows in figures.items():
            print(f"  {name}: {_line(rows[-1])}")
    for name, rows in figures.items():
        print(f"all {name}: {_line(np.concatenate(rows))}")
    before, after = (np.concatenate(figures[name]) for name in ("before", "after"))
    good = []
    for column, (what, wanted) in enumerate((("vertical off by", STRAIGHT), ("tip at the grasp off by", TIP))):
        for name, share in (("median", 50), ("worst", 100)):
            was, now = (float(np.percentile(rows[:, column], share)) for rows in (before, after))
            good.append(now <= wanted)
            verdict = "pass" if good[-1] else "FAIL"
            print(f"{what}, {name}: {now:.2f} mm, before {was:.2f}, wanted {wanted:g}: {verdict}")
    return 0 if all(good) else 1


def _line(rows: Array) -> str:
    vertical, tip = rows.T
    return (
        f"vertical off by median {np.median(vertical):.2f}, worst {vertical.max():.2f} mm; tip at the grasp off by "
        f"median {np.median(tip):.2f}, p95 {np.percentile(tip, 95):.2f}, worst {tip.max():.2f} mm"
    )


if __name__ == "__main__":
    sys.exit(main())

"""How the arm stops, pauses and goes on in physics whose masses and gains are off by up to 10 %.

Moves of picks at full speed, interrupted at random moments: by a stop, by a pause of half a second, by a sender that
stalls for 200 ms. Printed: how far the tool swings past where it comes to rest, how far off its path it is, the way
and the time it takes to stand, and where the move ends that was interrupted.

    python -m tests.benchmarks.stopping [--moves N] [--seed N]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from controller.domain import Array, Trajectory
from controller.motion.kinematics import points
from controller.motion.planner import Planner
from controller.service.manual import by_ruler
from tests.benchmarks.identification import CELL, Bench
from tests.unit.motion.scene import PARTS, RX150, at, part

SPEED = 10.0  # mm/s below which the tool stands


@dataclass(frozen=True)
class Found:
    """What one interruption did: mm and s."""

    past: float
    off_path: float
    way: float
    standing: float
    end: float


class Interrupted:
    """An arm whose moves are interrupted."""

    def __init__(self, seed: int) -> None:
        self.bench = Bench(seed, 0.1, 0.1)
        self.planner = Planner(RX150, by_ruler(CELL), CELL.bin_values())
        self.rng = np.random.default_rng(seed)
        self._due: list[tuple[float, Callable[[], None]]] = []
        self._track: list[tuple[float, Array]] = []
        self.bench.arm.grip(45.0)  # as on a part: narrow enough for the bins
        self.bench.cell.plant.on_step(self._step)

    def _step(self, dt: float) -> None:
        cell = self.bench.cell
        self._track.append((cell.clock.now(), cell.world.joint_angles()))
        for item in list(self._due):
            if cell.clock.now() >= item[0]:
                self._due.remove(item)
                item[1]()

    def move(self, number: int) -> Trajectory:
        """The next move to interrupt, the arm at its start."""
        arm, rng = self.bench.arm, self.rng
        arm.clear_stop()
        arm.follow(self.planner.home(arm.state().positions))
        thing = part(PARTS[number % 5], 38.0, at(rng.uniform(160, 250), rng.uniform(-45, 45)), rng.uniform(0, 6))
        box = self.planner.bins[number % len(self.planner.bins)]
        plan = self.planner.plan_pick(thing, (), box, box.center, arm.state().positions, pile=0.0)
        if number % 2:
            arm.follow(plan.approach)
            return plan.carry
        return plan.approach

    def run(self, move: Trajectory, actions: list[tuple[float, Callable[[], None]]]) -> Found:
        """Follow a move and let things happen so many seconds after its start; what the first did."""
        cell = self.bench.cell
        began = cell.clock.now()
        self._track.clear()
        self._due = [(began + after, action) for after, action in actions]
        self.bench.arm.follow(move)
        cell.clock.sleep(0.5)
        times = np.array([at for at, _ in self._track]) - began
        tool = points(RX150, np.array([q for _, q in self._track]))[:, 3]
        share = np.linspace(0.0, 1.0, 5)[:4, None, None]
        fine = np.swapaxes(move.positions[:-1] + share * np.diff(move.positions, axis=0), 0, 1)
        path = points(RX150, fine.reshape(-1, len(RX150.joints)))[:, 3]
        first = int(np.searchsorted(times, actions[0][0]))
        last = int(np.searchsorted(times, actions[1][0])) if len(actions) > 1 else len(tool)
        rest = tool[last - 1]
        nearest = int(np.linalg.norm(path - rest, axis=1).argmin())
        ahead = path[nearest] - path[max(nearest - 4, 0)]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        speeds = np.linalg.norm(np.diff(tool[first:last], axis=0), axis=1) / 0.002
        moving = np.flatnonzero(speeds > SPEED)
        return Found(
            past=float(((tool[first:last] - rest) @ ahead).max()),
            off_path=float(max(np.linalg.norm(path - place, axis=1).min() for place in tool[first:last:10])),
            way=float(np.linalg.norm(rest - tool[first])),
            standing=float(moving[-1]) * 0.002 if len(moving) else 0.0,
            end=float(np.linalg.norm(tool[-1] - path[-1])),
        )

    def moment(self, move: Trajectory) -> float:
        """When to interrupt a move, s."""
        return float(self.rng.uniform(0.1, move.duration - 0.1))


@contextmanager
def stalled(interrupted: Interrupted, seconds: float) -> Iterator[Callable[[], None]]:
    """An action after which the sender's next sleep takes so much longer."""
    clock = interrupted.bench.cell.clock
    sleep, pending = clock.sleep, [0.0]

    def longer(wait: float) -> None:
        extra, pending[0] = pending[0], 0.0
        sleep(wait + extra)

    def stall() -> None:
        pending[0] = seconds

    clock.sleep = longer  # type: ignore[assignment, method-assign]  # the process is held up where it sleeps
    try:
        yield stall
    finally:
        clock.sleep = sleep  # type: ignore[method-assign]


def study(moves: int, seed: int) -> dict[str, list[Found]]:
    """Interrupt moves in three ways."""
    interrupted = Interrupted(seed)
    arm = interrupted.bench.arm
    found: dict[str, list[Found]] = {"stop": [], "pause 0.5 s": [], "stall 200 ms": []}
    for number in range(moves):
        move = interrupted.move(number)
        found["stop"].append(interrupted.run(move, [(interrupted.moment(move), arm.request_stop)]))
    for number in range(moves):
        move = interrupted.move(number)
        at_ = interrupted.moment(move)
        found["pause 0.5 s"].append(interrupted.run(move, [(at_, arm.pause), (at_ + 0.5, arm.resume)]))
    with stalled(interrupted, 0.2) as stall:
        for number in range(moves):
            move = interrupted.move(number)
            at_ = interrupted.moment(move)
            found["stall 200 ms"].append(interrupted.run(move, [(at_, stall), (at_ + 0.2, lambda: None)]))
    return found


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moves", type=int, default=20)
    parser.add_argument("--seed", type=int, default=11)
    options = parser.parse_args()
    print(f"{options.moves} moves each; median / worst")
    for name, rows in study(options.moves, options.seed).items():
        past, off, way, still, end = (
            f"{np.median(values):.1f} / {np.max(values):.1f}"
            for values in (
                [row.past for row in rows],
                [row.off_path for row in rows],
                [row.way for row in rows],
                [1e3 * row.standing for row in rows],
                [row.end for row in rows],
            )
        )
        text = f"{name:13} past rest {past} mm, off path {off} mm, way {way} mm, stands after {still} ms"
        print(text + ("" if name == "stop" else f", end off by {end} mm"))


if __name__ == "__main__":
    main()

"""How an arm stops, pauses and goes on in physics whose masses and gains are off by up to 10 %.

Moves of picks at full speed, at half of it and with a load in the hand, interrupted at random moments: by a stop, by a
pause of half a second, by a sender that stalls for 200 ms. Printed: when after the order the first goal slower than
planned is on the wire and when the last that moves, how far the tool swings past where it comes to rest, how far off
its path it is, the way and the time it takes to stand, the largest share of its stall torque that a servo is asked for,
and where the move ends that was interrupted.

    python -m tests.benchmarks.stopping [--arm NAME]... [--moves N] [--seed N]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from controller.domain import Array, Shape, Trajectory
from controller.geometry import invert, transform
from controller.motion.kinematics import points
from drivers.arm.conversions import CENTER_TICKS, TICKS_PER_RAD
from drivers.arm.streaming import Pace, Progress
from tests.benchmarks.identification import Bench
from tests.unit.motion.scene import ARMS, part

SPEED = 10.0  # mm/s below which the tool stands
LOAD = 0.05  # kg
JAWS = 45.0  # mm, as on a part: narrow enough for the bins
ORDERED, ENDED, SWING, ASTRAY, SWUNG = 0.050, 0.050, 2.0, 5.0, 10.0  # s, s, mm, mm, mm: what is wanted at most
_TICK = 0.5 / TICKS_PER_RAD  # rad: goals nearer than this to the plan are as planned


@dataclass(frozen=True)
class Found:
    """What one interruption did: mm, s, and the share of its stall torque that `joint` was asked for."""

    past: float
    off_path: float
    way: float
    standing: float
    end: float
    slower: float
    last: float
    torque: float
    joint: str


class Interrupted:
    """An arm whose moves are interrupted.

    Args:
        name: Which arm.
        seed: Of its masses and gains, and of its moves.
        speed: Share of the joints' speeds that moves are planned with.
        load: Mass in its hand, kg; when there is one, moves are those that carry it.
    """

    def __init__(self, name: str, seed: int, speed: float = 1.0, load: float = 0.0) -> None:
        self.bench = Bench(seed, 0.1, 0.1, name, load)
        self.planner = self.bench.planner(speed, load)
        self.rng = np.random.default_rng(seed)
        self._load = load
        self._due: list[tuple[float, Callable[[], None]]] = []
        self._track: list[tuple[float, Array]] = []
        self.bench.arm.grip(JAWS)
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
        area = self.bench.config.table.work_area
        arm.clear_stop()
        arm.follow(self.planner.home(arm.state().positions))
        radius = rng.uniform(area.inner_radius_mm + 10.0, area.outer_radius_mm - 10.0)
        azimuth = np.radians(rng.uniform(-45.0, 45.0))
        place = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), 0.0])
        x, y, _ = transform(invert(self.bench.config.table.T_base_table()), place)
        thing = part(Shape.CIRCLE, 38.0, (x, y))
        box = self.planner.bins[number % len(self.planner.bins)]
        plan = self.planner.filled({box.name: 0.0}).plan_pick(thing, (), box, box.center, arm.state().positions)
        if number % 2 or self._load:
            arm.follow(plan.approach)
            return plan.carry
        return plan.approach

    def run(self, move: Trajectory, actions: list[tuple[float, Callable[[], None]]]) -> Found:
        """Follow a move and let things happen so many seconds after its start; what the first did."""
        cell, kind = self.bench.cell, self.bench.kind
        began = cell.clock.now()
        self._track.clear()
        self.bench.stream.goals.clear()
        self._due = [(began + after, action) for after, action in actions]
        before = self.bench.arm._body.goals  # what the move's first goals are blended in from
        self.bench.arm.follow(move)
        slower, last_goal = self._on_the_wire(move, before, began + actions[0][0])
        torque, joint = self._torque(began + actions[0][0])
        cell.clock.sleep(0.5)
        times = np.array([at for at, _ in self._track]) - began
        tool = points(kind, np.array([q for _, q in self._track]))[:, 3]
        share = np.linspace(0.0, 1.0, 5)[:4, None, None]
        fine = np.swapaxes(move.positions[:-1] + share * np.diff(move.positions, axis=0), 0, 1)
        path = points(kind, fine.reshape(-1, len(kind.joints)))[:, 3]
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
            slower=slower,
            last=last_goal,
            torque=torque,
            joint=joint,
        )

    def _told(self) -> tuple[Array, Array]:
        """When the joints' goals were sent (N,), s, and what they were (N, J), rad."""
        ids = [joint.servo_id for joint in self.bench.kind.joints]
        sent = [(at_, [goals[i] for i in ids]) for at_, goals in self.bench.stream.goals if ids[0] in goals]
        ticks = np.array([goals for _, goals in sent])
        return np.array([at_ for at_, _ in sent]), (ticks - CENTER_TICKS) / TICKS_PER_RAD

    def _torque(self, asked: float) -> tuple[float, str]:
        """The largest share of its stall torque that a servo is asked for from the order on, and which it is."""
        times, told = self._told()
        moments = np.array([at_ for at_, _ in self._track])
        joints = np.array([q for _, q in self._track])
        first = int(np.searchsorted(moments, max(asked, times[0])))
        latest = np.searchsorted(times, moments[first:], side="right") - 1
        share = (np.abs(told[latest] - joints[first:]) / self.bench.arm._body.stall).max(axis=0)
        worst = int(share.argmax())
        return float(share[worst]), self.bench.kind.joints[worst].name

    def _on_the_wire(self, move: Trajectory, before: Array, asked: float) -> tuple[float, float]:
        """When after the order the first goal behind the plan was sent, and the last that moved on, s."""
        times, told = self._told()
        # Another sender of the same move that nobody stops.
        undisturbed = Progress(move, before, self.bench.arm._body.stall)
        planned = []
        for gap in np.diff(times, append=times[-1] + move.period):
            planned.append(undisturbed.goals)
            undisturbed.advance(float(gap), Pace.GO)
        behind = np.abs(told - np.array(planned)).max(axis=1) > 2.0 * _TICK
        first = times[behind & (times >= asked)]
        stays = np.abs(np.diff(told, axis=0)).max(axis=1) < 2.0 * _TICK
        moved = times[1:][~stays & (times[1:] > asked)]
        return (float(first[0]) if len(first) else asked) - asked, (float(moved[-1]) if len(moved) else asked) - asked

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


def stops(name: str, moves: int, seed: int, speed: float = 1.0, load: float = 0.0) -> list[Found]:
    """Stop moves planned at a share of the joints' speeds, a mass (kg) in the hand."""
    interrupted = Interrupted(name, seed, speed, load)
    found = []
    for number in range(moves):
        move = interrupted.move(number)
        found.append(interrupted.run(move, [(interrupted.moment(move), interrupted.bench.arm.request_stop)]))
    return found


def pauses(name: str, moves: int, seed: int) -> list[Found]:
    """Hold moves for half a second."""
    interrupted = Interrupted(name, seed)
    arm = interrupted.bench.arm
    found = []
    for number in range(moves):
        move = interrupted.move(number)
        at_ = interrupted.moment(move)
        found.append(interrupted.run(move, [(at_, arm.pause), (at_ + 0.5, arm.resume)]))
    return found


def stalls(name: str, moves: int, seed: int) -> list[Found]:
    """Hold the sender of moves up for 200 ms."""
    interrupted = Interrupted(name, seed)
    found = []
    with stalled(interrupted, 0.2) as stall:
        for number in range(moves):
            move = interrupted.move(number)
            at_ = interrupted.moment(move)
            found.append(interrupted.run(move, [(at_, stall), (at_ + 0.2, lambda: None)]))
    return found


def _spread(values: list[float], digits: int = 1) -> str:
    return f"{np.median(values):.{digits}f} / {np.max(values):.{digits}f}"


def _verdict(what: str, values: list[float], wanted: float, unit: str) -> bool:
    scale = 1e3 if unit == "ms" else 1.0
    worst = max(values)
    good = worst <= wanted
    within = sum(value <= wanted for value in values)
    print(
        f"{what}: worst {scale * worst:.1f} {unit}, wanted {scale * wanted:.0f}, {within} of {len(values)} within: "
        f"{'pass' if good else 'FAIL'}"
    )
    return good


def study(name: str, moves: int, seed: int) -> dict[str, list[Found]]:
    """Interrupt one arm in every way and print what happens."""
    studies = {
        "stop": stops(name, moves, seed),
        "stop, half speed": stops(name, moves, seed, speed=0.5),
        "stop, loaded": stops(name, moves, seed, load=LOAD),
        "pause 0.5 s": pauses(name, moves, seed),
        "stall 200 ms": stalls(name, moves, seed),
    }
    print(f"{name}, seed {seed}, {moves} moves each; median / worst")
    for what, rows in studies.items():
        text = f"  {what:16} past rest {_spread([row.past for row in rows])} mm"
        text += f", off path {_spread([row.off_path for row in rows])} mm, way {_spread([row.way for row in rows])} mm"
        text += f", stands after {_spread([1e3 * row.standing for row in rows], 0)} ms"
        hardest = max(rows, key=lambda row: row.torque)
        text += f", torque {_spread([row.torque for row in rows], 2)} of stall ({hardest.joint})"
        if what.startswith("stop"):
            text += f"; on the wire: slower after {_spread([1e3 * row.slower for row in rows], 0)} ms"
            text += f", last moving goal after {_spread([1e3 * row.last for row in rows], 0)} ms"
        else:
            text += f", end off by {_spread([row.end for row in rows])} mm"
        print(text)
    return studies


def main() -> int:
    """Print the figures and verdicts; 1 when something wanted is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", action="append", choices=ARMS, metavar="NAME", help="one of them; all when not given")
    parser.add_argument("--moves", type=int, default=20)
    parser.add_argument("--seed", type=int, default=11)
    options = parser.parse_args()
    arms = [study(name, options.moves, options.seed) for name in options.arm or ARMS]
    stopped = [row for studies in arms for what in studies if what.startswith("stop") for row in studies[what]]
    stalled_ = [row for studies in arms for row in studies["stall 200 ms"]]
    good = [
        _verdict("stop: the order to slow down is on the wire after", [r.slower for r in stopped], ORDERED, "ms"),
        _verdict("stop: the last goal that moves is on the wire after", [r.last for r in stopped], ENDED, "ms"),
        _verdict("stop: the tool swings past its rest by", [r.past for r in stopped], SWING, "mm"),
        _verdict("stop: the tool leaves its path by", [r.off_path for r in stopped], ASTRAY, "mm"),
        _verdict("stall of 200 ms: the tool swings past its rest by", [r.past for r in stalled_], SWUNG, "mm"),
    ]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())

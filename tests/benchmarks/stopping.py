"""How the arm stops, pauses and goes on in physics whose masses and gains are off by up to 10 %.

Moves of picks at full speed and at half of it, interrupted at random moments: by a stop, by a pause of half a second,
by a sender that stalls for 200 ms. Printed: when after the order the first goal slower than planned is on the wire and
when the last that moves, how far the tool swings past where it comes to rest, how far off its path it is, the way and
the time it takes to stand, and where the move ends that was interrupted.

Then the process that moves the arm is killed in mid-move: it talks over a pseudo-terminal to a bus in another process,
in real time, and all times are those of the servos' own clock.

    python -m tests.benchmarks.stopping [--moves N] [--kills N] [--seed N]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from controller.domain import Array, Trajectory
from controller.motion.kinematics import points
from controller.motion.path import join, line
from controller.motion.planner import Planner
from controller.motion.trajectory import generate
from controller.service.manual import by_ruler
from drivers.arm.conversions import TICKS_PER_RAD
from drivers.arm.dynamixel import DynamixelArm
from drivers.arm.serial_stream import SerialStream
from drivers.arm.streaming import Progress
from sim_backends.virtual_dynamixel.pty import PtyBus
from tests.benchmarks.bus_speed import WallClock
from tests.benchmarks.identification import CELL, Bench
from tests.unit.motion.scene import PARTS, RX150, at, part

SPEED = 10.0  # mm/s below which the tool stands
ORDERED, ENDED, KILLED, SWING = 0.050, 0.050, 0.250, 5.0  # s, s, s, mm: what is wanted
_TICK = 0.5 / TICKS_PER_RAD  # rad: goals nearer than this to the plan are as planned


@dataclass(frozen=True)
class Found:
    """What one interruption did: mm and s."""

    past: float
    off_path: float
    way: float
    standing: float
    end: float
    slower: float
    last: float


class Interrupted:
    """An arm whose moves are interrupted."""

    def __init__(self, seed: int, speed: float = 1.0) -> None:
        self.bench = Bench(seed, 0.1, 0.1)
        self.planner = Planner(RX150, by_ruler(CELL), CELL.bin_values(), speed=speed)
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
        self.bench.stream.goals.clear()
        self._due = [(began + after, action) for after, action in actions]
        before = self.bench.arm._body.goals  # what the move's first goals are blended in from
        self.bench.arm.follow(move)
        slower, last_goal = self._on_the_wire(move, before, began + actions[0][0])
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
            slower=slower,
            last=last_goal,
        )

    def _on_the_wire(self, move: Trajectory, before: Array, asked: float) -> tuple[float, float]:
        """When after the order the first goal behind the plan was sent, and the last that moved on, s."""
        ids = [joint.servo_id for joint in RX150.joints]
        sent = [(at_, [goals[i] for i in ids]) for at_, goals in self.bench.stream.goals if ids[0] in goals]
        times = np.array([at_ for at_, _ in sent])
        told = (np.array([ticks for _, ticks in sent]) - 2048.0) / TICKS_PER_RAD
        # Another sender of the same move that nobody stops.
        undisturbed = Progress(move, before, self.bench.arm._body.full_speeds)
        planned = []
        for gap in np.diff(times, append=times[-1] + move.period):
            planned.append(undisturbed.goals)
            undisturbed.advance(float(gap), stopping=False)
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


def stops(moves: int, seed: int, speed: float) -> list[Found]:
    """Stop moves planned at a share of the joints' speeds."""
    interrupted = Interrupted(seed, speed)
    found = []
    for number in range(moves):
        move = interrupted.move(number)
        found.append(interrupted.run(move, [(interrupted.moment(move), interrupted.bench.arm.request_stop)]))
    return found


def pauses(moves: int, seed: int) -> list[Found]:
    """Hold moves for half a second."""
    interrupted = Interrupted(seed)
    arm = interrupted.bench.arm
    found = []
    for number in range(moves):
        move = interrupted.move(number)
        at_ = interrupted.moment(move)
        found.append(interrupted.run(move, [(at_, arm.pause), (at_ + 0.5, arm.resume)]))
    return found


def stalls(moves: int, seed: int) -> list[Found]:
    """Hold the sender of moves up for 200 ms."""
    interrupted = Interrupted(seed)
    found = []
    with stalled(interrupted, 0.2) as stall:
        for number in range(moves):
            move = interrupted.move(number)
            at_ = interrupted.moment(move)
            found.append(interrupted.run(move, [(at_, stall), (at_ + 0.2, lambda: None)]))
    return found


@dataclass(frozen=True)
class Death:
    """What a killed mover left.

    Attributes:
        heard: When the servos heard its last order, s after it was killed.
        tripped: When the watchdog of every joint had stopped it.
        standing: When the tool stood. Later than that: a servo that is stopped holds where it stands, without the
            goal's lead against gravity, and takes up its sag.
        speed: Of the tool when the process was killed, mm/s.
    """

    heard: float
    tripped: float
    standing: float
    speed: float


def mover(path: str) -> None:
    """Swing the arm to and fro at full speed over the terminal at `path`, for ever."""
    arm = DynamixelArm(RX150, SerialStream(path), WallClock())
    arm.open()
    ready = np.array(RX150.ready) - [0.0, 0.0, 0.0, 0.2, 0.0]  # room for the lead of the goals
    arm.energise()
    arm.follow(Planner(RX150, by_ruler(CELL), CELL.bin_values()).home(arm.state().positions))
    far = ready + np.array([1.2, 0.3, -0.3, -0.4, 0.6])
    print("swinging", flush=True)
    while True:
        for goal in (far, ready):
            way = join(RX150, [line(RX150, arm.state().positions, goal)], [])
            arm.follow(generate(RX150, way, "swing"))


def kill(seed: int) -> Death:
    """Kill a process that moves the arm, and look what the servos do."""
    bench = Bench(seed, 0.1, 0.1)
    bench.arm.close()
    rng = np.random.default_rng([seed, 9])
    track: list[tuple[float, float, bool]] = []
    before: list[Array] = []
    servos = [bench.bus.servo(joint.servo_id) for joint in RX150.joints]

    def note(dt: float) -> None:
        tool = points(RX150, bench.cell.world.joint_angles()[None])[0, 3]
        speed = float(np.linalg.norm(tool - before[-1])) / dt if before else 0.0
        before[:] = [tool]
        tripped = all(servo.table.get("Bus_Watchdog") == -1 for servo in servos)
        track.append((bench.cell.clock.now(), speed, tripped))

    bench.cell.plant.on_step(note)
    pause = threading.Event()
    with PtyBus(bench.bus) as pty:
        command = [sys.executable, "-m", "tests.benchmarks.stopping", "--mover", pty.path]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            try:
                assert process.stdout.readline() == b"swinging\n"
                pause.wait(float(rng.uniform(0.5, 1.5)))
                for _ in range(2000):  # in mid-move, not at its ends
                    if pty.call(lambda: track[-1][1]) > 300.0:
                        break
                    pause.wait(0.005)
            finally:
                killed = time.monotonic()
                process.kill()
        heard = pty.plant_time(pty.last_heard)
        until = pty.plant_time(killed) + 1.0
        while pty.call(bench.cell.clock.now) < until:
            pause.wait(0.05)
        died = pty.plant_time(killed)
    after = [(at_ - died, speed, tripped) for at_, speed, tripped in track if at_ >= died]
    return Death(
        heard=heard - died,
        tripped=next((at_ for at_, _, tripped in after if tripped), np.inf),
        standing=max((at_ for at_, speed, _ in after if speed > SPEED), default=0.0),
        speed=after[0][1],
    )


def _spread(values: list[float], digits: int = 1) -> str:
    return f"{np.median(values):.{digits}f} / {np.max(values):.{digits}f}"


def _verdict(what: str, worst: float, wanted: float, unit: str) -> bool:
    scale = 1e3 if unit == "ms" else 1.0
    good = worst <= wanted
    print(f"{what}: {scale * worst:.1f} {unit}, wanted {scale * wanted:.0f} {unit}: {'pass' if good else 'FAIL'}")
    return good


def main() -> int:
    """Print the figures and verdicts; 1 when something wanted is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moves", type=int, default=20)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--mover", metavar="PATH", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.mover:
        mover(options.mover)
    print(f"{options.moves} moves each; median / worst")
    studies = {
        "stop": stops(options.moves, options.seed, 1.0),
        "stop, half speed": stops(options.moves, options.seed, 0.5),
        "pause 0.5 s": pauses(options.moves, options.seed),
        "stall 200 ms": stalls(options.moves, options.seed),
    }
    for name, rows in studies.items():
        text = f"{name:16} past rest {_spread([row.past for row in rows])} mm"
        text += f", off path {_spread([row.off_path for row in rows])} mm, way {_spread([row.way for row in rows])} mm"
        text += f", stands after {_spread([1e3 * row.standing for row in rows], 0)} ms"
        if name.startswith("stop"):
            text += f"; on the wire: slower after {_spread([1e3 * row.slower for row in rows], 0)} ms"
            text += f", last moving goal after {_spread([1e3 * row.last for row in rows], 0)} ms"
        else:
            text += f", end off by {_spread([row.end for row in rows])} mm"
        print(text)
    deaths = [kill(options.seed + number) for number in range(options.kills)]
    if deaths:
        print(f"{len(deaths)} kills at {_spread([d.speed for d in deaths], 0)} mm/s; ms after the kill:", end=" ")
        print(f"last order {_spread([1e3 * d.heard for d in deaths], 0)}", end=", ")
        print(f"watchdog {_spread([1e3 * d.tripped for d in deaths], 0)}", end=", ")
        print(f"tool stands {_spread([1e3 * d.standing for d in deaths], 0)}")
    every = [row for rows in (studies["stop"], studies["stop, half speed"]) for row in rows]
    good = [
        _verdict("stop: the order to slow down is on the wire after", max(r.slower for r in every), ORDERED, "ms"),
        _verdict("stop from full speed: the last goal that moves", max(r.last for r in studies["stop"]), ENDED, "ms"),
        _verdict("stop: swings past its rest by", max(r.past for r in every), SWING, "mm"),
        _verdict("stall of 200 ms: swings past its rest by", max(r.past for r in studies["stall 200 ms"]), 10.0, "mm"),
    ]
    if deaths:
        worst = max(d.tripped for d in deaths)
        good.append(_verdict("killed: every servo has stopped by its own watchdog after", worst, KILLED, "ms"))
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())

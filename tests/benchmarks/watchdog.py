"""How the servos stop when the process that moves them is killed in mid-move: by their own watchdog.

The process talks over a pseudo-terminal to a bus in another process, in real time, and all times are those of the
servos' own clock. The arm is a physics one whose masses and gains are off by up to 10 %.

    python -m tests.benchmarks.watchdog [--kills N] [--seed N]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
import time
from dataclasses import dataclass

import numpy as np

from controller.cli.config import default_config
from controller.config.cell import load_cell
from controller.domain import Array
from controller.motion.kinematics import points
from controller.motion.path import join, line
from controller.motion.planner import Planner
from controller.motion.trajectory import generate
from controller.service.manual import by_ruler
from drivers.arm.dynamixel import DynamixelArm
from drivers.arm.serial_stream import SerialStream
from sim_backends.virtual_dynamixel.pty import PtyBus
from tests.benchmarks.bus_speed import WallClock
from tests.benchmarks.identification import Bench
from tests.unit.motion.scene import RX150

SPEED = 10.0  # mm/s below which the tool stands
TRIPPED = 0.250  # s, what is wanted at most


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
    cell = load_cell(default_config())
    arm.follow(Planner(RX150, by_ruler(cell), cell.bin_values()).home(arm.state().positions))
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
        command = [sys.executable, "-m", "tests.benchmarks.watchdog", "--mover", pty.path]
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


def _spread(values: list[float], scale: float = 1.0) -> str:
    return f"{scale * np.median(values):.0f} / {scale * np.max(values):.0f}"


def main() -> int:
    """Print the figures and the verdict; 1 when it fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--mover", metavar="PATH", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.mover:
        mover(options.mover)
    deaths = [kill(options.seed + number) for number in range(options.kills)]
    print(f"{len(deaths)} kills at {_spread([d.speed for d in deaths])} mm/s; median / worst, ms after it:", end=" ")
    print(f"last order {_spread([d.heard for d in deaths], 1e3)}", end=", ")
    print(f"watchdog {_spread([d.tripped for d in deaths], 1e3)}", end=", ")
    print(f"tool stands {_spread([d.standing for d in deaths], 1e3)}")
    worst = max(d.tripped for d in deaths)
    good = worst <= TRIPPED
    print(f"killed: every servo has stopped by its own watchdog after {1e3 * worst:.1f} ms", end=", ")
    print(f"wanted {1e3 * TRIPPED:.0f} ms: {'pass' if good else 'FAIL'}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())

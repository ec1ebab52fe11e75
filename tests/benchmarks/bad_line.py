"""Ten thousand control cycles of an arm over a bad line: is a wrong value taken, does something move unasked?

An arm on the simulated servo bus, in simulated time, moves and grips while 1 % of the packets each are dropped (the
servos' and the host's), corrupted, truncated, preceded by noise, and late by up to 50 ms; half of the cycles with the
plain sync read, half with the fast one. The simulated servos keep what they have said, so that every value the driver
takes is compared bit by bit with the servo's own word to the question just asked. Goals on the wire must lie on the
path of the move under way, never go back, and never leap further than two late periods of it.

    python -m tests.benchmarks.bad_line [--cycles N] [--rate R] [--seed N]
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from controller.domain import Array, Trajectory
from controller.errors import ArmError
from drivers.arm.bus import Bus
from drivers.arm.conversions import TICKS_PER_RAD
from drivers.arm.protocol import Status
from sim_backends.virtual_dynamixel.faults import Fault, FaultInjector
from sim_backends.virtual_dynamixel.protocol import BROADCAST, unstuff
from tests.contract.arm_suite import STANDS, quintic
from tests.unit.drivers.bench import ArmBench

FAULTS = (Fault.DROP, Fault.CORRUPT, Fault.TRUNCATE, Fault.DELAY, Fault.NOISE, Fault.LOST)
MOVE = 1.0  # s
LATE_PERIODS = 2  # a late cycle advances the goals by at most so many
_AMPLITUDE = np.array([0.8, 0.6, -0.6, 0.3, 0.5])  # rad
_JAWS_MM = 1.0
_ROUNDING = 0.75  # ticks: half a tick each way, and what the blend of the first goals leaves


@dataclass(slots=True)
class Found:
    """What became of the cycles.

    Attributes:
        cycles: Goals sent to the joints.
        moves: Moves and grips begun.
        values: Answers the driver took.
        missed: Answers it did without.
        wrong: Answers it took that no servo had given to that question.
        outside: Exceptions that are none of the error tree.
        ended: Moves and grips that ended in a typed error, by its text.
        unasked: Ways in which something moved that was not told to.
        strayed: Largest distance of a goal from its path, ticks.
        leapt: Largest step of a goal, as a share of what two periods of the move may take.
        injected: How often each fault has struck.
    """

    cycles: int = 0
    moves: int = 0
    values: int = 0
    missed: int = 0
    wrong: int = 0
    outside: list[str] = field(default_factory=list)
    ended: Counter[str] = field(default_factory=Counter)
    unasked: list[str] = field(default_factory=list)
    strayed: float = 0.0
    leapt: float = 0.0
    injected: Counter[Fault] = field(default_factory=Counter)

    @property
    def holds(self) -> bool:
        """What was promised is so."""
        return not (self.wrong or self.outside or self.unasked)


class _Witness(FaultInjector):
    """Spoils packets, and remembers what the servos had put into them."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.packets: list[bytes] = []

    def on_status(self, servo_id: int, packet: bytes, arrival: float) -> tuple[float, bytes]:
        self.packets.append(packet)
        return super().on_status(servo_id, packet, arrival)

    def said(self, size: int) -> set[tuple[int, int, bytes]]:
        """(ID, error, data) of every answer since `packets` was cleared; `size` is that of a fast read's data."""
        found = set()
        for packet in self.packets:
            if packet[4] == BROADCAST:
                blocks = (packet[at : at + size + 4] for at in range(8, len(packet), size + 4))
                found |= {(block[1], block[0], block[2:-2]) for block in blocks}
            else:
                body = unstuff(packet[7:-2])
                assert body is not None
                found.add((packet[4], body[1], body[2:]))
        return found


def _compare(bus: Bus, witness: _Witness, found: Found) -> None:
    """From now on hold every answer the bus takes against what the servos said to that question."""
    line = bus._line
    ask, ask_all = line.ask, line.ask_all

    def checked_ask_all(servo_ids: Sequence[int], address: int, size: int, fast: bool) -> list[Status]:
        witness.packets.clear()
        padded = size + line._pad
        taken = ask_all(servo_ids, address, size, fast)
        said = witness.said(padded)
        found.values += len(taken)
        found.missed += len(servo_ids) - len(taken)
        found.wrong += sum((status.servo_id, status.error, status.data) not in said for status in taken)
        return taken

    def checked_ask(servo_id: int, instruction: int, parameters: bytes, size: int, latency: float) -> Status | None:
        witness.packets.clear()
        status = ask(servo_id, instruction, parameters, size, latency)
        if status is not None:
            found.values += 1
            found.wrong += (servo_id, status.error, status.data) not in witness.said(size)
        return status

    # The line's own methods are replaced: only there is it known which question an answer was taken for.
    line.ask_all = checked_ask_all  # type: ignore[method-assign]  # mypy wants no method replaced
    line.ask = checked_ask  # type: ignore[method-assign]  # the same


class Session:
    """An arm that goes to and fro over a bad line."""

    def __init__(self, seed: int, rate: float, fast: bool, found: Found) -> None:
        self.bench = ArmBench()
        self.found = found
        self._fast = fast
        witness = _Witness(seed)
        self.bench.bus.faults = witness
        self.bench.arm.open()
        self.bench.arm.energise()
        _compare(self.bench.arm.bus, witness, found)
        for fault in FAULTS:
            witness.set_rate(fault, rate)
        self.ends = [self.bench.positions()]
        self.ends.append(self.ends[0] + _AMPLITUDE)
        self._way = 0

    def run(self, cycles: int) -> None:
        """Move and grip until so many goals were sent."""
        bench, found = self.bench, self.found
        until = found.cycles + cycles
        while found.cycles < until:
            bench.arm.bus.fast = self._fast  # given up where it keeps failing, which is not what is asked here
            self._try(self._move)
            self._try(self._grip)
            self._rest()
            self._way += 1
        found.injected += bench.bus.faults.counts

    def _try(self, action: Callable[[], None]) -> None:
        self.found.moves += 1
        try:
            action()
        except ArmError as error:
            self.found.ended[str(error)] += 1
        except Exception as error:  # what nobody expects is what is looked for
            self.found.outside.append(f"{type(error).__name__}: {error}")

    def _move(self) -> None:
        bench, found = self.bench, self.found
        move = quintic(bench.arm.state().positions, self.ends[1 - self._way % 2], MOVE)
        bench.stream.goals.clear()
        try:
            report = bench.arm.follow(move)
        finally:
            told = np.array([list(goals.values()) for _, goals in bench.stream.goals if len(goals) > 1], np.float64)
            found.cycles += len(told)
            self._judge(move, told)
        off = float(np.abs(bench.positions() - move.positions[-1]).max())
        if not report.finished or off > STANDS:
            found.unasked.append(f"a move ended {off:.3f} rad off its goal")

    def _judge(self, move: Trajectory, told: Array) -> None:
        """All joints of a quintic share one law of time: its goals lie on a line, and go forward on it."""
        if not len(told):
            return
        found = self.found
        start = move.goals[0] * TICKS_PER_RAD + 2048.0
        way = (move.goals[-1] - move.goals[0]) * TICKS_PER_RAD
        share = (told - start) @ way / (way @ way)
        strayed = float(np.abs(told - start - share[:, None] * way).max())
        largest = LATE_PERIODS * float(np.abs(np.diff(move.goals, axis=0)).max()) * TICKS_PER_RAD
        steps = np.diff(told, axis=0)
        found.strayed = max(found.strayed, strayed)
        found.leapt = max(found.leapt, float(np.abs(steps).max(initial=0.0)) / largest)
        if strayed > 2.0 * _ROUNDING:
            found.unasked.append(f"a goal {strayed:.1f} ticks off its path")
        if np.abs(steps).max(initial=0.0) > largest + 2.0 * _ROUNDING:
            found.unasked.append(f"a goal leapt {np.abs(steps).max():.0f} ticks, {largest:.0f} are two periods")
        if (steps * np.sign(way)).min(initial=0.0) < -2.0 * _ROUNDING:
            found.unasked.append("goals went back")

    def _grip(self) -> None:
        bench, found = self.bench, self.found
        opening = (70.0, 35.0)[self._way % 2]
        report = bench.arm.grip(opening)
        if not report.finished or abs(report.opening - opening) > _JAWS_MM:
            found.unasked.append(f"jaws at {report.opening:.1f} mm, told {opening:.0f}")

    def _rest(self) -> None:
        """A fifth of a second without orders: nothing may move."""
        before = self.bench.positions()
        self.bench.clock.sleep(0.2)
        drift = float(np.abs(self.bench.positions() - before).max())
        if drift > STANDS:
            self.found.unasked.append(f"{drift:.3f} rad without an order")


def study(cycles: int, rate: float, seed: int) -> Found:
    """Half of the cycles with each kind of sync read."""
    found = Found()
    for fast in (False, True):
        Session(seed + fast, rate, fast, found).run(cycles // 2)
    return found


def main() -> int:
    """Print the counts and the verdict; 1 when a promise was broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycles", type=int, default=10_000)
    parser.add_argument("--rate", type=float, default=0.01)
    parser.add_argument("--seed", type=int, default=2000)
    options = parser.parse_args()
    found = study(options.cycles, options.rate, options.seed)
    struck = ", ".join(f"{fault} {found.injected[fault]}" for fault in FAULTS)
    print(f"{found.cycles} cycles in {found.moves} moves and grips; struck: {struck}")
    print(f"answers taken {found.values}, done without {found.missed}")
    print(f"goals: at most {found.strayed:.2f} ticks off their path, largest step {found.leapt:.2f} of two periods'")
    for text, count in found.ended.most_common():
        print(f"  ended {count} times: {text}")
    for what, broken in (
        ("no wrong value", [f"{found.wrong} wrong"] * bool(found.wrong)),
        ("no exception outside the error tree", found.outside),
        ("no unintended motion", found.unasked),
    ):
        print(f"{what}: {'pass' if not broken else 'FAIL: ' + '; '.join(broken[:5])}")
    return 0 if found.holds else 1


if __name__ == "__main__":
    sys.exit(main())

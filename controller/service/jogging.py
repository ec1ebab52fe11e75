"""Moving the arm by hand, one bounded step at a time, for as long as somebody is there.

Between the client (the terminal that the keys come from) and the motion loop runs a heartbeat: when it is missing for
200 ms the arm slows down along its path and holds, and what was still waiting to be done is forgotten.
"""

from __future__ import annotations

import contextlib
import math
import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic

import numpy as np

from controller.config.taught import moved, save_taught
from controller.cycle.preflight import check
from controller.domain import Array, Trajectory
from controller.errors import InputError, SorterError
from controller.motion.manual import ManualPlanner
from controller.motion.planner import Planner
from controller.service.manual import ManualCell

HEARTBEAT = 0.200
"""s of silence of the client after which the arm stops."""

LARGEST_STEP_MM = 50.0
LARGEST_STEP_DEG = 20.0
STEP_MM = 5.0
STEP_DEG = 2.0

_TICK = 0.02  # s between looks at the heartbeat
_ASTRAY = 0.04  # rad off where the last step ended: somebody or something has moved the arm since
_EFFORT = 0.5  # of the gripper's rated force
_GRAMMAR = "x+ 10 (mm; x, y, z), j1- 2 (deg; j1 is the waist), jaws 50 or jaws- 5 (mm), home, where, set BIN, stop, q"


class HeartbeatLost(SorterError):
    """The client was silent for too long; the arm holds."""


class DeadMan:
    """Stops the arm when the client falls silent.

    Args:
        stop: Called once when the heartbeat is lost, from the watching thread.

    Attributes:
        lost: The heartbeat was missing since the last `rearm`.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        self.lost = False
        self._stop = stop
        self._heard = threading.Event()
        self._silence = 0.0

    def beat(self) -> None:
        """The client is there; from its thread, at least every 100 ms."""
        self._heard.set()

    def tick(self, elapsed: float) -> None:
        """Look at the heartbeat, `elapsed` s after the last look.

        Time in which this very thread did not run counts as one late look at most: a process that is suspended
        streams nothing either, and the servos' own watchdog has stopped them.
        """
        if self._heard.is_set():
            self._heard.clear()
            self._silence = 0.0
            return
        self._silence += min(elapsed, 2.0 * _TICK)
        if self._silence + _TICK > HEARTBEAT and not self.lost:
            self.lost = True
            self._stop()

    def rearm(self) -> None:
        """Allow motion again after a loss.

        Raises:
            HeartbeatLost: The client is still silent.
        """
        if self._silence + _TICK > HEARTBEAT and not self._heard.is_set():
            raise HeartbeatLost("no sign of life from the terminal for 200 ms", "the arm holds; look at the connection")
        self.lost = False

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Look at the heartbeat every 20 ms in a thread, from its first beat on."""
        ended = threading.Event()

        def watch() -> None:
            while not self._heard.wait(_TICK):
                if ended.is_set():
                    return
            last = monotonic()
            while not ended.wait(_TICK):
                now = monotonic()
                self.tick(now - last)
                last = now

        thread = threading.Thread(target=watch, name="dead-man", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


@dataclass(frozen=True, slots=True)
class Command:
    """One thing to do.

    Attributes:
        what: `shift`, `turn`, `jaws` (to), `open` (by), `home`, `set`, `where`, `stop` or `quit`.
        index: Axis of `table` or joint, from 0.
        amount: mm or deg.
        name: Of a bin.
    """

    what: str
    index: int = 0
    amount: float = 0.0
    name: str = ""


_WORDS = {"home": "home", "where": "where", "w": "where", "stop": "stop", "q": "quit", "quit": "quit"}
_STEP = re.compile(r"(?:(?P<axis>[xyz])|j(?P<joint>[1-9])|(?P<jaws>jaws))\s*(?P<sign>[+-])\s*(?P<amount>\d*\.?\d*)")


def parse(line: str, joints: int) -> Command:
    """A line as a command, e.g. `x+ 10`, `j1- 2`, `jaws 40`, `set squares`, `q`.

    Args:
        line: What was typed.
        joints: How many joints the arm has.

    Raises:
        InputError: It makes no sense, or asks for more than one bounded step.
    """
    text = line.strip()
    if text.lower() in _WORDS:
        return Command(_WORDS[text.lower()])
    word, _, rest = text.partition(" ")
    if word == "set" and rest.strip():
        return Command("set", name=rest.strip())
    if word == "jaws":
        with contextlib.suppress(ValueError):
            if math.isfinite(opening := float(rest)):
                return Command("jaws", amount=opening)
    found = _STEP.fullmatch(text.lower())
    if found is None or found["amount"] == ".":
        raise InputError(f"{text!r} is no command", f"use {_GRAMMAR}")
    linear = found["joint"] is None
    default, largest, unit = (STEP_MM, LARGEST_STEP_MM, "mm") if linear else (STEP_DEG, LARGEST_STEP_DEG, "deg")
    size = float(found["amount"]) if found["amount"] else default
    if not 0.0 < size <= largest:
        raise InputError(f"{text}: a step is at most {largest:g} {unit}", "take several")
    amount = size if found["sign"] == "+" else -size
    if found["jaws"]:
        return Command("open", amount=amount)
    if linear:
        return Command("shift", "xyz".index(found["axis"]), amount)
    joint = int(found["joint"]) - 1
    if joint >= joints:
        raise InputError(f"{text}: this arm has {joints} joints", f"use j1 to j{joints}")
    return Command("turn", joint, amount)


class Jogger:
    """Carries commands out, one after the other.

    Args:
        cell: An arm that has torque.
        dead_man: Whoever stops it when the client falls silent.
        taught: The file that bins are taught into; None: bins cannot be taught.
    """

    def __init__(self, cell: ManualCell, dead_man: DeadMan, taught: Path | None) -> None:
        self.cell = cell
        self._dead_man = dead_man
        self._taught = taught
        self._posture: Array | None = None

    def do(self, command: Command) -> str:
        """Carry out a command; blocks, may move metal.

        Returns:
            What is to be said about it; empty when there is nothing but the new pose.

        Raises:
            PlanError: The step cannot be made, or the safety gate refuses it; nothing moved.
            ConfigError: A bin cannot be taught here.
            HeartbeatLost: The client is silent.
            ArmError: The arm failed.
        """
        if self._dead_man.lost:
            self._dead_man.rearm()
            self.cell.arm.clear_stop()
        match command.what:
            case "stop":
                self.cell.arm.clear_stop()
                return "stopped"
            case "set":
                return self._teach(command.name)
            case "jaws" | "open":
                now = self.cell.arm.state().opening if command.what == "open" else 0.0
                return "" if self.cell.arm.grip(now + command.amount, _EFFORT).finished else "stopped"
            case "home":
                return self._follow(self.cell.planner.home(self.cell.arm.state().positions))
            case "shift" | "turn":
                return self._step(command)
        return ""

    def _step(self, command: Command) -> str:
        state = self.cell.arm.state()
        posture = self._where(state.positions)
        planner: ManualPlanner = self.cell.planner
        if command.what == "turn":
            move = planner.turned(posture, command.index, math.radians(command.amount), state.opening)
        else:
            move = planner.shifted(posture, command.amount * np.eye(3)[command.index], state.opening)
        return self._follow(move)

    def _follow(self, move: Trajectory) -> str:
        finished = self.cell.arm.follow(move).finished
        self._posture = np.array(move.positions[-1]) if finished else None
        return "" if finished else "stopped on the way"

    def _where(self, measured: Array) -> Array:
        """The posture to step from: where the last step was to end, so that sag does not add up step by step."""
        posture = self.cell.planner.posture(measured)
        if self._posture is None or float(np.abs(posture - self._posture).max()) > _ASTRAY:
            self._posture = posture
        return self._posture

    def _teach(self, name: str) -> str:
        if self._taught is None:
            raise InputError("no file to teach bins into", "name one with --bins FILE")
        posture = self.cell.planner.posture(self.cell.arm.state().positions)
        x, y = (float(value) for value in self.cell.planner.tool(posture)[:2])
        self.cell = teach(self.cell, name, (x, y), self._taught)
        return f"{name} stands at {x:.1f}, {y:.1f} mm"


def teach(cell: ManualCell, name: str, center: tuple[float, float], path: Path) -> ManualCell:
    """Write down that a bin of the configuration stands elsewhere (mm, `table`), and keep clear of it there.

    Raises:
        ConfigError: There is no such bin, the arm cannot put parts into it there, or the file cannot be written.
    """
    config = moved(cell.config, name, (round(center[0], 2), round(center[1], 2)))
    arm = cell.planner.arm
    check(config, arm, Planner(arm, cell.calibration, config.bin_values()))
    save_taught(path, name, center)
    planner = ManualPlanner(arm, cell.calibration, config.bin_values())
    return replace(cell, config=config, planner=planner)

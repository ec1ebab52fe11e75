"""Faults by script: what goes wrong in a simulated cell, and when; the same again for the same script and seed.

A script is a TOML file of `[[fault]]` tables. Each names a `fault` and when it strikes: `at_s` after the work began,
or `on = { state = "PICK" }` or `on = { failpoint = "after_intend" }`, there with `occurrence` (1 is the first time)
and `delay_s`; and `duration_s`, without which it lasts for ever.
"""

from __future__ import annotations

import math
import os
import signal
import tomllib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from controller.errors import ConfigError
from sim_backends.faulty_camera import CameraFault, FaultyCamera
from sim_backends.virtual_dynamixel import Fault, VirtualBus
from sim_backends.world import World

STATES = ("HOMING", "CAPTURE", "DETECT", "LOCALIZE", "PICK", "PLACE", "IDLE", "HELD")
FAILPOINTS = tuple(f"{when}_{what}" for what in ("intend", "conclude") for when in ("before", "after"))
_GARBAGE = 0.05
"""Share of the servos' answers that come damaged: a loose plug, not a cut cable."""
_NOISE = 0.03
"""Share of them on a line that is merely bad; about half of them are lost for good, clearly more than is tolerated."""
_WEAK_SUPPLY = 10.3
"""V: the servos still work, and warn of nothing."""

_CAMERA = {
    "camera_lost": "lost",
    "camera_stalled": "stalled",
    "camera_failed": "failed",
    "picture_frozen": "frozen",
    "picture_black": "black",
    "picture_overexposed": "overexposed",
    "picture_torn": "torn",
    "picture_light": "dimmed",
    "picture_soft": "blurred",
    "picture_moved": "moved",
    "picture_covered": "covered",
    "light_drifting": "dimming",
    "pictures_damaged": "ragged",
    "intruder": "reached_over",
    "part_unknown": "strange",
}
_SERVO = {
    "servo_overload": Fault.OVERLOAD,
    "servo_shock": Fault.SHOCK,
    "servo_overheat": Fault.OVERHEAT,
    "servo_undervoltage": Fault.UNDERVOLTAGE,
    "servo_encoder": Fault.ENCODER,
    "servo_rebooted": Fault.REBOOT,
    "bus_timeout": Fault.SILENT,
}
FAULTS = frozenset({
    *_CAMERA, *_SERVO, "bus_corrupt", "bus_noisy", "bus_lost", "supply_low", "motion_timeout", "part_held",
    "part_lost", "grasp_missed", "ledger_unwritable", "power_lost",
})  # fmt: skip
"""What can be scripted, by the codes of the fault catalogue."""


_DAY = 86_400.0
_LONGEST = {"at_s": _DAY, "occurrence": 1_000_000, "delay_s": _DAY, "duration_s": math.inf, "servo": 252}


@dataclass(frozen=True, slots=True)
class ScriptedFault:
    """One fault of a script.

    Attributes:
        fault: One of `FAULTS`.
        at: s after the work began; None when it waits for `point`.
        point: A state of the cell or a failpoint.
        occurrence: At which time `point` is reached.
        delay: s after that.
        duration: s.
        servo: ID of the servo it befalls; None is the second joint, which carries the arm.
    """

    fault: str
    at: float | None = None
    point: str | None = None
    occurrence: int = 1
    delay: float = 0.0
    duration: float = math.inf
    servo: int | None = None


def load_script(path: Path) -> tuple[ScriptedFault, ...]:
    """Read a script.

    Raises:
        ConfigError: It cannot be read, or says what cannot be done; names file and fault.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: {error}", "see the examples in configs/faults") from error
    rows = tables.pop("fault", [])
    if tables or not isinstance(rows, list) or not rows:
        raise ConfigError(f"{path}: holds something else than [[fault]] tables", "see the examples in configs/faults")
    return tuple(_parse(row, f"{path}: fault {number}") for number, row in enumerate(rows, 1))


def _parse(row: Any, where: str) -> ScriptedFault:
    if not isinstance(row, dict):
        raise ConfigError(f"{where}: not a [[fault]] table", "see the examples in configs/faults")
    on = row.get("on", {})
    known = {"fault", "at_s", "on", "duration_s", "servo"}, {"state", "failpoint", "occurrence", "delay_s"}
    for table, keys in ((row, known[0]), (on, known[1])):
        unknown = set(table) - keys if isinstance(table, dict) else {"on"}
        if unknown:
            raise ConfigError(f"{where}: unknown key {sorted(unknown)[0]!r}", f"keys: {', '.join(sorted(keys))}")
    name, at = row.get("fault"), row.get("at_s")
    if not isinstance(name, str) or name not in FAULTS:
        raise ConfigError(f"{where}: there is no fault {name!r}", f"faults: {', '.join(sorted(FAULTS))}")
    points = [on[key] for key in ("state", "failpoint") if key in on]
    if (at is None) + (len(points) != 1) != 1 or (at is not None and on):
        raise ConfigError(f"{where}: when is not clear", "give either at_s, or on with a state or a failpoint")
    if points and points[0] not in (STATES if "state" in on else FAILPOINTS):
        raise ConfigError(
            f"{where}: the cycle has no {points[0]!r}",
            f"states: {', '.join(STATES)}; failpoints: {', '.join(FAILPOINTS)}",
        )
    numbers = {"at_s": 0.0 if at is None else at, "duration_s": row.get("duration_s", math.inf)}
    numbers |= {"occurrence": on.get("occurrence", 1), "delay_s": on.get("delay_s", 0.0), "servo": row.get("servo", 0)}
    for key, value in numbers.items():
        kind = int if key in ("occurrence", "servo") else int | float
        if isinstance(value, bool) or not isinstance(value, kind) or not 0 <= value <= _LONGEST[key]:
            remedy = f"give a {'whole ' if kind is int else ''}number from 0 to {_LONGEST[key]:g}"
            raise ConfigError(f"{where}: {key} is {value!r}", remedy)
    return ScriptedFault(
        name,
        None if at is None else float(at),
        points[0] if points else None,
        int(numbers["occurrence"]),
        float(numbers["delay_s"]),
        float(numbers["duration_s"]),
        row.get("servo"),
    )


class FaultDirector:
    """Lets a script's faults happen to a simulated cell.

    Args:
        script: What happens when.
        world: The mechanical world, which owns the time.
        bus: The servo bus.
        camera: The camera that can be made to fail.

    Attributes:
        ledger_unwritable: The disk takes no more.
        struck: (code, s after the work began) of every fault that has struck.
    """

    def __init__(
        self, script: tuple[ScriptedFault, ...], world: World, bus: VirtualBus, camera: FaultyCamera
    ) -> None:
        self._world, self._bus, self._camera = world, bus, camera
        self._waiting = list(script)
        self._due: list[tuple[float, Callable[[], None]]] = []
        self._next = math.inf
        self._began: float | None = None
        self._reached: Counter[str] = Counter()
        self.ledger_unwritable = False
        self.struck: list[tuple[str, float]] = []
        world.on_step(self._step)

    def entered(self, point: str) -> None:
        """The cell has come to a state or a failpoint; the first one begins the work."""
        now = self._world.now()
        if self._began is None:
            self._began = now
            for fault in self._waiting:
                if fault.at is not None:
                    self._plan(now + fault.at, fault)
        self._reached[point] += 1
        for fault in self._waiting:
            if fault.point == point and fault.occurrence == self._reached[point]:
                if fault.delay > 0.0:
                    self._plan(now + fault.delay, fault)
                else:
                    self.strike(fault)

    def add(self, script: tuple[ScriptedFault, ...]) -> None:
        """Let these happen too; what strikes at a time, only when it is added before the work begins."""
        self._waiting += script

    def forget(self) -> None:
        """What was to strike from now on does not."""
        self._waiting.clear()

    def repair(self) -> None:
        """Somebody has put everything right: plugs, supply, what is in the way.

        Servos that report an error and hold were switched off and on; a reset restarts those that have shut down.
        """
        self._camera.heal()
        self._bus.heal()
        self._bus.faults.set_rate(Fault.CORRUPT, 0.0)
        for servo_id in self._bus.servo_ids:
            self._world.shafts.block(servo_id, False)
            servo = self._bus.servo(servo_id)
            if servo.health.bits and servo.table.get("Torque_Enable"):
                self._bus.strike(Fault.REBOOT, servo_id)
        self.ledger_unwritable = False

    def strike(self, fault: ScriptedFault) -> None:
        """Let a fault happen now, for its duration."""
        now, world, bus = self._world.now(), self._world, self._bus
        self.struck.append((fault.fault, now - (self._began or 0.0)))
        end = now + fault.duration
        servo = bus.servo_ids[1] if fault.servo is None else fault.servo
        name = fault.fault
        if name in _CAMERA:
            self._camera.strike(CameraFault(_CAMERA[name], now, end))
        elif name in _SERVO:
            bus.strike(_SERVO[name], servo)
            self._at(end, bus.servo(servo).heal)
        elif name in ("bus_corrupt", "bus_noisy"):
            bus.faults.set_rate(Fault.CORRUPT, _GARBAGE if name == "bus_corrupt" else _NOISE)
            self._at(end, lambda: bus.faults.set_rate(Fault.CORRUPT, 0.0))
        elif name == "supply_low":
            bus.feed(_WEAK_SUPPLY)
            self._at(end, bus.heal)
        elif name == "bus_lost":
            bus.strike(Fault.DISCONNECT)
            self._at(end, lambda: setattr(bus, "connected", True))
        elif name in ("motion_timeout", "part_held"):
            blocked = servo if name == "motion_timeout" else world.arm.gripper.servo_id
            world.shafts.block(blocked, True)
            self._at(end, lambda: world.shafts.block(blocked, False))
        elif name == "part_lost":
            # What slips out of the jaws over a bin falls into it.
            if not world.over_bin(world.tool_pose()[:3, 3]):
                for part in world.held:
                    world.loose.lay_back(part)
        elif name == "grasp_missed":
            nearest = world.loose.nearest_to(world.tool_pose()[:3, 3])
            if nearest is not None:
                world.loose.take_away(nearest)
        elif name == "ledger_unwritable":
            self.ledger_unwritable = True
            self._at(end, lambda: setattr(self, "ledger_unwritable", False))
        else:
            os.kill(os.getpid(), signal.SIGKILL)

    # --- inside -------------------------------------------------------------------------------------------

    def _plan(self, at: float, fault: ScriptedFault) -> None:
        self._at(at, lambda: self.strike(fault))

    def _at(self, at: float, action: Callable[[], None]) -> None:
        if math.isfinite(at):
            self._due.append((at, action))
            self._next = min(self._next, at)

    def _step(self, dt: float) -> None:
        now = self._world.now()
        if now < self._next:
            return
        due = [action for at, action in self._due if at <= now]
        self._due = [(at, action) for at, action in self._due if at > now]
        self._next = min((at for at, _ in self._due), default=math.inf)
        for action in due:
            action()

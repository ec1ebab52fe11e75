"""An arm that does perfectly whatever it is told and writes it down: what a run would command, without metal.

Angles in the record are degrees, lengths mm, times s; they are rounded far below one step of an encoder
(0.088 deg), so that the same run gives the same record on every machine.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TextIO

import numpy as np

from controller.domain import ArmDescription, ArmState, Array, GripReport, MoveReport, Trajectory
from controller.errors import ArmError, InputError, LimitViolation
from controller.ports import Clock

Command = dict[str, object]
GripModel = Callable[[float, float], tuple[bool, float]]

# rad: a trajectory must begin where the arm stands; 0.01 rad is MoveIt's default start tolerance.
START_TOLERANCE = 0.01
# mm/s of clear opening: what an XL430 turns the crank with at half its no-load speed.
JAW_SPEED = 100.0
# s between looks at whether a paused move may go on.
_PAUSED_LOOK = 0.05


@dataclass(slots=True)
class _Failure:
    operation: str
    countdown: int
    error: Exception
    fraction: float


class RecordingArm:
    """Records every command as plain values and follows it without error.

    Not thread-safe but for `request_stop`, `pause` and `resume`, which may come from any thread or from `on_command`.

    Args:
        description: The arm it pretends to be; it starts at that arm's rest.
        clock: Advanced by the duration of every move.
        on_command: Called with each record when the command is given, before anything moves.
        grip_model: (opening before, wanted opening) -> (contact, settled opening), mm; by default there is
            nothing between the jaws.
    """

    def __init__(
        self,
        description: ArmDescription,
        clock: Clock,
        *,
        on_command: Callable[[Command], None] | None = None,
        grip_model: GripModel | None = None,
    ) -> None:
        self.commands: list[Command] = []
        self._description = description
        self._clock = clock
        self._on_command = on_command
        self._grip_model = grip_model or (lambda _before, wanted: (False, wanted))
        self._grips: list[tuple[bool, float]] = []
        self._failures: list[_Failure] = []
        self._positions: Array = np.array(description.rest, np.float64)
        self._velocities: Array = np.zeros(len(description.rest))
        self._opening = description.gripper.opening[0]
        self._load = 0.0
        self._open = False
        self._energised = False
        self._stop = False
        self._stop_recorded = False
        self._paused = self._waiting = False

    # --- the Arm port ---------------------------------------------------------------------------------

    @property
    def description(self) -> ArmDescription:
        """The arm it pretends to be."""
        return self._description

    def open(self, *, restart: bool = False) -> None:
        """Connect; torque stays off."""
        self._raise_due(self._due("open"))
        self._open = True

    def close(self) -> None:
        """Disconnect; harmless when not open. Torque is left as it is."""
        self._record_stop()
        self._open = False

    def energise(self) -> ArmState:
        """Torque on."""
        self._begin("energise")
        self._energised = True
        return self._state()

    def relax(self) -> None:
        """Torque off; the arm stays where it is."""
        self._begin("relax")
        self._energised = False

    def state(self) -> ArmState:
        """Where the commands have led so far."""
        self._need_open("state")
        self._raise_due(self._due("state"))
        return self._state()

    def follow(self, trajectory: Trajectory, opening: float | None = None, after: float = 0.0) -> MoveReport:
        """Record the trajectory, with what the jaws shall do meanwhile, and pass through it sample by sample.

        Raises:
            LimitViolation: It does not start where the arm stands; it is not recorded.
            ArmError: The arm is not open or has no torque.
        """
        self._need_torque("follow")
        self._check(trajectory)
        failure = self._begin(
            "follow",
            name=trajectory.name,
            duration_s=round(trajectory.duration, 6),
            from_deg=self._degrees(trajectory.positions[0]),
            to_deg=self._degrees(trajectory.positions[-1]),
            **({} if opening is None else {"opening_mm": round(self._within(opening), 3), "after_s": round(after, 3)}),
        )
        if opening is not None and not self._stop:
            self._opening = self._within(opening)
        last = len(trajectory.positions) - 1
        if failure is not None:
            last = int(last * failure.fraction)
        index = 0
        held = self._stop
        while index < last and self._may_move():
            self._clock.sleep(trajectory.period)
            index += 1
            step = trajectory.positions[index] - self._positions
            self._positions = np.array(trajectory.positions[index], np.float64)
            self._velocities = np.asarray(step / trajectory.period)
        self._velocities = np.zeros_like(self._positions)
        self._record_stop()
        self._raise_due(failure)
        return MoveReport(index == last and not held, self._state())

    def grip(self, opening: float, effort: float = 1.0) -> GripReport:
        """Record the command and settle where the script or the grip model says.

        Raises:
            ArmError: The arm is not open or has no torque.
            ValueError: `effort` is outside (0, 1].
        """
        self._need_torque("grip")
        if not 0.0 < effort <= 1.0:
            raise ValueError(f"effort {effort} is outside (0, 1]")
        wanted = self._within(opening)
        self._raise_due(self._begin("grip", opening_mm=round(wanted, 3), effort=round(effort, 3)))
        if not self._may_move():
            return GripReport(False, False, self._opening, self._load)
        contact, settled = self._grips.pop(0) if self._grips else self._grip_model(self._opening, wanted)
        self._clock.sleep(abs(settled - self._opening) / JAW_SPEED)
        # A part resists in the direction the jaws were moving.
        self._load = (effort if settled >= wanted else -effort) if contact else 0.0
        self._opening = settled
        return GripReport(True, contact, settled, self._load)

    def request_stop(self) -> None:
        """End the running move at its next sample; later ones end at once until `clear_stop`.

        Only a flag is set here, for a signal handler may call this while a record is being written; the stop is
        recorded as soon as the arm's own thread sees it.
        """
        self._stop = True

    def clear_stop(self) -> None:
        """Allow motion again."""
        self._record("clear_stop")
        self._stop = self._stop_recorded = False

    def pause(self) -> None:
        """Hold at the next sample of a move, or before the next move or grip."""
        self._paused = True

    def resume(self) -> None:
        """Go on from there."""
        self._paused = False

    @property
    def holds(self) -> bool:
        """A move or grip waits for `resume`."""
        return self._waiting

    # --- the script -----------------------------------------------------------------------------------

    def fail_on(self, operation: str, nth: int, error: Exception, *, fraction: float = 0.0) -> None:
        """Raise `error` at the nth next call of an operation.

        Args:
            operation: `open`, `state`, `energise`, `relax`, `follow` or `grip`.
            nth: 1 is the next call.
            error: What is raised.
            fraction: For `follow`: how much of the move is done before it fails, in [0, 1].
        """
        if operation not in {"open", "state", "energise", "relax", "follow", "grip"} or nth < 1:
            raise ValueError(f"there is no call {nth} of {operation!r}")
        self._failures.append(_Failure(operation, nth, error, fraction))

    def grip_result(self, *, contact: bool, opening: float) -> None:
        """Let the next grip that has no result yet settle at `opening` (mm), with or without contact."""
        self._grips.append((contact, opening))

    def assert_commands(self, expected: Sequence[Mapping[str, object]], fields: Sequence[str] = ()) -> None:
        """Fail with a readable difference unless exactly these commands were given in this order.

        Args:
            expected: The records.
            fields: Compare only these fields of each record; all by default.

        Raises:
            AssertionError: They differ.
        """
        want, got = ([_line(c, fields) for c in commands] for commands in (expected, self.commands))
        if want != got:
            lines = difflib.unified_diff(want, got, "expected", "commanded", lineterm="", n=2)
            raise AssertionError("\n".join(["the commands differ", *lines]))

    # --- inside ---------------------------------------------------------------------------------------

    def _within(self, opening: float) -> float:
        narrowest, widest = self._description.gripper.opening
        return min(max(opening, narrowest), widest)

    def _state(self) -> ArmState:
        return ArmState(
            self._clock.now(), self._positions.copy(), self._velocities.copy(), self._opening, self._load
        )

    def _degrees(self, positions: Array) -> dict[str, float]:
        # Adding 0.0 turns -0.0 into 0.0.
        degrees = np.round(np.degrees(positions), 4) + 0.0
        return dict(zip(self._description.joint_names, (float(d) for d in degrees), strict=True))

    def _need_open(self, operation: str) -> None:
        if not self._open:
            raise ArmError("recording arm", operation, "the arm is not open", "open it first")

    def _need_torque(self, operation: str) -> None:
        self._need_open(operation)
        if not self._energised:
            raise ArmError("recording arm", operation, "torque is off", "energise the arm first")

    def _check(self, trajectory: Trajectory) -> None:
        shape = trajectory.positions.shape
        if len(shape) != 2 or shape[0] < 1 or shape[1] != len(self._positions):
            raise LimitViolation(f"{trajectory.name}: {shape} samples do not fit {len(self._positions)} joints")
        off = np.abs(trajectory.positions[0] - self._positions)
        worst = int(np.argmax(off))
        if not off[worst] <= START_TOLERANCE:
            raise LimitViolation(
                f"{trajectory.name} starts {np.degrees(off[worst]):.1f} deg from where"
                f" {self._description.joint_names[worst]} stands",
                "plan again from the present position",
            )

    def _begin(self, operation: str, **fields: object) -> _Failure | None:
        """Record a command; its scripted failure is raised here unless the move shall fail on its way."""
        self._need_open(operation)
        failure = self._due(operation)
        if failure is not None:
            fields["fails"] = type(failure.error).__name__
        self._record(operation, **fields)
        if failure is not None and operation != "follow":
            raise failure.error
        return failure

    def _due(self, operation: str) -> _Failure | None:
        due = None
        for failure in [f for f in self._failures if f.operation == operation]:
            failure.countdown -= 1
            if failure.countdown == 0:
                due = failure
                self._failures.remove(failure)
        return due

    @staticmethod
    def _raise_due(failure: _Failure | None) -> None:
        if failure is not None:
            raise failure.error

    def _may_move(self) -> bool:
        """Wait while paused; False when it is stopped."""
        self._waiting = self._paused
        while self._paused and not self._stop:
            self._clock.sleep(_PAUSED_LOOK)
        self._waiting = False
        return not self._stop

    def _record_stop(self) -> None:
        if self._stop and not self._stop_recorded:
            self._stop_recorded = True
            self._record("stop")

    def _record(self, operation: str, **fields: object) -> None:
        self._record_stop()
        command: Command = {"at_s": round(self._clock.now(), 6), "command": operation, **fields}
        self.commands.append(command)
        if self._on_command is not None:
            self._on_command(command)


class CommandFile:
    """A JSON-lines file of commands, one a line, written out as they come. Use it as `on_command`.

    Args:
        path: The file; an existing one is replaced.

    Raises:
        InputError: The file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file: TextIO = path.open("w", encoding="utf-8", newline="\n")
        except OSError as error:
            raise InputError(f"{path}: {error.strerror or error}", "name a folder that can be written") from error

    def __call__(self, command: Command) -> None:
        """Append one command."""
        self._file.write(json.dumps(command) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> CommandFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _line(command: Mapping[str, object], fields: Sequence[str]) -> str:
    chosen = {key: command[key] for key in fields if key in command} if fields else dict(command)
    return json.dumps(chosen, sort_keys=True)

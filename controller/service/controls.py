"""What a running cell lets others do to it, and what it says about itself: the seam behind the control socket."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from controller.cycle.machine import State
from controller.errors import SorterError
from controller.service.alarms import Alarm
from controller.service.packml import PackML


@dataclass(frozen=True, slots=True)
class Status:
    """What the cell is doing.

    Attributes:
        packml: The state as the outside knows it.
        state: The cell's own, None before the cycle exists.
        reason: One line for people: why it is in this state, or what it waits for.
        since_s: How long it has been in this state, s.
        uptime_s: How long the program has been running, s.
        mode: `real`, `sim` or `replay`.
        pid: The process.
        version: Of the program.
        config: Name of the configuration's file.
        config_digest: Hash of its contents.
        calibration_id: Identity of the calibration in use; "" when there is none.
        counts: Targets of this run by result.
        may_hold_part: The gripper may hold something: from a part under way, or an earlier run that was cut off.
        alarms: Those that want attention.
    """

    packml: PackML
    state: State | None
    reason: str
    since_s: float
    uptime_s: float
    mode: str
    pid: int
    version: str
    config: str
    config_digest: str
    calibration_id: str
    counts: Mapping[str, int]
    may_hold_part: bool
    alarms: tuple[Alarm, ...] = ()

    def to_json(self) -> dict[str, object]:
        """The status as the control socket shows it."""
        return {
            "state": str(self.packml),
            "cycle_state": None if self.state is None else self.state.value,
            "reason": self.reason,
            "since_s": round(self.since_s, 3),
            "uptime_s": round(self.uptime_s, 3),
            "mode": self.mode,
            "pid": self.pid,
            "version": self.version,
            "config": self.config,
            "config_digest": self.config_digest,
            "calibration_id": self.calibration_id,
            "counts": dict(self.counts),
            "may_hold_part": self.may_hold_part,
            "alarms": [alarm.to_json() for alarm in self.alarms],
        }


class Refused(SorterError):
    """The cell cannot do that in the state it is in; nothing has changed."""


class Controls(Protocol):
    """What a running cell lets others do to it. Called from the control server's threads, one change at a time.

    `stop` may come while any other call is still under way, and must return at once. A call may raise any
    SorterError (`Refused` when the state does not allow it); none may wait for the arm.
    """

    def status(self) -> Status:
        """What the cell is doing."""
        ...

    def alarms(self) -> tuple[Alarm, ...]:
        """Every alarm that is kept, oldest first."""
        ...

    def start(self, *, view_clear: bool = False) -> None:
        """Sort, from STOPPED. Moves metal.

        Args:
            view_clear: Somebody has looked: what reaches over the table now is to stay there.
        """
        ...

    def pause(self) -> None:
        """Hold on the path of the move under way, else before the next."""
        ...

    def resume(self) -> None:
        """Go on after a pause, from where it holds. Moves metal."""
        ...

    def stop(self) -> None:
        """Slow down along the path, park, torque off; returns at once, harmless when stopped."""
        ...

    def reset(self) -> None:
        """Clear a latched fault. Moves nothing."""
        ...

    def acknowledge(self, number: int | None) -> int:
        """Note that one alarm, or all, were seen; how many were new."""
        ...

    def emptied(self, name: str | None) -> None:
        """A bin, or (None) every bin, was emptied: its count begins anew."""
        ...

    def reload(self) -> tuple[str, ...]:
        """Read the configuration again, for the next cycle; what has changed."""
        ...

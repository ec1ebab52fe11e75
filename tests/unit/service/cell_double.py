"""A cell that only pretends, for the control socket's tests."""

from __future__ import annotations

import os
import threading

from controller.cycle.machine import State
from controller.service.alarms import Alarm, AlarmLog
from controller.service.controls import Refused, Status
from controller.service.packml import packml


class PretendedCell:
    """Does what it is told at once, and writes down what that was.

    Attributes:
        told: Commands in the order they were carried out.
        gate: Commands other than `stop` and the questions wait until it is set.
        entered: Set when a command has reached the gate.
    """

    def __init__(self) -> None:
        self.state = State.STOPPED
        self.told: list[str] = []
        self.log = AlarmLog()
        self.gate = threading.Event()
        self.gate.set()
        self.entered = threading.Event()

    def status(self) -> Status:
        return Status(
            packml=packml(self.state),
            state=self.state,
            reason="waiting for start" if self.state is State.STOPPED else "at work",
            since_s=1.0,
            uptime_s=7200.0,
            mode="sim",
            pid=os.getpid(),
            version="0.1.0",
            config="sim.toml",
            config_digest="c0ffee",
            calibration_id="cell-1",
            counts={"placed": 3, "dropped": 0},
            may_hold_part=False,
            alarms=self.log.open(),
        )

    def alarms(self) -> tuple[Alarm, ...]:
        return self.log.history()

    def _do(self, command: str, state: State) -> None:
        self.entered.set()
        assert self.gate.wait(20.0)
        self.told.append(command)
        self.state = state

    def start(self, *, view_clear: bool = False) -> None:
        if self.state is not State.STOPPED:
            raise Refused(f"not possible in {self.state.value}", "stop first")
        self._do("start --view-clear" if view_clear else "start", State.CAPTURE)

    def pause(self) -> None:
        self._do("pause", State.HELD)

    def resume(self) -> None:
        self._do("resume", State.CAPTURE)

    def stop(self) -> None:
        self.told.append("stop")
        self.state = State.STOPPED

    def reset(self) -> None:
        self._do("reset", State.STOPPED)
        self.log.clear()

    def acknowledge(self, number: int | None) -> int:
        return self.log.acknowledge(number)

    def emptied(self, name: str | None) -> None:
        self.told.append(f"emptied {name}")

    def reload(self) -> tuple[str, ...]:
        raise ZeroDivisionError

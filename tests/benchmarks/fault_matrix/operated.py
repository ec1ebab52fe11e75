"""An operated cell in this process, and somebody at its control socket who plays a scenario."""

from __future__ import annotations

import os
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from controller.backends import Devices, Mode
from controller.cycle.rig import Observer
from controller.errors import SorterError
from controller.service import session as session_module
from controller.service.client import CommandFailed, ControlClient, NotRunning
from controller.service.faults import fault_code
from controller.service.session import RunOptions, Session
from tests.benchmarks.fault_matrix.cases import Found
from tests.benchmarks.fault_matrix.cycle import Witness
from tests.benchmarks.open_cell import OpenCell

_PATIENCE = 90.0  # s of real time for anything that is waited for
_MOST_RESETS = 4


class Unexpected(Exception):
    """The scenario cannot go on."""


class Operator(Observer):
    """Plays a scenario, and remembers what the cell has told.

    Args:
        cell: The cell's devices.
        witness: Counts what moves.

    Attributes:
        noticed: Codes of all that was held for, warned of or stopped for.
    """

    def __init__(self, cell: OpenCell, witness: Witness) -> None:
        self.devices: Devices = cell.devices
        self.witness = witness
        self.noticed: list[str] = []
        self._client = ControlClient(Path(os.environ["STATE_DIRECTORY"]))

    def held(self, cause: SorterError, at: float) -> None:
        """It was noticed."""
        self.noticed.append(fault_code(cause))

    def warned(self, code: str, cause: str, at: float) -> None:
        """It was noticed."""
        self.noticed.append(code)

    def faulted(self, error: SorterError, at: float) -> None:
        """It was noticed."""
        self.noticed.append(fault_code(error))

    def ask(self, command: str) -> Any:
        """Ask the cell; again while it is busy with another request."""
        while True:
            try:
                return self._client.ask(command)
            except CommandFailed as error:
                if error.code not in ("busy", "too_fast"):
                    raise
                time.sleep(0.01)

    def wait_for(self, *states: str) -> str:
        """Wait until the cell is in one of these states, and say in which."""
        until = time.monotonic() + _PATIENCE
        state = "nobody there"
        while time.monotonic() < until:
            with suppress(NotRunning):
                state = str(self.ask("status")["state"])
                if state in states:
                    return state
            time.sleep(0.03)
        raise Unexpected(f"{state} after {_PATIENCE:g} s, not {' or '.join(states)}")

    def put_right(self) -> None:
        """Repair what is wrong, and reset until the cell is STOPPED."""
        assert self.devices.script is not None
        self.devices.script.repair()
        for _ in range(_MOST_RESETS):
            if self.wait_for("STOPPED", "ABORTED") == "STOPPED":
                return
            self.ask("reset")
        if self.wait_for("STOPPED", "ABORTED") != "STOPPED":
            raise Unexpected("no reset helps")

    def sort(self) -> None:
        """Start, and help on whenever the cell needs it, until there is nothing left to pick."""
        for _ in range(_MOST_RESETS):
            self.ask("start")
            while (state := self.wait_for("SUSPENDED", "ABORTED", "HELD")) == "HELD":
                alarms = [alarm["code"] for alarm in self.ask("status")["alarms"] if alarm["active"]]
                if "part_held" in alarms:
                    assert self.devices.script is not None
                    self.devices.script.repair()
                    with suppress(CommandFailed):  # it has gone on meanwhile
                        self.ask("resume")
                time.sleep(0.05)
            if state == "SUSPENDED":
                return
            self.put_right()
        raise Unexpected("no start helps")


def operate(
    cell: OpenCell, folder: Path, scenario: Callable[[Operator], None], options: RunOptions | None = None
) -> Found:
    """Run an operated cell in a state folder, until the scenario is over; to be called `apart`.

    Args:
        cell: Its devices.
        folder: Becomes the state folder.
        scenario: Played by a thread beside the cell's; complains by raising `Unexpected`.
        options: Of the session; the default is the shipped configuration.
    """
    os.environ["STATE_DIRECTORY"] = str(folder)
    os.environ.pop("RUNTIME_DIRECTORY", None)
    found, witness = Found(), Witness()
    operator = Operator(cell, witness)
    options = options or RunOptions(Mode.REAL, cell.config, calibration=cell.calibration)
    session = Session(replace(options, watch=lambda devices: (*witness.watch(devices), operator)))

    def play() -> None:
        try:
            scenario(operator)
        except (Unexpected, SorterError) as error:
            found.complaints.append(str(error))
        except Exception:
            found.complaints.append(traceback.format_exc())
        finally:
            session.stop()

    thread = threading.Thread(target=play, name="operator")
    with patch.object(session_module, "DEVICES", {Mode.REAL: cell.factory}):
        thread.start()
        try:
            found.figures = session.run()
        except SorterError as error:
            found.end = fault_code(error)
        thread.join()
    found.noticed = operator.noticed
    return found

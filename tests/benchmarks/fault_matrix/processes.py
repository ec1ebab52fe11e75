"""The whole process dies or hangs at work: the next start is STOPPED, knows what it may hold, and sorts the rest."""

from __future__ import annotations

import os
import select
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

from controller.backends import Devices, Mode
from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.ledger.view import LedgerView
from controller.service import session as session_module
from controller.service import standing_service
from controller.service.session import RunOptions, Session
from sim_backends.fault_script import FAILPOINTS, ScriptedFault
from tests.benchmarks.fault_matrix.cases import STATES, Found
from tests.benchmarks.fault_matrix.cycle import held_for, judge_ledger
from tests.benchmarks.fault_matrix.operated import Operator, Unexpected, operate
from tests.benchmarks.open_cell import FORK, PARTS, OpenCell

_WATCHDOG = 1.0
"""s within which the service manager wants to hear from the service; 10 s in the shipped unit."""
_QUICK_STEP = -1.5
"""s instead of the 5 s that a step of the cycle may take beside waiting for a frame (2 s): a hang is seen sooner."""
_PATIENCE = 60.0  # s of real time for anything that is waited for

PROCESSES: tuple[tuple[str, str], ...] = (
    *(("power_lost", state) for state in STATES),
    *(("power_lost", point) for point in FAILPOINTS),
    *(("loop_hung", f"{state}, stopped") for state in STATES),
    *(("loop_hung", f"{state}, busy") for state in ("CAPTURE", "PICK")),
)
"""By fault, and state of the cycle or failpoint of the record."""


class _Hang(Observer):
    """Hangs as a state is entered: the whole process by a signal, or the cycle's loop by turning in circles."""

    def __init__(self, state: str, way: str) -> None:
        self._state, self._way = state, way

    def entered(self, state: State, at: float) -> None:
        """Hang, if this is the state."""
        if state.value != self._state:
            return
        if self._way == "stopped":
            os.kill(os.getpid(), signal.SIGSTOP)
        while True:
            pass


def run_process(fault: str, when: str, cell: OpenCell, folder: Path) -> Found:
    """Let a process die or hang at work, start the next, and judge what became of it; to be called `apart`."""
    folder.mkdir(parents=True)
    complaints = _cut_off(when, cell, folder) if fault == "power_lost" else _hang(when, cell, folder)
    path = folder / "ledger.db"
    with LedgerView(path) as ledger:
        begun = {row["target_id"] for row in ledger.rows("intents")}
        open_ = begun - {row["target_id"] for row in ledger.rows("outcomes")}

    def scenario(operator: Operator) -> None:
        if operator.wait_for("STOPPED", "ABORTED") != "STOPPED" or operator.witness.moves:
            raise Unexpected("it did not come up STOPPED")
        status = operator.ask("status")
        if bool(status["may_hold_part"]) != bool(open_):
            raise Unexpected(f"open were {sorted(open_)}, and it says {status['may_hold_part']} of the jaws")
        if ("power_lost" in [alarm["code"] for alarm in status["alarms"]]) != bool(open_):
            raise Unexpected(f"open were {sorted(open_)}, and the alarms are {status['alarms']}")
        operator.sort()

    found = operate(cell, folder, scenario)
    found.complaints += complaints
    found.end = fault
    judge_ledger(path, Found(complaints=found.complaints))
    with LedgerView(path) as ledger:
        runs = [row["end_reason"] for row in ledger.rows("runs")]
        settled = [row["target_id"] for row in ledger.rows("outcomes") if row["result"] == "indeterminate"]
    if runs != ["unclean", "stopped"]:
        found.complaints.append(f"the runs ended {runs}")
    if len(open_) > 1 or not open_ <= set(settled):
        found.complaints.append(f"open were {sorted(open_)}, settled were {settled}")
    # This process has the table as it was: all parts are there, whatever the other had done.
    if found.figures.get("sorted") != PARTS:
        found.complaints.append(f"{found.figures.get('sorted')} of {PARTS} parts sorted afterwards")
    return found


def _work(cell: OpenCell, folder: Path, observers: Callable[[Devices], tuple[Observer, ...]]) -> None:
    """Sort as a service that is started at once."""
    os.environ["STATE_DIRECTORY"] = str(folder)
    os.environ.pop("RUNTIME_DIRECTORY", None)
    options = RunOptions(Mode.REAL, cell.config, calibration=cell.calibration, start=True, watch=observers)
    with patch.object(session_module, "DEVICES", {Mode.REAL: cell.factory}):
        Session(options).run()


def _cut_off(when: str, cell: OpenCell, folder: Path) -> list[str]:
    assert cell.devices.script is not None
    faults = [ScriptedFault("power_lost", None, when)]
    if when == "HELD":
        faults.append(held_for("camera_stalled"))
    cell.devices.script.add(tuple(faults))
    process = FORK.Process(target=_work, args=(cell, folder, lambda devices: ()))
    process.start()
    process.join(_PATIENCE)
    complaints = [] if process.exitcode == -signal.SIGKILL else [f"the process ended with {process.exitcode}"]
    process.kill()
    process.join()
    cell.devices.script.forget()
    return complaints


def _hang(when: str, cell: OpenCell, folder: Path) -> list[str]:
    """What the service manager sees: reassurance until it hangs, none after that; it ends the process."""
    state, way = when.split(", ")
    assert cell.devices.script is not None
    if state == "HELD":
        cell.devices.script.add((held_for("camera_stalled"),))
    manager = {"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": str(round(1e6 * _WATCHDOG))}
    complaints = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(manager["NOTIFY_SOCKET"])
        with patch.dict(os.environ, manager), patch.object(standing_service, "_SLOWEST_STEP_S", _QUICK_STEP):
            process = FORK.Process(target=_work, args=(cell, folder, lambda devices: (_Hang(state, way),)))
            process.start()
        heard = _listen(line)
        if "READY=1" not in heard:
            complaints.append("it was never ready")
        if not process.is_alive():
            complaints.append("it has not hung")
        process.kill()
        process.join()
    cell.devices.script.forget()
    return complaints


def _listen(line: socket.socket) -> str:
    """All that is said until nothing was said for as long as the manager waits."""
    heard, until = "", time.monotonic() + _PATIENCE
    while time.monotonic() < until and select.select([line], [], [], _PATIENCE if not heard else 2.0 * _WATCHDOG)[0]:
        heard += line.recv(4096).decode() + "\n"
    return heard

"""What is wrong already when the program comes up: it refuses, or comes up with an alarm, and moves nothing."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, cast

from controller.backends import Mode
from controller.cli import execute
from controller.config.files import shipped
from controller.ledger.sqlite import SqliteLedger
from controller.service.lock import InstanceLock
from controller.service.session import RunOptions
from drivers.arm.dynamixel import DynamixelArm
from drivers.arm.serial_stream import SerialStream
from sim_backends.fault_script import ScriptedFault
from sim_backends.virtual_clock import VirtualClock
from tests.benchmarks.fault_matrix.cases import CASES, Found
from tests.benchmarks.fault_matrix.cycle import config_for, judge_ledger
from tests.benchmarks.fault_matrix.operated import Operator, Unexpected, operate
from tests.benchmarks.open_cell import OpenCell, apart
from tests.unit.calibration.certified import certify

Start = Callable[[OpenCell, Path], Found]


def _refused(code: str, cell: OpenCell, folder: Path, options: RunOptions | None = None) -> Found:
    """It does not come up, says why, and has moved nothing."""

    def nothing(operator: Operator) -> None:
        pass

    found = operate(cell, folder, nothing, options)
    if found.end != code:
        found.complaints.append(f"ended {found.end or 'without a fault'}, not {code}")
    return found


def _comes_up(code: str, operator: Operator, state: str) -> None:
    """It stands there with the alarm, and nothing has moved."""
    if operator.wait_for("STOPPED", "ABORTED") != state:
        raise Unexpected(f"it did not come up {state}")
    alarms = [alarm["code"] for alarm in operator.ask("status")["alarms"]]
    if alarms != [code]:
        raise Unexpected(f"the alarms are {alarms}, not {code}")
    if operator.witness.moves:
        raise Unexpected("it has moved by itself")


@contextmanager
def _manager(folder: Path) -> Any:
    """A service manager listens."""
    folder.mkdir(parents=True, exist_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(folder / "notify"))
        os.environ["NOTIFY_SOCKET"] = str(folder / "notify")
        yield


def _missing(code: str, spoil: Callable[[OpenCell], Callable[[], None]], *, managed: bool = True) -> Start:
    """A device is not there, or not the right one: an alarm under a service manager, else it ends at once."""

    def run(cell: OpenCell, folder: Path) -> Found:
        mend = spoil(cell)
        if not managed:
            return _refused(code, cell, folder)

        def scenario(operator: Operator) -> None:
            _comes_up(code, operator, "ABORTED")
            operator.ask("reset")
            if operator.wait_for("STOPPED", "ABORTED") != "ABORTED":
                raise Unexpected("a reset has let it pass")
            mend()
            operator.put_right()
            operator.sort()

        with _manager(folder):
            return operate(cell, folder, scenario)

    return run


def _struck(fault: str) -> Callable[[OpenCell], Callable[[], None]]:
    def spoil(cell: OpenCell) -> Callable[[], None]:
        assert cell.devices.script is not None
        cell.devices.script.strike(ScriptedFault(fault))
        return cell.devices.script.repair

    return spoil


def _register(name: str, value: int) -> Callable[[OpenCell], Callable[[], None]]:
    """A servo is another one than it should be."""

    def spoil(cell: OpenCell) -> Callable[[], None]:
        servo = cast(Any, cell.devices.script)._bus.servo(3)
        right = servo.table.get(name)

        def put(what: int) -> None:
            servo.table.set(name, what)
            servo.on_address()

        put(value)
        return lambda: put(right)

    return spoil


def _bus_busy(cell: OpenCell, folder: Path) -> Found:
    _, port = os.openpty()
    arm = cell.devices.arm.description
    holder = SerialStream(os.ttyname(port))
    holder.open(arm.baud)
    cell.devices.arm = DynamixelArm(arm, SerialStream(os.ttyname(port)), cell.devices.clock)
    found = _refused("bus_busy", cell, folder)
    holder.close()
    return found


def _ledger_damaged(cell: OpenCell, folder: Path) -> Found:
    path = folder / "ledger.db"
    with SqliteLedger(path, clock=VirtualClock()) as ledger:
        ledger.begin_run(software_version="0", config_hash="0")
        for number in range(200):
            ledger.note("filler", 0.0, number=number, text="x" * 200)
    with path.open("r+b") as file:
        file.seek(8192)
        file.write(b"\xa5" * 8192)

    def scenario(operator: Operator) -> None:
        _comes_up("ledger_damaged", operator, "STOPPED")
        operator.sort()

    found = operate(cell, folder, scenario)
    if not list(folder.glob("ledger.db.damaged-*")):
        found.complaints.append("the damaged record was not set aside")
    judge_ledger(path, found)
    return found


def _unclean_starts(cell: OpenCell, folder: Path) -> Found:
    for _ in range(3):
        with SqliteLedger(folder / "ledger.db", clock=VirtualClock()) as ledger:
            ledger.begin_run(software_version="0", config_hash="0")
            ledger._run_id = None  # killed: nobody ends it

    def scenario(operator: Operator) -> None:
        _comes_up("unclean_starts", operator, "ABORTED")
        operator.put_right()
        operator.sort()

    return operate(cell, folder, scenario)


def _bin_full(cell: OpenCell, folder: Path) -> Found:
    options = RunOptions(Mode.REAL, config_for(CASES["bin_full"], cell.config), calibration=cell.calibration)

    def find_full(operator: Operator) -> None:
        operator.wait_for("STOPPED")
        operator.sort()
        if operator.witness.moves > 2 or operator.noticed != ["bin_full"]:  # torque on, and to where it sees
            raise Unexpected(f"{operator.witness.moves} moves, noticed was {operator.noticed}")
        operator.ask("emptied")
        operator.wait_for("EXECUTE", "STOPPED")
        operator.wait_for("SUSPENDED")

    ((_, before),) = apart([lambda: operate(cell, folder, _sort, options)])
    found = operate(cell, folder, find_full, options)
    if before is None or before.figures["sorted"] != 1:
        found.complaints.append("the bin was not filled")
    judge_ledger(folder / "ledger.db", Found())
    return found


def _sort(operator: Operator) -> None:
    operator.wait_for("STOPPED")
    operator.sort()


def _config_invalid(cell: OpenCell, folder: Path) -> Found:
    found, text = Found(), shipped("cell.toml").read_text(encoding="utf-8")
    folder.mkdir(parents=True)
    os.environ["STATE_DIRECTORY"] = str(folder / "state")
    for name, wrong in (
        ("typo", text.replace("speed_percent", "sped_percent")),
        ("range", text.replace("speed_percent = 50", "speed_percent = 5000")),
        ("bin", text.replace('bin = "squares"', 'bin = "squarse"')),
        ("syntax", text + "["),
        ("nothing", ""),
    ):
        path = folder / f"{name}.toml"
        path.write_text(wrong, encoding="utf-8")
        if (code := execute(["run", "--config", str(path)])) != 78:
            found.complaints.append(f"{name}: exit code {code}, not 78")
    found.end = "config_invalid"
    return found


def _calibration(code: str, spoil: Callable[[Path], None] | None) -> Start:
    def run(cell: OpenCell, folder: Path) -> Found:
        if spoil is None:
            return _refused(code, cell, folder, RunOptions(Mode.REAL, cell.config))
        copy = Path(shutil.copytree(cell.calibration, folder.with_name(folder.name + "-calibration")))
        spoil(copy)
        return _refused(code, cell, folder, RunOptions(Mode.REAL, cell.config, calibration=copy))

    return run


def _foreign(cell: OpenCell, folder: Path) -> Found:
    cell.devices.names = {name: "another" for name in cell.devices.names}
    return _refused("calibration_stale", cell, folder)


def _cell_busy(cell: OpenCell, folder: Path) -> Found:
    with InstanceLock(folder):
        return _refused("cell_busy", cell, folder)


def _long_ago(folder: Path) -> None:
    certify(folder, made_at=(datetime.now().astimezone() - timedelta(days=400)).isoformat())


STARTS: Mapping[tuple[str, str], Start] = {
    ("camera_lost", "managed"): _missing("camera_lost", _struck("camera_lost")),
    ("camera_lost", "alone"): _missing("camera_lost", _struck("camera_lost"), managed=False),
    ("bus_lost", "managed"): _missing("bus_lost", _struck("bus_lost")),
    ("bus_lost", "alone"): _missing("bus_lost", _struck("bus_lost"), managed=False),
    ("bus_refused", "missing"): _missing("bus_refused", _struck("bus_timeout")),
    ("bus_refused", "model"): _missing("bus_refused", _register("Model_Number", 1120)),
    ("bus_refused", "double"): _missing("bus_refused", _register("ID", 4)),
    ("bus_busy", "alone"): _bus_busy,
    ("ledger_damaged", "flipped"): _ledger_damaged,
    ("unclean_starts", "three"): _unclean_starts,
    ("bin_full", "found full"): _bin_full,
    ("config_invalid", "five ways"): _config_invalid,
    ("calibration_missing", "none"): _calibration("calibration_missing", None),
    ("calibration_missing", "unproved"): _calibration(
        "calibration_missing", lambda folder: (folder / "certificate.json").unlink()
    ),
    ("calibration_stale", "old"): _calibration("calibration_stale", _long_ago),
    ("calibration_stale", "foreign"): _foreign,
    ("calibration_poor", "failed"): _calibration(
        "calibration_poor", lambda folder: certify(folder, verdict="failed", touch_mm={"mean": 2.0, "p95": 3.0})
    ),
    ("cell_busy", "locked"): _cell_busy,
}
"""By fault and variant."""


def run_start(fault: str, variant: str, cell: OpenCell, folder: Path) -> Found:
    """Come up with something wrong, and judge what became of it; to be called `apart`."""
    return STARTS[fault, variant](cell, folder)

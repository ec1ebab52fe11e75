"""A fault strikes while an operated cell is STOPPED, or while another fault is latched already.

Then the cell is started; somebody puts right what is wrong and resets and starts again, until everything is sorted.
"""

from __future__ import annotations

from pathlib import Path

from controller.errors import SorterError
from controller.service.faults import CATALOGUE, Action
from sim_backends.fault_script import ScriptedFault
from tests.benchmarks.fault_matrix.cases import GOES_ON, Case, Found
from tests.benchmarks.fault_matrix.cycle import judge_ledger
from tests.benchmarks.fault_matrix.operated import Operator, Unexpected, operate
from tests.benchmarks.open_cell import PARTS, OpenCell

_LATCHED, _OTHER = "servo_overload", "servo_shock"
"""What has latched when a fault is to strike in FAULT, and what when it is that one itself."""
_REST = 1.0
"""s that pass at rest after a fault has struck."""


def run_standing(case: Case, state: str, cell: OpenCell, folder: Path) -> Found:
    """Let the fault strike at rest, and judge what became of it; to be called `apart`."""
    scenario = _in_fault if state == "FAULT" else _while_stopped
    found = operate(cell, folder, lambda operator: scenario(case, operator))
    judge_ledger(folder / "ledger.db", found)
    assert cell.devices.truth is not None
    inside = sum(part.place in {bin_.name for bin_ in cell.config.bins} for part in cell.devices.truth.now())
    if not found.complaints and found.figures["sorted"] != inside:
        found.complaints.append(f"{inside} parts lie in the bins, {found.figures['sorted']} are on record")
    if inside < PARTS - case.unsorted:
        found.complaints.append(f"{inside} of {PARTS} parts lie in the bins")
    return found


def _while_stopped(case: Case, operator: Operator) -> None:
    operator.wait_for("STOPPED")
    _strike(case, operator)
    if operator.wait_for("STOPPED", "ABORTED") != "STOPPED" or operator.witness.moves:
        raise Unexpected("something has happened while it was STOPPED")
    operator.sort()
    hidden = case.fault in ("picture_frozen", "part_lost")  # nothing was seen before, nothing is in the jaws
    told = CATALOGUE[case.fault].action in (Action.HELD, Action.WARNED) and case.ends == GOES_ON
    if told and not hidden and case.fault not in operator.noticed:
        raise Unexpected("nobody noticed")
    # A start writes anew what a servo loses when it restarts.
    if "" not in case.ends and case.fault != "servo_rebooted" and not case.ends & set(operator.noticed):
        raise Unexpected(f"noticed were {operator.noticed}, not {' or '.join(sorted(case.ends))}")


def _in_fault(case: Case, operator: Operator) -> None:
    script = operator.devices.script
    assert script is not None
    first = _OTHER if case.fault == _LATCHED else _LATCHED
    script.add((ScriptedFault(first, None, "PICK", 1, 0.3, 2.0),))
    operator.wait_for("STOPPED")
    operator.ask("start")
    operator.wait_for("ABORTED")
    moves = operator.witness.moves
    _strike(case, operator)
    alarms = operator.ask("status")["alarms"]
    if (alarms[0]["code"], alarms[0]["first_out"]) != (first, True):
        raise Unexpected(f"the first alarm is {alarms[0]['code']}, not {first}")
    try:
        operator.ask("start")
    except SorterError:
        pass
    else:
        raise Unexpected("it was started while a fault was latched")
    operator.ask("reset")
    operator.wait_for("STOPPED", "ABORTED")
    operator.put_right()
    if operator.witness.moves != moves:
        raise Unexpected("something has moved before it was started again")
    operator.sort()


def _strike(case: Case, operator: Operator) -> None:
    """Let it happen, and some time pass; nobody else turns the world's clock while the cell is at rest."""
    assert operator.devices.script is not None
    operator.devices.script.strike(ScriptedFault(case.fault, duration=case.lasts + _REST))
    operator.devices.clock.sleep(_REST)

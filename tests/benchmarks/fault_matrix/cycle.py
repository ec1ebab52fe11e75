"""A fault strikes as the cycle enters a state."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any
from unittest.mock import patch

from controller.backends import Devices, Level, Mode
from controller.config.cell import CellConfig
from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.domain import ArmState, GripReport, MoveReport, Trajectory
from controller.errors import ArmError, LimitViolation, SorterError
from controller.ledger import sqlite as ledger_module
from controller.ledger.sqlite import SqliteLedger
from controller.ledger.view import LedgerView
from controller.ports import Arm
from controller.service import session as session_module
from controller.service.faults import CATALOGUE, Action, fault_code
from controller.service.session import RunOptions, Session
from sim_backends.fault_script import ScriptedFault
from sim_backends.virtual_clock import VirtualClock
from tests.benchmarks.fault_matrix.cases import GOES_ON, Case, Found
from tests.benchmarks.open_cell import PARTS, SEED, OpenCell

_HOLD_FIRST, _BLACK_FIRST = "camera_stalled", "picture_black"
"""What the cell holds for when a fault is to strike in HELD, and what for when it is that one itself."""
_FAR = timedelta(days=700)

_FAILURES: dict[str, Callable[[], Exception]] = {
    "arm_failed": lambda: ArmError("arm", "follow", "it refuses"),
    "plan_refused": lambda: LimitViolation("the elbow would leave its limits"),
    "internal_error": lambda: RuntimeError("a mistake in the program"),
}


class Witness(Observer):
    """Lets what no simulated device can do happen, and counts what the arm is told when it must be told nothing.

    Nothing may move once a fault has latched, nor after one of the arm's own, not even to park.

    Args:
        case: What happens.
        state: When: as this state is entered.
    """

    def __init__(self, case: Case | None = None, state: str = "") -> None:
        self.forbidden = False
        self.moves = self.moves_after = 0
        self._case, self._state = case, state
        self.failure: Callable[[], Exception] | None = None
        self.jump = timedelta()

    def watch(self, devices: Devices) -> tuple[Observer, ...]:
        """Stand between the cycle and the arm."""
        devices.arm = _CountedArm(devices.arm, self)
        return (self,)

    def entered(self, state: State, at: float) -> None:
        """Nothing may move in FAULT."""
        self.forbidden = self.forbidden or state is State.FAULT
        if self._case is not None and state.value == self._state:
            if self._case.by == "arm":
                self.failure = _FAILURES[self._case.fault]
            elif self._case.by == "clock":
                self.jump = -_FAR if self.jump else _FAR

    def faulted(self, error: SorterError, at: float) -> None:
        """Nothing may move after a fault of the arm, not even to park."""
        self.forbidden = self.forbidden or isinstance(error, ArmError)

    def moving(self) -> None:
        """The arm is told to move."""
        self.moves += 1
        self.moves_after += self.forbidden
        if self.failure is not None:
            failure, self.failure = self.failure, None
            raise failure()


class _CountedArm:
    def __init__(self, arm: Arm, witness: Witness) -> None:
        self._arm, self._witness = arm, witness

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def energise(self) -> ArmState:
        self._witness.moving()
        return self._arm.energise()

    def follow(self, trajectory: Trajectory, opening: float | None = None, after: float = 0.0) -> MoveReport:
        self._witness.moving()
        return self._arm.follow(trajectory, opening, after)

    def grip(self, opening: float, effort: float = 1.0) -> GripReport:
        self._witness.moving()
        return self._arm.grip(opening, effort)


def held_for(fault: str) -> ScriptedFault:
    """What brings the cell into HELD: it begins while the first part is placed, and holds the look after that."""
    return ScriptedFault(fault, None, "PLACE", 1, duration=6.0)


def script(case: Case, state: str) -> tuple[ScriptedFault, ...]:
    """What happens in one run."""
    found: tuple[ScriptedFault, ...] = ()
    if state == "HELD":
        first = _BLACK_FIRST if case.fault == _HOLD_FIRST else _HOLD_FIRST
        found = (held_for(first),)
    if case.by == "script" and case.fault != "bin_full":
        occurrence = 2 if case.compares and state not in ("IDLE", "HELD") else 1
        found += (ScriptedFault(case.fault, None, state, occurrence, case.delay, case.lasts),)
    return found


def config_for(case: Case, config: CellConfig) -> CellConfig:
    """The cell's configuration, as this fault needs it."""
    sorting = config.sorting
    if case.fault == "bin_full":
        # One bin for all, with room for one part.
        one = config.bins[0].name
        rules = tuple(rule.model_copy(update={"bin": one}) for rule in sorting.rules)
        bins = tuple(bin_.model_copy(update={"capacity": 1} if bin_.name == one else {}) for bin_ in config.bins)
        return config.model_copy(update={"sorting": sorting.model_copy(update={"rules": rules}), "bins": bins})
    if case.fault == "part_unknown":
        # What no rule knows is left where it lies.
        return config.model_copy(update={"sorting": sorting.model_copy(update={"otherwise": "leave"})})
    return config


def run_case(case: Case, state: str, cell: OpenCell, folder: Path) -> Found:
    """Sort while the fault strikes in one state, and judge what became of it; to be called `apart`."""
    found, witness = Found(), Witness(case, state)
    assert cell.devices.script is not None
    cell.devices.script.add(script(case, state))
    options = RunOptions(
        Mode.SIM,
        config_for(case, cell.config),
        out=folder,
        calibration=cell.calibration,
        parts=PARTS,
        seed=SEED,
        level=Level.DYNAMIC,
        watch=witness.watch,
    )

    class Wall(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]  # of the parent, not of this
            return datetime.now(tz) + witness.jump

    with (
        patch.object(session_module, "DEVICES", {Mode.SIM: cell.factory}),
        patch.object(ledger_module, "datetime", Wall),
    ):
        try:
            Session(options).run()
        except SorterError as error:
            found.end = fault_code(error)
        except RuntimeError:
            found.end = "internal_error"
    judge(case, state, found, witness, folder)
    return found


def judge(case: Case, state: str, found: Found, witness: Witness, folder: Path) -> None:
    """Complain of everything that is not as it has to be."""
    say = found.complaints.append
    if found.end not in case.ends:
        say(f"ended {found.end or 'without a fault'}, not {' or '.join(sorted(case.ends)) or 'without a fault'}")
    if witness.moves_after:
        say(f"{witness.moves_after} moves after the fault")
    judge_ledger(folder / "ledger.db", found, closed=found.end != "internal_error")
    if found.end == "internal_error":  # the program has ended where it was, and wrote no report
        return
    figures = found.figures = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    found.noticed = [fault["code"] for fault in figures["faults"]]
    # Once the table is empty nothing is looked at or recorded; before the first look no picture can come again.
    hidden = state == "IDLE" or (case.fault, state) == ("picture_frozen", "HOMING")
    told = CATALOGUE[case.fault].action in (Action.HELD, Action.WARNED, Action.SUSPENDED) and case.ends == GOES_ON
    if told and not hidden and not {case.fault, case.looks_like} & set(found.noticed):
        say("nobody noticed")
    for fault in figures["faults"]:
        row = CATALOGUE[fault["code"]]
        if fault["action"] == Action.HELD and row.action is not Action.HELD:
            say(f"held for {fault['code']}, which is to be {row.action}")
        if fault["action"] == Action.HELD and not found.end and "lasted_s" not in fault:
            say(f"{fault['code']} is over, but nobody says so")
    if figures["silent"] or figures["missorted"]:
        say("a part thought placed lies elsewhere")
    if figures["left"] < 0 or figures["correct"] != figures["sorted"]:
        say("more parts are accounted for than there are")
    if not found.end and figures["correct"] < PARTS - case.unsorted:
        say(f"{figures['correct']} of {PARTS} parts sorted")


def judge_ledger(path: Path, found: Found, *, closed: bool = True) -> None:
    """Complain unless every target has its one outcome on record.

    Args:
        path: The ledger.
        found: Is added to.
        closed: The run came to its end.
    """
    say = found.complaints.append
    if not closed:  # what the next start does first
        with SqliteLedger(path, clock=VirtualClock()):
            pass
    with LedgerView(path) as view:
        for problem in view.verify():
            say(f"ledger: {problem}")
        begun = {(row["run_id"], row["target_id"]) for row in view.rows("intents")}
        ended = Counter((row["run_id"], row["target_id"]) for row in view.rows("outcomes"))
        placed = sum(row["result"] == "placed" for row in view.rows("outcomes"))
    if set(ended) - begun or any(count != 1 for count in ended.values()) or begun - set(ended):
        say("not exactly one outcome for every target")
    if found.figures and placed != found.figures["sorted"]:
        say(f"the ledger has {placed} placed, the report {found.figures['sorted']}")

"""Every fault in every state of the cycle: what the cell made of it, and whether every object is accounted for.

    python tests/benchmarks/fault_matrix.py

Each run sorts a small simulated table while one fault of the catalogue strikes as the cycle enters one state. Prints
one line a run and a summary; the exit code is 1 when any run ended otherwise than the catalogue says.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from controller.backends import Devices, Level, Mode
from controller.config.cell import load_cell
from controller.config.files import shipped
from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.domain import ArmState, GripReport, MoveReport, Trajectory
from controller.errors import ArmError, SorterError
from controller.ledger.view import LedgerView
from controller.ports import Arm
from controller.service.faults import CATALOGUE, Action, fault_code
from controller.service.session import RunOptions, Session
from tests.benchmarks.cell_vision import look_at_cell

STATES = ("HOMING", "CAPTURE", "DETECT", "LOCALIZE", "PICK", "PLACE", "IDLE")
SEED, PARTS = 7, 2

GOES_ON = frozenset({""})
"""Ends without a latched fault, every part dealt with."""


@dataclass(frozen=True, slots=True)
class Case:
    """One fault as the matrix lets it happen.

    Attributes:
        fault: Its code.
        ends: How a run may end: the latched fault's code, or "" for none.
        lasts: s.
        delay: s after the state is entered.
        sorts_all: When nothing latches, every part is in its bin at the end.
        compares: It is noticed beside the first picture of a new cell, so that it strikes a state's second time;
            before that picture there is nothing to notice.
    """

    fault: str
    ends: frozenset[str] = GOES_ON
    lasts: float = 6.0
    delay: float = 0.0
    sorts_all: bool = True
    compares: bool = False

    @property
    def states(self) -> tuple[str, ...]:
        """States of the cycle in which it can strike."""
        return tuple(state for state in STATES if not (self.compares and state == "HOMING"))


def _stops(*codes: str) -> frozenset[str]:
    return frozenset(codes)


# Where a fault of a servo is first noticed depends on what it is doing: it may also be found silent or off its path.
CASES: Mapping[str, Case] = {
    case.fault: case
    for case in (
        Case("camera_lost"),
        Case("camera_stalled"),
        Case("picture_frozen"),
        Case("picture_black"),
        Case("picture_overexposed"),
        Case("picture_torn"),
        Case("picture_light", compares=True),
        Case("picture_soft", compares=True),
        Case("picture_moved", compares=True),
        Case("picture_covered", compares=True),
        Case("light_drifting", lasts=600.0, compares=True),
        Case("pictures_damaged", lasts=600.0),
        Case("supply_low", lasts=600.0),
        Case("bus_noisy", lasts=600.0),
        Case("ledger_unwritable"),
        Case("bus_corrupt", lasts=3.0),
        Case("grasp_missed", delay=0.2, sorts_all=False),
        Case("part_lost", delay=0.6),
        Case("part_held", _stops("", "part_held", "motion_timeout", "servo_overload"), 600.0, 0.4, sorts_all=False),
        Case("bus_timeout", _stops("bus_timeout"), 600.0),
        Case("bus_lost", _stops("bus_lost"), 600.0),
        Case("servo_overload", _stops("servo_overload")),
        Case("servo_shock", _stops("servo_shock")),
        Case("servo_overheat", _stops("servo_overheat")),
        Case("servo_undervoltage", _stops("servo_undervoltage"), 600.0),
        Case("servo_encoder", _stops("servo_encoder")),
        Case("servo_rebooted", _stops("servo_rebooted", "bus_timeout")),
        Case("motion_timeout", _stops("motion_timeout", "servo_overload", "plan_refused"), 600.0),
    )
}


@dataclass(slots=True)
class Found:
    """What became of one run.

    Attributes:
        end: Code of the latched fault, or "".
        figures: Of the report.
        complaints: Everything that was not as it has to be.
    """

    end: str = ""
    figures: dict[str, Any] = field(default_factory=dict)
    complaints: list[str] = field(default_factory=list)


class _Witness(Observer):
    """Counts what the arm is told after the fault: nothing once it has latched, nor after one of the arm's own."""

    def __init__(self) -> None:
        self.forbidden = False
        self.moves_after = 0

    def watch(self, devices: Devices) -> tuple[Observer, ...]:
        """Stand between the cycle and the arm."""
        devices.arm = _CountedArm(devices.arm, self)
        return (self,)

    def entered(self, state: State, at: float) -> None:
        """Nothing may move in FAULT."""
        self.forbidden = self.forbidden or state is State.FAULT

    def faulted(self, error: SorterError, at: float) -> None:
        """Nothing may move after a fault of the arm, not even to park."""
        self.forbidden = self.forbidden or isinstance(error, ArmError)

    def moved(self) -> None:
        """The arm is told to move."""
        self.moves_after += self.forbidden


class _CountedArm:
    def __init__(self, arm: Arm, witness: _Witness) -> None:
        self._arm, self._witness = arm, witness

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def energise(self) -> ArmState:
        self._witness.moved()
        return self._arm.energise()

    def follow(self, trajectory: Trajectory, opening: float | None = None, after: float = 0.0) -> MoveReport:
        self._witness.moved()
        return self._arm.follow(trajectory, opening, after)

    def grip(self, opening: float, effort: float = 1.0) -> GripReport:
        self._witness.moved()
        return self._arm.grip(opening, effort)


def script(case: Case, state: str) -> str:
    """The script of one run."""
    occurrence = 2 if case.compares and state != "IDLE" else 1
    on = f'on = {{ state = "{state}", occurrence = {occurrence}, delay_s = {case.delay} }}'
    return f'[[fault]]\nfault = "{case.fault}"\n{on}\nduration_s = {case.lasts}\n'


def run_case(case: Case, state: str, calibration: Path, folder: Path) -> Found:
    """Sort while the fault strikes in one state, and judge what became of it."""
    folder.mkdir(parents=True)
    faults = folder / "faults.toml"
    faults.write_text(script(case, state), encoding="utf-8")
    found, witness = Found(), _Witness()
    options = RunOptions(
        Mode.SIM,
        load_cell(shipped("sim.toml")),
        out=folder / "run",
        calibration=calibration,
        parts=PARTS,
        seed=SEED,
        level=Level.DYNAMIC,
        faults=faults,
        watch=witness.watch,
    )
    try:
        Session(options).run()
    except SorterError as error:
        found.end = fault_code(error)
    found.figures = json.loads((folder / "run" / "report.json").read_text(encoding="utf-8"))
    _judge(case, found, witness, folder / "run" / "ledger.db")
    seen = {fault["code"] for fault in found.figures["faults"]}
    # Once the table is empty nothing is looked at or recorded; before the first look no picture can come again.
    hidden = state == "IDLE" or (case.fault, state) == ("picture_frozen", "HOMING")
    told = CATALOGUE[case.fault].action in (Action.HELD, Action.WARNED) and case.ends == GOES_ON
    if told and not hidden and case.fault not in seen:
        found.complaints.append("nobody noticed")
    return found


def _judge(case: Case, found: Found, witness: _Witness, ledger: Path) -> None:
    say, figures = found.complaints.append, found.figures
    if found.end not in case.ends:
        say(f"ended {found.end or 'without a fault'}, not {' or '.join(sorted(case.ends)) or 'without a fault'}")
    if witness.moves_after:
        say(f"{witness.moves_after} moves after the fault")
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
    if not found.end and case.sorts_all and figures["correct"] != PARTS:
        say(f"{figures['correct']} of {PARTS} parts sorted")
    with LedgerView(ledger) as view:
        for problem in view.verify():
            say(f"ledger: {problem}")
        begun = {(row["run_id"], row["target_id"]) for row in view.rows("intents")}
        ended = Counter((row["run_id"], row["target_id"]) for row in view.rows("outcomes"))
        if set(ended) - begun or any(count != 1 for count in ended.values()) or begun - set(ended):
            say("not exactly one outcome for every target")
        placed = sum(row["result"] == "placed" for row in view.rows("outcomes"))
        if placed != figures["sorted"]:
            say(f"the ledger has {placed} placed, the report {figures['sorted']}")


def main() -> int:
    """Run the matrix."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--faults", nargs="*", default=sorted(CASES), choices=sorted(CASES), metavar="CODE")
    parser.add_argument("--states", nargs="*", default=STATES, choices=STATES, metavar="STATE")
    arguments = parser.parse_args()
    began, runs, bad = perf_counter(), 0, 0
    ends: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        look_at_cell(SEED, PARTS, "dynamic", root)
        for fault in arguments.faults:
            for state in (state for state in arguments.states if state in CASES[fault].states):
                found = run_case(CASES[fault], state, root / "calibration", root / fault / state)
                runs, bad = runs + 1, bad + bool(found.complaints)
                ends[found.end or "goes on"] += 1
                figures = found.figures
                line = {"fault": fault, "state": state, "end": found.end or "goes on"}
                line |= {key: figures[key] for key in ("sorted", "left", "dropped", "indeterminate")}
                line |= {"noticed": [f["code"] for f in figures["faults"]], "complaints": found.complaints}
                print(json.dumps(line), flush=True)
    print(json.dumps({"runs": runs, "bad": bad, "ends": dict(ends), "wall_s": round(perf_counter() - began, 1)}))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())

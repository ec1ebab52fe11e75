"""What may follow what."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from transitions import MachineError

from controller.cycle.machine import TRANSITIONS, CellMachine, State, diagram

README = Path(__file__).parents[3] / "README.md"


def reach(state: State) -> CellMachine:
    machine = CellMachine()
    ways = {
        State.STOPPED: [],
        State.HOMING: ["started"],
        State.CAPTURE: ["started", "homed"],
        State.DETECT: ["started", "homed", "captured"],
        State.LOCALIZE: ["started", "homed", "captured", "detected"],
        State.PICK: ["started", "homed", "captured", "detected", "located"],
        State.PLACE: ["started", "homed", "captured", "detected", "located", "picked"],
        State.IDLE: ["started", "homed", "captured", "detected", "emptied"],
        State.HELD: ["started", "held"],
        State.FAULT: ["faulted"],
    }
    for trigger in ways[state]:
        machine.fire(trigger)
    assert machine.state is state
    return machine


@pytest.mark.parametrize("state", State)
def test_only_the_table_s_triggers_work(state: State) -> None:
    for trigger in {entry["trigger"] for entry in TRANSITIONS}:
        allowed = [
            entry
            for entry in TRANSITIONS
            if entry["trigger"] == trigger
            and state in (entry["source"] if isinstance(entry["source"], list) else [entry["source"]])
        ]
        machine = reach(state)
        if allowed:
            assert machine.fire(trigger) is allowed[0]["dest"]
        else:
            with pytest.raises(MachineError):
                machine.fire(trigger)
            assert machine.state is state


@pytest.mark.parametrize("state", [state for state in State if state is not State.FAULT])
@pytest.mark.safety("SR-22")
def test_every_state_can_fault(state: State) -> None:
    assert reach(state).fire("faulted") is State.FAULT


@pytest.mark.safety("SR-22")
def test_a_fault_is_left_only_by_a_reset_and_only_to_stopped() -> None:
    leaving = [entry for entry in TRANSITIONS if entry["source"] is State.FAULT]
    assert [(entry["trigger"], entry["dest"]) for entry in leaving] == [("reset", State.STOPPED)]


@pytest.mark.safety("SR-01")
def test_motion_begins_only_by_started() -> None:
    leaving = [e for e in TRANSITIONS if e["source"] is State.STOPPED and e["dest"] is not State.FAULT]
    assert [entry["trigger"] for entry in leaving] == ["started"]


def test_the_diagram_in_the_readme_is_the_table() -> None:
    shown = re.search(r"```mermaid\n(stateDiagram.*?)\n```", README.read_text(), re.DOTALL)
    assert shown is not None
    assert shown.group(1) == diagram(), "run: python -m controller.cycle.machine"

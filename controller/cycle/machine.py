"""States and transitions of the cell, in one table.

Work is done by the handlers in `controller.cycle.handlers`; the machine only says what may follow what. The
first fault latches: only an operator's reset leaves FAULT, and it leads to STOPPED, never to motion.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

from transitions import Machine
from transitions.extensions import GraphMachine


class State(Enum):
    """Where the cell is in its work."""

    STOPPED = "STOPPED"
    HOMING = "HOMING"
    CAPTURE = "CAPTURE"
    DETECT = "DETECT"
    LOCALIZE = "LOCALIZE"
    PICK = "PICK"
    PLACE = "PLACE"
    IDLE = "IDLE"
    HELD = "HELD"
    FAULT = "FAULT"


_WORKING = [State.HOMING, State.CAPTURE, State.DETECT, State.LOCALIZE, State.PICK, State.PLACE, State.IDLE]

TRANSITIONS: list[dict[str, Any]] = [
    {"trigger": "started", "source": State.STOPPED, "dest": State.HOMING},
    {"trigger": "homed", "source": State.HOMING, "dest": State.CAPTURE},
    {"trigger": "captured", "source": State.CAPTURE, "dest": State.DETECT},
    {"trigger": "detected", "source": State.DETECT, "dest": State.LOCALIZE},
    {"trigger": "located", "source": State.LOCALIZE, "dest": State.PICK},
    {"trigger": "emptied", "source": [State.LOCALIZE, State.PICK], "dest": State.IDLE},
    {"trigger": "unsure", "source": [State.LOCALIZE, State.PICK], "dest": State.CAPTURE},
    {"trigger": "picked", "source": State.PICK, "dest": State.PLACE},
    {"trigger": "nudged", "source": State.PICK, "dest": State.CAPTURE},
    {"trigger": "missed", "source": State.PICK, "dest": State.CAPTURE},
    {"trigger": "placed", "source": State.PLACE, "dest": State.CAPTURE},
    {"trigger": "continued", "source": State.PLACE, "dest": State.PICK},
    {"trigger": "woken", "source": State.IDLE, "dest": State.CAPTURE},
    {"trigger": "held", "source": _WORKING, "dest": State.HELD},
    {"trigger": "resumed", "source": State.HELD, "dest": State.CAPTURE},
    {"trigger": "carried_on", "source": State.HELD, "dest": State.PLACE},
    {"trigger": "rehomed", "source": State.HELD, "dest": State.HOMING},
    {"trigger": "stopped", "source": [*_WORKING, State.HELD], "dest": State.STOPPED},
    {"trigger": "faulted", "source": [*_WORKING, State.HELD, State.STOPPED], "dest": State.FAULT},
    {"trigger": "reset", "source": State.FAULT, "dest": State.STOPPED},
]


class CellMachine:
    """The cell's state; `fire` is the only way to change it."""

    state: State

    def __init__(self) -> None:
        self._machine = Machine(
            model=self,
            states=State,
            transitions=TRANSITIONS,
            initial=State.STOPPED,
            auto_transitions=False,
        )

    def fire(self, trigger: str) -> State:
        """Take the transition `trigger` from the present state and return the new state.

        Raises:
            transitions.MachineError: The table has no such transition from here.
        """
        self.trigger(trigger)  # type: ignore[attr-defined]  # added to the model by transitions
        return self.state


def diagram() -> str:
    """The table as a Mermaid state diagram, for the README."""
    machine = GraphMachine(
        states=State,
        transitions=TRANSITIONS,
        initial=State.STOPPED,
        auto_transitions=False,
        graph_engine="mermaid",
    )
    lines = str(machine.get_graph().source).splitlines()
    arrows = [line.rstrip() for line in lines if "-->" in line]
    return "\n".join(["stateDiagram-v2", "  direction LR", *arrows])


if __name__ == "__main__":
    print(diagram())

"""The states as the outside knows them: names of ISA-TR88.00.02 (PackML), from one table."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from controller.cycle.machine import State


class PackML(StrEnum):
    """States of ISA-TR88.00.02 that a sorting cell can be in."""

    RESETTING = "RESETTING"
    STOPPED = "STOPPED"
    STARTING = "STARTING"
    EXECUTE = "EXECUTE"
    HOLDING = "HOLDING"
    HELD = "HELD"
    SUSPENDED = "SUSPENDED"
    STOPPING = "STOPPING"
    ABORTING = "ABORTING"
    ABORTED = "ABORTED"


class Pending(StrEnum):
    """What has been asked for and the cell has not yet done; `ABORT` is asked for by a fault.

    `PAUSED`: a pause was asked for and the arm stands, be it in the middle of a move.
    """

    STOP = "stop"
    PAUSE = "pause"
    PAUSED = "paused"
    ABORT = "abort"


_AT_WORK = (State.CAPTURE, State.DETECT, State.LOCALIZE, State.PICK, State.PLACE)
_RUNNING = (*_AT_WORK, State.HOMING, State.IDLE)

_TABLE: Mapping[tuple[State | None, Pending | None], PackML] = {
    # Before the cycle exists: devices are opened, calibration is read. Nothing can be started yet.
    (None, None): PackML.RESETTING,
    # Ready and still. PackML's own IDLE would lie between a reset and a start; this cell starts from STOPPED.
    (State.STOPPED, None): PackML.STOPPED,
    (State.HOMING, None): PackML.STARTING,
    **{(state, None): PackML.EXECUTE for state in _AT_WORK},
    # The cell's IDLE is PackML's SUSPENDED: it waits for parts, and goes on by itself when some come.
    (State.IDLE, None): PackML.SUSPENDED,
    (State.HELD, None): PackML.HELD,
    (State.FAULT, None): PackML.ABORTED,
    **{(state, Pending.STOP): PackML.STOPPING for state in (*_RUNNING, State.HELD)},
    **{(state, Pending.PAUSE): PackML.HOLDING for state in _RUNNING},
    **{(state, Pending.PAUSED): PackML.HELD for state in _RUNNING},
    **{(state, Pending.ABORT): PackML.ABORTING for state in (*_RUNNING, State.HELD)},
}


def packml(state: State | None, pending: Pending | None = None) -> PackML:
    """The outward name of a state; what is pending but already fulfilled makes no difference.

    Args:
        state: The cell's own, or None before the cycle exists.
        pending: What was asked for and is under way.
    """
    return _TABLE.get((state, pending)) or _TABLE[state, None]

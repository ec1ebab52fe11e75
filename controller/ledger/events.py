"""The words of the ledger's events that reports are made from."""

from __future__ import annotations

from enum import StrEnum

STATE = "state"
"""Kind of an event: the cell does something else from now on; details `doing`, and for holds and faults `code` (of the
fault catalogue), `cause` and `remedy`."""

OPERATOR = "operator"
"""Kind of an event: an operator's command was carried out; details `command`, `uid`."""

WARNING, EASED = "warning", "eased"
"""Kinds of events: something is not in order although the cell goes on (details `code`, `cause`, `remedy`), and is
again (details `code`)."""


class Doing(StrEnum):
    """What a cell spends its time with."""

    SORTING = "sorting"
    WAITING = "waiting"
    """Nothing to pick lies on the table."""
    HELD = "held"
    """For something that may pass: the camera is away, the disk is full."""
    PAUSED = "paused"
    FAULT = "fault"
    STOPPED = "stopped"

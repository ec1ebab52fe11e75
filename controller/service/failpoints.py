"""Failpoints: the moments around a record being written at which a script can let something go wrong.

They exist only in a simulated run that is given a script of faults; a real cell's ledger is never wrapped.
"""

from __future__ import annotations

from typing import Protocol

from controller.domain import Outcome, PickPlan
from controller.errors import LedgerError
from controller.ports import Ledger


class Director(Protocol):
    """Who lets a script's faults happen."""

    @property
    def ledger_unwritable(self) -> bool:
        """The disk takes no more."""
        ...

    def entered(self, point: str) -> None:
        """A failpoint is reached."""
        ...


class LedgerWithFailpoints:
    """A ledger with failpoints before and after every intent and every outcome, on a disk that may be full.

    Args:
        ledger: The real one.
        director: Told of every failpoint, and asked whether the disk is full.
    """

    def __init__(self, ledger: Ledger, director: Director) -> None:
        self._ledger = ledger
        self._director = director

    def intend(self, target_id: str, plan: PickPlan, attempt: int, at: float) -> None:
        """Commit the intent to pick."""
        self._director.entered("before_intend")
        self._refuse_if_full("record the intent")
        self._ledger.intend(target_id, plan, attempt, at)
        self._director.entered("after_intend")

    def conclude(self, outcome: Outcome) -> None:
        """Commit the one outcome of a target."""
        self._director.entered("before_conclude")
        self._refuse_if_full("record the outcome")
        self._ledger.conclude(outcome)
        self._director.entered("after_conclude")

    def note(self, kind: str, at: float, **details: object) -> None:
        """Commit an event."""
        self._refuse_if_full("record the event")
        self._ledger.note(kind, at, **details)

    def _refuse_if_full(self, operation: str) -> None:
        if self._director.ledger_unwritable:
            raise LedgerError(f"ledger: {operation}: database or disk is full", "free some space on that disk")

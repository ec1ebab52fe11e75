"""One outcome for every target that was tried: concluded here, put on record, and told."""

from __future__ import annotations

from contextlib import suppress

from controller.cycle.rig import Rig
from controller.cycle.targets import Target, TargetBook
from controller.domain import Outcome, Result
from controller.errors import LedgerError


class Outcomes:
    """Concludes the targets of a book.

    Attributes:
        concluded: How many have their outcome.
        at_work: What the arm is at work on, or None.

    Args:
        rig: The cell.
        book: The open targets.
    """

    def __init__(self, rig: Rig, book: TargetBook) -> None:
        self._rig, self._book = rig, book
        self._unwritten: list[Outcome] = []
        self.concluded = 0
        self.at_work: Target | None = None

    def conclude(self, target: Target, result: Result, reason: str) -> None:
        """Give a target its outcome. What cannot be written now is kept, and holds the cell before anything new."""
        now = self._rig.clock.now()
        outcome = Outcome(target.located, target.plan, result, reason, target.attempts, target.started_at, now)
        if result in (Result.GRASP_MISSED, Result.SKIPPED):
            self._book.give_up(target)
        else:
            self._book.close(target)
        self.concluded += 1
        self._unwritten.append(outcome)
        with suppress(LedgerError):
            self.write()

    def conclude_work(self, result: Result, reason: str) -> None:
        """Give what the arm is at work on its outcome, if it is at work."""
        if self.at_work is not None:
            self.conclude(self.at_work, result, reason)
            self.at_work = None

    def write(self) -> None:
        """Put on record what is not yet there, and tell it.

        Raises:
            LedgerError: The record takes no more.
        """
        while self._unwritten:
            self._rig.ledger.conclude(self._unwritten[0])
            outcome = self._unwritten.pop(0)
            for observer in self._rig.observers:
                observer.concluded(outcome)

    def give_up(self, target: Target) -> None:
        """A target that was tried and is nowhere to be seen."""
        if target.lost:
            self.conclude(target, Result.DROPPED, target.reason)
        else:
            self.conclude(target, Result.INDETERMINATE, f"gone after a missed grasp ({target.reason})")

    def conclude_open(self) -> None:
        """The end of the run: what was tried and lies there still.

        Raises:
            LedgerError: The record takes no more.
        """
        for target in self._book.open:
            if target.attempts:
                result = Result.DROPPED if target.lost else Result.GRASP_MISSED
                self.conclude(target, result, target.reason or "the run ended before the next attempt")
        self.write()

"""How a run ends: the first fault latches, the arm comes to rest where it may move, every target gets its outcome."""

from __future__ import annotations

from contextlib import suppress

from controller.cycle.motions import Motions
from controller.cycle.outcomes import Outcomes
from controller.cycle.requests import Requests
from controller.cycle.rig import Rig
from controller.domain import Result
from controller.errors import ArmError, LedgerError, SorterError


class Ending:
    """Ends the run of a rig; each way returns the trigger of the state that it leads to.

    Attributes:
        fault: The first fault, or None.

    Args:
        rig: The cell.
        requests: What is asked for from outside.
        motions: Of its arm.
        outcomes: Of the targets.
    """

    def __init__(self, rig: Rig, requests: Requests, motions: Motions, outcomes: Outcomes) -> None:
        self._rig, self._requests = rig, requests
        self._motions, self._outcomes = motions, outcomes
        self.fault: SorterError | None = None

    def stop(self) -> str:
        """Park and let go of the torque; the trigger says whether that went well."""
        try:
            self._outcomes.conclude_work(Result.ABORTED, "stopped while the arm was at work on it")
            self._motions.park()
        except SorterError as error:
            return self.latch(error)
        return "stopped"

    def latch(self, error: SorterError) -> str:
        """Keep the first fault, and bring the arm to rest if it may move."""
        if self.fault is None:
            self.fault = error
            # Nobody knows any more what becomes of the part that the arm was at work on.
            self._outcomes.conclude_work(Result.INDETERMINATE, f"fault: {error}")
            for observer in self._rig.observers:
                observer.faulted(error, self._rig.clock.now())
            self._come_to_rest()
        return "faulted"

    def fail(self) -> None:
        """The controller itself has failed: no trigger follows."""
        try:
            self._outcomes.conclude_work(Result.INDETERMINATE, "the controller failed")
        finally:
            self._come_to_rest()

    def _come_to_rest(self) -> None:
        """Park and let go of the torque when the arm may move and still does as it is told, else leave it holding."""
        # After a fault of the arm's own nothing moves; while it is paused, somebody may have a hand in its way.
        if isinstance(self.fault, ArmError) or self._requests.paused:
            return
        try:
            self._motions.park()
        except SorterError as error:
            # If the ledger cannot take it either, the next intent will hold the cell.
            with suppress(LedgerError):
                self._rig.ledger.note("park_failed", self._rig.clock.now(), reason=str(error))

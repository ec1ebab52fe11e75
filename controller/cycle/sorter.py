"""The sorting cycle: which state is at work, what holds it, and how it is asked from outside to stop, pause or change.

What each state does stands in `handlers`, how a run ends in `ending`, what a hold waits for in `holding`. Motion
happens only between `started` and `stopped`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from controller.cycle.ending import Ending
from controller.cycle.handlers import Handlers
from controller.cycle.holding import Holding
from controller.cycle.machine import CellMachine, State
from controller.cycle.motions import Motions
from controller.cycle.outcomes import Outcomes
from controller.cycle.requests import Interrupted, Requests
from controller.cycle.rig import Rig
from controller.cycle.targets import TargetBook
from controller.errors import CameraEnded, CameraError, Intruder, LedgerError, PartHeld, SorterError

_LOOKS_AGAIN = (State.CAPTURE, State.DETECT, State.LOCALIZE, State.PICK, State.IDLE)
"""States that do not begin after a pause before a new look: somebody may have changed the table."""


class Sorter:
    """Runs the cycle on a rig until it is stopped, faulted, or (when asked) nothing is left to pick.

    Attributes:
        machine: The cell's state.

    Args:
        rig: The cell.
        until_empty: Stop when the table is empty or nothing on it can be picked.
        most_parts: Stop after so many parts were dealt with; None for no limit.
        filled: Parts in each bin already, by name; counted up as they are placed.
        target_prefix: Makes the ids of this sorter's targets unique within a run of the ledger.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        until_empty: bool = False,
        most_parts: int | None = None,
        filled: Counter[str] | None = None,
        target_prefix: str = "t",
    ) -> None:
        self.machine = CellMachine()
        self._rig = rig
        self._requests = Requests(rig.arm)
        motions, book = Motions(rig), TargetBook(target_prefix)
        self._outcomes = Outcomes(rig, book)
        self._holding = Holding(rig, self._requests, self._outcomes, operated=not until_empty)
        self._ending = Ending(rig, self._requests, motions, self._outcomes)
        self._handlers = handlers = Handlers(
            rig, book, motions, self._outcomes, self._requests, self._holding,
            Counter() if filled is None else filled, until_empty=until_empty, most_parts=most_parts,
        )  # fmt: skip
        self._handler_of: dict[State, Callable[[], str]] = {
            State.HOMING: handlers.home,
            State.CAPTURE: handlers.capture,
            State.DETECT: handlers.detect,
            State.LOCALIZE: handlers.localize,
            State.PICK: handlers.pick,
            State.PLACE: handlers.place,
            State.IDLE: handlers.idle,
            State.HELD: self._hold,
        }

    @property
    def fault(self) -> SorterError | None:
        """The first fault, or None."""
        return self._ending.fault

    @property
    def left(self) -> int:
        """Objects seen by the last look and not dealt with since."""
        return self._handlers.left

    @property
    def cycle_times(self) -> list[float]:
        """From look to retreat, s, one for every part taken to a bin."""
        return self._handlers.cycle_times

    # --- from outside ---------------------------------------------------------------------------------

    def request_stop(self) -> None:
        """Stop along the path, park and let go of the torque; from any thread or signal handler."""
        self._requests.stop()

    def request_pause(self) -> None:
        """Hold on the path of the move under way, else before the next; from any thread. A stop ends it."""
        self._requests.pause()

    @property
    def holds(self) -> bool:
        """A pause is in force and the arm stands; from any thread."""
        return self._requests.stands

    def resume(self) -> None:
        """Go on after `request_pause`, or when what somebody has to put right is put right; from any thread."""
        self._requests.resume()

    def change(self, rig: Rig) -> None:
        """Work with another configuration from the next look on; from any thread.

        Args:
            rig: The same devices, record and observers.
        """
        self._handlers.next_rig = rig

    # --- the run --------------------------------------------------------------------------------------

    def run(self) -> None:
        """Sort. Moves metal, blocks until the cell is STOPPED or FAULT."""
        try:
            self._run()
        except BaseException:
            self._ending.fail()
            raise
        finally:
            self._requests.end_pause()
            self._handlers.close()

    def _run(self) -> None:
        self._fire("started")
        while self.machine.state not in (State.STOPPED, State.FAULT):
            try:
                trigger = self._step()
            except (Interrupted, CameraEnded):
                trigger = "stopped"
            except (CameraError, LedgerError, PartHeld, Intruder) as error:
                trigger = self._hold_for(error)
            except SorterError as error:
                trigger = self._ending.latch(error)
            if trigger == "stopped":
                trigger = self._ending.stop()
            self._fire(trigger)
        try:
            self._outcomes.conclude_open()
        except LedgerError as error:
            if self.fault is None:
                self._fire(self._ending.latch(error))

    def _step(self) -> str:
        """Do what the state asks for; nothing new begins before what has happened is on record."""
        if self._requests.stopped:
            return "stopped"
        if self.machine.state is not State.HELD:
            self._outcomes.write()
        if self._requests.was_paused and self.machine.state in _LOOKS_AGAIN:
            self._requests.took_pause()
            self._handlers.looker.forget()
            return "held"
        return self._handler_of[self.machine.state]()

    def _fire(self, trigger: str) -> None:
        if trigger == "held_on":
            return
        state = self.machine.fire(trigger)
        for observer in self._rig.observers:
            observer.entered(state, self._rig.clock.now())

    def _hold_for(self, error: SorterError) -> str:
        """Hold for something that may pass; where nobody operates the cell, not for ever."""
        self._handlers.looker.forget()
        try:
            self._holding.failed(error)
        except SorterError as lasting:
            return self._ending.latch(lasting)
        return "held_on" if self.machine.state is State.HELD else "held"

    def _hold(self) -> str:
        """What follows a hold; what was stopped on its way to a bin is still in the jaws, and goes on first."""
        trigger = self._holding.step(self._handlers.looker)
        return "carried_on" if trigger == "resumed" and self._outcomes.at_work is not None else trigger

"""Live progress of a run on stderr: one line that changes on a terminal, plain lines in a log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import TracebackType

from rich.console import Console
from rich.status import Status

from controller.cycle.machine import State
from controller.cycle.rig import Look, Observer
from controller.domain import Outcome, PickPlan, Result
from controller.errors import SorterError
from controller.service.faults import CATALOGUE

_DONE = (Result.PLACED, Result.REJECTED)


class Progress(Observer):
    """Says what the cell is doing; a context manager that owns the live line.

    Args:
        console: On stderr.
        rehearsal: Nothing is picked: outcomes are told as what they would be.
    """

    def __init__(self, console: Console, *, rehearsal: bool = False) -> None:
        self._console = console
        self._status = Status("starting", console=console) if console.is_terminal else None
        self._state = State.STOPPED
        self._seen = 0
        self._began: float | None = None
        self._count: Counter[Result] = Counter()
        self._as_if = "as if " if rehearsal else ""

    def __enter__(self) -> Progress:
        """Show the live line."""
        if self._status is not None:
            with suppress(OSError):
                self._status.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Take the live line away."""
        if self._status is not None:
            with suppress(OSError):
                self._status.stop()

    @contextmanager
    def away(self) -> Iterator[None]:
        """No live line inside: it would wipe out the question to a person that is on the screen."""
        self.__exit__(None, None, None)
        try:
            yield
        finally:
            self.__enter__()

    def say(self, line: str) -> None:
        """One lasting line. A terminal that was closed takes none: for that no run ends."""
        with suppress(OSError):
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def entered(self, state: State, at: float) -> None:
        """Show the state."""
        self._state = state
        if self._began is None:
            self._began = at
        self._update(at - self._began)

    def looked(self, look: Look) -> None:
        """Show how many objects lie on the table."""
        self._seen = len(look.located) + len(look.refused)

    def attempted(self, plan: PickPlan, attempt: int) -> None:
        """Say a retry."""
        if attempt > 1:
            self.say(f"  {self._name(plan)}: attempt {attempt}")

    def concluded(self, outcome: Outcome) -> None:
        """Say what became of a target."""
        self._count[outcome.result] += 1
        target = outcome.target
        what = target.detection.label or str(target.shape)
        where = f"{target.center[0]:6.1f} {target.center[1]:7.1f} mm"
        at = outcome.finished_at - (self._began or 0.0)
        self.say(f"{at:7.1f} s  {what:<10} {where}  {self._as_if}{outcome.result}: {outcome.reason}")

    def held(self, cause: SorterError, at: float) -> None:
        """Say what the cell holds for."""
        self.say(f"{at - (self._began or 0.0):7.1f} s  HELD: {cause}")

    def resumed(self, at: float) -> None:
        """Say that it is over."""
        self.say(f"{at - (self._began or 0.0):7.1f} s  goes on")

    def warned(self, code: str, cause: str, at: float) -> None:
        """Say what is not in order although the cell goes on."""
        self.say(f"{at - (self._began or 0.0):7.1f} s  warning: {cause}")

    def eased(self, code: str, at: float) -> None:
        """Say that it is over."""
        self.say(f"{at - (self._began or 0.0):7.1f} s  over: {CATALOGUE[code].name}")

    def faulted(self, error: SorterError, at: float) -> None:
        """Say the fault."""
        self.say(f"{at - (self._began or 0.0):7.1f} s  FAULT: {error}")

    def _update(self, at: float) -> None:
        if self._status is not None:
            done = sum(self._count[result] for result in _DONE)
            line = f"{at:6.1f} s  {self._state.value:<9} {done} placed, {self._seen} seen on the table"
            with suppress(OSError):
                self._status.update(line)

    @staticmethod
    def _name(plan: PickPlan) -> str:
        return f"{plan.target.detection.label or plan.target.shape} ({plan.target.target_id})"

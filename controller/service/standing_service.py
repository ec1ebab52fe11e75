"""A real cell as a service: the service manager, the supervisor and the operators' socket around one session."""

from __future__ import annotations

import contextlib
import faulthandler
from collections.abc import Callable
from dataclasses import dataclass

from controller.config.cell import CellConfig
from controller.domain import PickPlan
from controller.ports import Clock
from controller.service.client import runtime_folder
from controller.service.control import ControlServer, operators
from controller.service.notify import Notifier
from controller.service.operation import CellFacts, Operation
from controller.service.supervisor import Loop, Supervisor, WatchedClock

_SLOWEST_STEP_S = 5.0
"""A step of the cycle beside waiting for a frame: planning and vision on a slow computer, a report to a slow disk."""


@dataclass(frozen=True, slots=True)
class Service:
    """What a standing service consists of.

    Attributes:
        notifier: To the service manager; silent where there is none.
        supervisor: Reassures it while every loop moves.
        cycle: The loop of the cycle.
    """

    notifier: Notifier
    supervisor: Supervisor
    cycle: Loop

    @classmethod
    def standing_by(cls, config: CellConfig, stack: contextlib.ExitStack) -> Service:
        """Begin to be watched; ends with `stack`."""
        faulthandler.enable()
        notifier = Notifier.from_environment()
        supervisor = stack.enter_context(Supervisor(notifier.pet, notifier.watchdog))
        cycle = supervisor.register("cycle", patience=config.camera.frame_timeout_s + _SLOWEST_STEP_S)
        cycle.idle()
        return cls(notifier, supervisor, cycle)

    def watch(self, clock: Clock) -> Clock:
        """The cell's clock, every use of which is a sign of life."""
        return WatchedClock(clock, self.cycle)

    def while_idle(self, ask: Callable[[PickPlan], bool]) -> Callable[[PickPlan], bool]:
        """A question to a person, for whose answer the cycle may stand still as long as it takes."""

        def asked(plan: PickPlan) -> bool:
            self.cycle.idle()
            try:
                return ask(plan)
            finally:
                self.cycle.progress()

        return asked

    def operation(
        self,
        config: CellConfig,
        calibration_id: str,
        *,
        reload: Callable[[], tuple[str, ...]],
        emptied: Callable[[str | None], None],
        view_clear: Callable[[], None],
        cleared: Callable[[], None],
        recover: Callable[[], None],
    ) -> Operation:
        """What operators control; see `Operation`."""
        facts = CellFacts("real", config.name, config.digest, calibration_id)
        return Operation(
            facts,
            reload,
            emptied=emptied,
            view_clear=view_clear,
            cleared=cleared,
            recover=recover,
            say=self.notifier.status,
        )

    def open_to_operators(self, operation: Operation, commanded: Callable[[str, int], None]) -> ControlServer:
        """The control socket, as a context manager; see `ControlServer` for `commanded`."""
        loop = self.supervisor.register("control", patience=2.0)
        return ControlServer(
            runtime_folder(), operation, group=operators(), progress=loop.progress, commanded=commanded
        )

"""Where the time of a cycle goes: watchers before camera, arm and clock that note when each was at work."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, cast

from controller.backends import Devices
from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.domain import Trajectory
from controller.ports import Arm, Camera, Clock


@dataclass(frozen=True, slots=True)
class Span:
    """Something that took time.

    Attributes:
        lane: `state`, `camera`, `computing`, `arm` or `gripper`.
        name: What it was.
        begin, end: s of the cell's clock.
    """

    lane: str
    name: str
    begin: float
    end: float


@dataclass(slots=True)
class Timeline(Observer):
    """Notes spans; puts its watchers before the devices by `watch`.

    Attributes:
        spans: In the order in which they ended.
    """

    spans: list[Span] = field(default_factory=list)
    _state: tuple[State, float] | None = None
    _wanted_opening: float = 0.0

    def watch(self, devices: Devices) -> None:
        """Put a watcher before camera, arm and clock."""
        now = devices.clock.now
        self._wanted_opening = devices.arm.description.gripper.opening[1]
        lanes: Mapping[str, tuple[str, Callable[..., str]]] = {
            "follow": ("arm", self._move),
            "grip": ("gripper", self._grip),
        }
        devices.camera = cast(Camera, _Watched(devices.camera, self, now, {"capture": ("camera", _frame)}))
        devices.arm = cast(Arm, _Watched(devices.arm, self, now, lanes))
        devices.clock = cast(Clock, _Watched(devices.clock, self, now, {"charge": ("computing", self._charge)}))

    def entered(self, state: State, at: float) -> None:
        """The state before has ended."""
        if self._state is not None:
            self.spans.append(Span("state", self._state[0].value, self._state[1], at))
        self._state = state, at

    def worked_ahead(self, began: float, ended: float) -> None:
        """A look was worked out beside the arm's work."""
        self.spans.append(Span("computing", "look ahead", began, ended))

    @contextmanager
    def noting(self, lane: str, name: str, now: Callable[[], float]) -> Iterator[None]:
        """A span from here to the end of the `with` block, unless that fails."""
        begin = now()
        yield
        self.spans.append(Span(lane, name, begin, now()))

    def _move(self, trajectory: Trajectory, opening: float | None = None, *rest: Any, **options: Any) -> str:
        if opening is not None:
            self._wanted_opening = opening
        return trajectory.name

    def _grip(self, opening: float, *rest: Any, **options: Any) -> str:
        before, self._wanted_opening = self._wanted_opening, opening
        return "close" if opening < before else "open"

    def _charge(self, seconds: float) -> str:
        # What is charged for in PICK is the plan; in every other state it is a picture.
        return "planning" if self._state is not None and self._state[0] is State.PICK else "seeing"


def _frame(*arguments: Any, **options: Any) -> str:
    return "frame"


class _Watched:
    """Behaves as the device behind it, and notes when some of its methods are at work.

    Args:
        device: The device.
        timeline: Where to note it.
        now: Time of the cell's clock, s.
        lanes: By name of the method: the lane, and what gives the span's name from the arguments.
    """

    def __init__(
        self,
        device: object,
        timeline: Timeline,
        now: Callable[[], float],
        lanes: Mapping[str, tuple[str, Callable[..., str]]],
    ) -> None:
        self._device, self._timeline, self._now, self._lanes = device, timeline, now, lanes

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._device, name)
        if name not in self._lanes:
            return found
        lane, named = self._lanes[name]

        def noted(*arguments: Any, **options: Any) -> Any:
            with self._timeline.noting(lane, named(*arguments, **options), self._now):
                return found(*arguments, **options)

        return noted

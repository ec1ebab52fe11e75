"""Where the time of a cycle goes: watchers before camera, arm and clock that note when each was at work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from controller.backends import Devices
from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.domain import ArmDescription, ArmState, Frame, GripReport, MoveReport, Trajectory
from controller.ports import Arm, Camera, Clock


@dataclass(frozen=True, slots=True)
class Span:
    """Something that took time.

    Attributes:
        lane: `state`, `camera`, `arm`, `gripper` or `computing`.
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

    def watch(self, devices: Devices) -> None:
        """Put a watcher before camera, arm and clock."""
        now = devices.clock.now
        devices.camera = _WatchedCamera(devices.camera, self, now)
        devices.arm = _WatchedArm(devices.arm, self, now)
        devices.clock = _WatchedClock(devices.clock, self)

    def entered(self, state: State, at: float) -> None:
        """The state before has ended."""
        if self._state is not None:
            self.spans.append(Span("state", self._state[0].value, self._state[1], at))
        self._state = state, at

    @contextmanager
    def noting(self, lane: str, name: str, now: Callable[[], float]) -> Iterator[None]:
        """A span from here to the end of the `with` block, unless that fails."""
        begin = now()
        yield
        self.spans.append(Span(lane, name, begin, now()))


class _WatchedClock:
    """Behaves as the clock behind it."""

    def __init__(self, clock: Clock, timeline: Timeline) -> None:
        self._clock, self._timeline = clock, timeline

    def now(self) -> float:
        return self._clock.now()

    def sleep(self, seconds: float) -> None:
        self._clock.sleep(seconds)

    def charge(self, seconds: float) -> None:
        with self._timeline.noting("computing", f"{1e3 * seconds:.0f} ms", self.now):
            self._clock.charge(seconds)


class _WatchedCamera:
    """Behaves as the camera behind it."""

    def __init__(self, camera: Camera, timeline: Timeline, now: Callable[[], float]) -> None:
        self._camera, self._timeline, self._now = camera, timeline, now

    def open(self) -> None:
        self._camera.open()

    def close(self) -> None:
        self._camera.close()

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        with self._timeline.noting("camera", "frame", self._now):
            return self._camera.capture(after, timeout)


class _WatchedArm:
    """Behaves as the arm behind it."""

    def __init__(self, arm: Arm, timeline: Timeline, now: Callable[[], float]) -> None:
        self._arm, self._timeline, self._now = arm, timeline, now
        self._opening = arm.description.gripper.opening[1]

    @property
    def description(self) -> ArmDescription:
        return self._arm.description

    def open(self) -> None:
        self._arm.open()

    def close(self) -> None:
        self._arm.close()

    def energise(self) -> ArmState:
        return self._arm.energise()

    def relax(self) -> None:
        self._arm.relax()

    def state(self) -> ArmState:
        return self._arm.state()

    def follow(self, trajectory: Trajectory) -> MoveReport:
        with self._timeline.noting("arm", trajectory.name, self._now):
            return self._arm.follow(trajectory)

    def grip(self, opening: float, effort: float = 1.0) -> GripReport:
        name = "close" if opening < self._opening else "open"
        with self._timeline.noting("gripper", name, self._now):
            report = self._arm.grip(opening, effort)
        self._opening = report.opening
        return report

    def request_stop(self) -> None:
        self._arm.request_stop()

    def clear_stop(self) -> None:
        self._arm.clear_stop()

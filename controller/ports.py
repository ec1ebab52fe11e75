"""The ports: what the core asks of a camera, an arm, a clock, a ledger and a byte stream.

A driver and its simulated twin satisfy the same Protocol and the same contract suite in `tests/contract`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from controller.domain import (
    ArmDescription,
    ArmState,
    Frame,
    GripReport,
    MoveReport,
    Outcome,
    PickPlan,
    ServoCycle,
    Trajectory,
    TruePart,
)


@runtime_checkable
class Clock(Protocol):
    """The only source of time: monotonic seconds."""

    def now(self) -> float:
        """Seconds since an arbitrary start; never goes back."""
        ...

    def sleep(self, seconds: float) -> None:
        """Return not before `seconds` have passed on this clock."""
        ...

    def charge(self, seconds: float) -> None:
        """Account for computing that took real time: a simulated clock advances, a real one does nothing."""
        ...


@runtime_checkable
class Camera(Protocol):
    """A source of frames."""

    def open(self) -> None:
        """Make frames available.

        Raises:
            CameraLost: There is no such device, or it cannot be opened.
        """
        ...

    def close(self) -> None:
        """Release the device; harmless when it is not open."""
        ...

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        """The newest frame whose exposure began at or after `after` (s of the cell's clock).

        Blocks until there is one; never returns an older frame.

        Raises:
            FrameStale: None arrived within `timeout` seconds of the cell's clock.
            CameraLost: The device is gone, or (replay) the pictures have ended.
        """
        ...


GLANCE_SCALE = 8
"""How much smaller than its frames a camera's glances are, in both directions."""

GLANCE_PERIOD = 0.1
"""s between two glances at least: in it a hand reaches 90 mm, and a tenth of a core decodes what one needs."""


@runtime_checkable
class GlanceSource(Protocol):
    """A camera that shows what comes while nobody waits for a frame."""

    def glance(self, listener: Callable[[Frame], None] | None) -> None:
        """Have frames told as they come from now on, averaged down by `GLANCE_SCALE`; None: no longer.

        The listener is called where the frames come from, a thread or the simulated world, at most once every
        `GLANCE_PERIOD`, and must neither block nor raise.
        """
        ...


@runtime_checkable
class Arm(Protocol):
    """A serial arm with a parallel gripper. Only `energise`, `follow` and `grip` move metal."""

    @property
    def description(self) -> ArmDescription:
        """What kind of arm this is."""
        ...

    def open(self, *, restart: bool = False) -> None:
        """Connect, check every servo against the description and set it up. Moves nothing, torque stays off.

        Args:
            restart: Restart the servos that have shut themselves down: only when a person has seen to the cause.

        Raises:
            BusError: The port or a servo does not answer.
            ServoFault: A servo reports a hardware error.
        """
        ...

    def close(self) -> None:
        """Disconnect; harmless when not open. Torque is left as it is: `relax` first."""
        ...

    def energise(self) -> ArmState:
        """Torque on where the arm stands: goals are set to the present position first."""
        ...

    def relax(self) -> None:
        """Torque off at every servo, whatever single servos answer. The arm may sink: park it first."""
        ...

    def state(self) -> ArmState:
        """What the servos say now.

        Raises:
            BusError: A servo did not answer; no value is ever made up.
            ServoFault: A servo reports a hardware error.
        """
        ...

    def follow(self, trajectory: Trajectory, opening: float | None = None, after: float = 0.0) -> MoveReport:
        """Stream a trajectory to the servos; blocks until it has ended and the joints are settled.

        It must start where the arm stands. `request_stop` slows it down along its path.

        Args:
            trajectory: The joints over time.
            opening: Clear opening (mm) that the empty jaws take on the way; None leaves them as they are.
            after: When on the way the jaws begin, s along the trajectory.

        Raises:
            LimitViolation: The trajectory does not start at the arm's present position; nothing moved.
            MotionTimeout: A joint does not follow.
            BusError: The bus failed for longer than a few cycles; the goals are held.
            ServoFault: A servo reports a hardware error.
        """
        ...

    def grip(self, opening: float, effort: float = 1.0) -> GripReport:
        """Move the jaws to a clear opening (mm) or until they stop on something; blocks.

        Args:
            opening: Wanted clear opening, mm; clipped to what the gripper can do.
            effort: Fraction of the gripper's rated holding force, in (0, 1].
        """
        ...

    def request_stop(self) -> None:
        """End the running move early, slowing along its path; from any thread or signal handler, at once.

        Moves asked for afterwards end at once, unfinished, until `clear_stop`.
        """
        ...

    def clear_stop(self) -> None:
        """Allow motion again after `request_stop`. Moves nothing."""
        ...

    def pause(self) -> None:
        """Slow the running move down along its path and hold there, torque on, until `resume`; from any thread.

        A move or grip asked for while paused waits at its start. A grip under way ends; `request_stop` still ends a
        move.
        """
        ...

    def resume(self) -> None:
        """Go on from there; from any thread. Moves metal when a move is under way."""
        ...

    @property
    def holds(self) -> bool:
        """A pause is in force, and the arm has come to stand; from any thread."""
        ...


@runtime_checkable
class CycleSource(Protocol):
    """An arm that can be listened to while it moves."""

    def listen(self, listener: Callable[[ServoCycle], None] | None) -> None:
        """Have every complete cycle of a streamed move told from now on; None: no longer.

        The listener runs inside the motion loop and must not block.
        """
        ...


@runtime_checkable
class Ledger(Protocol):
    """The durable record: intent before motion, outcome after, exactly one outcome a target."""

    def intend(self, target_id: str, plan: PickPlan, attempt: int, at: float) -> None:
        """Commit the intent to pick; returns only when it would survive a loss of power."""
        ...

    def conclude(self, outcome: Outcome) -> None:
        """Commit the one outcome of a target.

        Raises:
            ValueError: The target already has an outcome.
        """
        ...

    def note(self, kind: str, at: float, **details: object) -> None:
        """Commit an event (start, stop, fault, reset, ...)."""
        ...


@runtime_checkable
class ByteStream(Protocol):
    """A half-duplex line to the servo bus: a serial port, or the simulated bus."""

    @property
    def name(self) -> str:
        """For messages, e.g. `/dev/ttyUSB0`."""
        ...

    def open(self, baud: int) -> None:
        """Open exclusively at `baud` bit/s.

        Raises:
            BusError: code `lost` (no such port), `busy` (held by another process) or `refused`.
        """
        ...

    def close(self) -> None:
        """Release the line; harmless when not open. It can be opened again."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes; returns when they are handed over, not when they are on the wire.

        Raises:
            BusError: code `lost`.
        """
        ...

    def read(self, size: int, timeout: float) -> bytes:
        """Up to `size` bytes as soon as any have arrived; empty after `timeout` seconds without one.

        Raises:
            BusError: code `lost`.
        """
        ...

    def discard_input(self) -> None:
        """Drop what has arrived but was not read.

        Raises:
            BusError: code `lost`.
        """
        ...


@runtime_checkable
class Presenter(Protocol):
    """A pair of hands that shows printed calibration boards to the camera: a person, or the simulated world."""

    def hold(self, print_: NDArray[np.uint8], pixel_mm: float, T_camera_board: NDArray[np.float64]) -> None:
        """Hold a stiff print before the camera, roughly at the wanted pose, until told otherwise.

        Args:
            print_: ndarray of shape (H, W), dtype uint8: the printed picture, first row at the top.
            pixel_mm: Size of one of its pixels on paper, mm.
            T_camera_board: ndarray of shape (4, 4), maps the board (origin in the middle of the print,
                x to its right, y to its bottom, z away from the reader, mm) into `camera`.
        """
        ...

    def lay(self, print_: NDArray[np.uint8], pixel_mm: float) -> None:
        """Lay a print on the table at the mark that defines `table`: origin in the middle of the print,
        x to its right, y to its top, z up.
        """
        ...

    def remove(self) -> None:
        """Take the print away."""
        ...


@runtime_checkable
class Truth(Protocol):
    """What a simulated world can be asked by whoever judges a run; never by the controller."""

    def now(self) -> Sequence[TruePart]:
        """Every part as it is now."""
        ...

    def at(self, at: float) -> Sequence[TruePart]:
        """Every part as it was at a past time of the cell's clock."""
        ...

    def tool(self) -> tuple[float, float, float]:
        """Where the grasp point is now: (x, y, z) in `table`, mm."""
        ...

    def collisions(self) -> int:
        """How often arm or part touched what they should not touch, so far."""
        ...

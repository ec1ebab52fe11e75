"""From a frame to the things on the table; the next look is worked out while the arm still places.

Looking ahead is one future: begun when the arm stands over a bin and the camera sees past it, consumed by the next
look. What the picture shows can have changed since by other hands only, and for that there is the pick proof.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.cycle.doubt import doubted
from controller.cycle.guard import Guard
from controller.cycle.rig import Rig
from controller.cycle.source import still_shows
from controller.cycle.view import Backdrop, reaching_under, region_mask
from controller.domain import Array, Detection, Frame, LocatedObject
from controller.errors import CameraError
from controller.localization.locate import Located, locate
from controller.vision.detect import Detected, detect


@dataclass(frozen=True, slots=True)
class _Ahead:
    """A look under way: its frame, what becomes of it, and when it was begun (s of the cell's clock)."""

    frame: Frame
    detected: Future[Detected]
    began: float


class Looker:
    """Looks at the table of a rig; `close` ends its thread.

    Attributes:
        guard: Tells what should not be over the table.

    Args:
        rig: The cell.
        pose_at: Where the joints stood at a time (s of the cell's clock): ndarray of shape (J,), rad.
    """

    def __init__(self, rig: Rig, pose_at: Callable[[float], Array]) -> None:
        self._rig, self._pose_at = rig, pose_at
        self._plane = rig.calibration.plane(rig.config.shape_plane_mm)
        self._region: NDArray[np.uint8] | None = None
        self._backdrop: Backdrop | None = None
        self.guard = Guard(rig.config, rig.calibration, rig.clear_view, rig.arm.description.gripper.opening[1])
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="look-ahead")
        self._ahead: _Ahead | None = None

    def close(self) -> None:
        """End the thread; nothing is looked at afterwards."""
        self.forget()
        self._worker.shutdown()

    def look_ahead(self, since: float) -> None:
        """Take the newest frame begun after `since` (s of the cell's clock), and begin to work it out.

        A camera that fails is no concern of the part that is being placed: the next look will meet it.
        """
        self.forget()
        with suppress(CameraError):
            frame = self._rig.camera.capture(since, self._rig.config.camera.frame_timeout_s)
            began = self._rig.clock.now()
            self._ahead = _Ahead(frame, self._worker.submit(self._detect, frame, self._hidden(frame)), began)

    def forget(self) -> None:
        """What was begun ahead is not wanted: something has happened since."""
        if self._ahead is not None:
            self._ahead.detected.cancel()
            self._ahead = None

    @property
    def is_ahead(self) -> bool:
        """The next look is under way already."""
        return self._ahead is not None

    def shows_still(self, taken: Detection) -> bool:
        """Whether the look under way shows a part where it was taken from; not, when no look is under way."""
        return self._ahead is not None and still_shows(taken, self._ahead.frame)

    def capture(self, after: float) -> Frame:
        """The frame of the next look: the one taken ahead, else a new one begun after `after`.

        Raises:
            CameraError: See `Camera.capture`.
        """
        if self._ahead is not None:
            return self._ahead.frame
        return self._rig.camera.capture(after, self._rig.config.camera.frame_timeout_s)

    def detect(self, frame: Frame) -> Detected:
        """What vision finds in the frame of this look; charges what of its budget was not yet spent.

        Raises:
            Intruder: Something reaches over the table.
        """
        clock, budget = self._rig.clock, self._rig.config.cycle.vision_budget_s
        ahead, self._ahead = self._ahead, None
        if ahead is None:
            detected = self._detect(frame, self._hidden(frame))
            clock.charge(budget)
        else:
            detected = ahead.detected.result()
            if (rest := ahead.began + budget - clock.now()) > 0.0:
                clock.charge(rest)
            for observer in self._rig.observers:
                observer.worked_ahead(ahead.began, ahead.began + budget)
        self.guard.check_frame(frame, self._arm_hides)
        return detected

    def locate(self, detected: Detected) -> tuple[Located, list[LocatedObject]]:
        """Where the detections of a look are, and those of them that are no dirt; what is in doubt has no name.

        Raises:
            Intruder: One is larger than any part.
        """
        config = self._rig.config
        found = locate(detected.detections, self._rig.calibration, self._rig.part_height)
        self.guard.check_things(found)
        things = [thing for thing in found.objects if thing.size[0] >= config.vision.smallest_mm]
        return found, [doubted(thing, config.vision.narrowest_mm) for thing in things]

    def under_the_arm(self, frame: Frame, things: Sequence[LocatedObject]) -> tuple[LocatedObject, ...]:
        """What of some things of no known shape may lie under the arm as it stood in a frame; see `reaching_under`."""
        hidden = self._arm_hides(frame.captured_at)
        return reaching_under(things, hidden, self._rig.arm.description.gripper.opening[1])

    def check(self, frame: Frame) -> None:
        """Look for nothing but what should not be there.

        Raises:
            Intruder: A hand, or something larger than any part, is over the table.
        """
        self.guard.check_frame(frame, self._arm_hides)
        self.locate(self._detect(frame, self._hidden(frame)))

    def _detect(self, frame: Frame, hidden: NDArray[np.uint8]) -> Detected:
        assert self._region is not None
        rig = self._rig
        return detect(
            frame, rig.recipe, plane=self._plane, region=self._region, hidden=hidden, classes=rig.classes
        )

    def _hidden(self, frame: Frame) -> NDArray[np.uint8]:
        """Where nothing is to be looked for in a frame, by what is known of the cell and its arm."""
        rig = self._rig
        if self._region is None or self._backdrop is None or self._region.shape != frame.image.shape[:2]:
            self._region = region_mask(rig.config, rig.calibration, frame.size)
            self._backdrop = Backdrop(rig.config, rig.calibration, frame.size)
        return self._backdrop.mask(self._arm_hides(frame.captured_at))

    def _arm_hides(self, at: float) -> Array:
        """What of the table the arm hid at a time, s of the cell's clock; see `Planner.hidden`."""
        return self._rig.planner.hidden(self._pose_at(at))

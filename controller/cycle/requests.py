"""What is asked of a running cycle from outside: stop, pause, go on; from any thread or signal handler."""

from __future__ import annotations

from controller.ports import Arm


class Interrupted(Exception):
    """A move, or a question to a person, was ended early by a stop."""


class Requests:
    """Keeps what was asked for, and tells the arm at once.

    Plain flags: a signal's handler may set one in the thread that is about to clear it, and must not wait for a lock.

    Args:
        arm: The cell's.
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._stop = False
        self._pause = False
        self._was_paused = False
        self._go_on = False

    def stop(self) -> None:
        """Let the arm end its move along the path; a stop is for good, and ends a pause."""
        self._stop = True
        self._arm.request_stop()
        self.end_pause()

    def pause(self) -> None:
        """Hold on the path of the move under way, else before the next. A stop ends it."""
        self._pause = True
        self._was_paused = True
        self._arm.pause()
        if self._stop:
            self.end_pause()

    def resume(self) -> None:
        """Go on after a pause, or when what somebody has to put right is put right."""
        self.end_pause()
        self._go_on = True

    def end_pause(self) -> None:
        """No pause is in force any more."""
        self._pause = False
        self._arm.resume()

    def halt(self) -> None:
        """End the move under way along its path, and begin no other before `end_halt`; from any thread."""
        self._arm.request_stop()

    def end_halt(self) -> None:
        """The arm may be moved again, unless somebody has asked for a stop meanwhile."""
        self._arm.clear_stop()
        if self.stopped:
            self._arm.request_stop()

    @property
    def stopped(self) -> bool:
        """Somebody has asked for a stop."""
        return self._stop

    @property
    def paused(self) -> bool:
        """A pause is in force."""
        return self._pause

    @property
    def stands(self) -> bool:
        """A pause is in force, and the arm has come to stand."""
        return self.paused and self._arm.holds

    @property
    def was_paused(self) -> bool:
        """There was a pause since `took_pause` was called last."""
        return self._was_paused

    def took_pause(self) -> None:
        """What follows from a pause is done."""
        self._was_paused = False

    @property
    def may_go_on(self) -> bool:
        """Somebody has said to go on since `must_be_told` was called last."""
        return self._go_on

    def must_be_told(self) -> None:
        """What was said before does not count for what comes."""
        self._go_on = False

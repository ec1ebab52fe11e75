"""Requests of the control socket: from a line to a call, and from what became of the call to a reply."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from controller.errors import SorterError
from controller.service.controls import Controls, Refused

_log = logging.getLogger(__name__)

READING = ("status", "alarms")
"""Commands that change nothing."""
CHANGING = ("start", "pause", "resume", "reset", "acknowledge", "emptied", "reload")
"""Commands of which only one is worked on at a time."""
_MOVING = ("start", "resume")


class BadRequest(Exception):
    """A request that is answered with an error instead of being carried out."""

    def __init__(self, code: str, cause: str, remedy: str = "") -> None:
        super().__init__(cause)
        self.error = {"code": code, "cause": cause, "remedy": remedy}


@dataclass(frozen=True, slots=True)
class Request:
    """One request, not yet checked beyond its form.

    Attributes:
        id: The caller's, text or whole number, to come back with the reply.
        command: Its name.
        given: What else it holds.
    """

    id: str | int | None
    command: object
    given: Mapping[str, Any]


def parse(line: bytes) -> Request:
    """A line as a request.

    Raises:
        BadRequest: It is not a JSON object, or its id is of no use.
    """
    try:
        content = json.loads(line.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise BadRequest("bad_request", f"not JSON: {error}", "send one JSON object a line") from error
    if not isinstance(content, dict):
        raise BadRequest("bad_request", "not a JSON object", 'send {"command": "status"}')
    ident = content.pop("id", None)
    if not isinstance(ident, str | int | None):
        raise BadRequest("bad_request", "id is neither a text nor a whole number")
    return Request(ident, content.pop("command", None), content)


def outcome(work: Callable[[], object]) -> dict[str, object]:
    """Carry out a call; what became of it, as a reply without its id."""
    try:
        return {"ok": True, "result": work()}
    except SorterError as error:
        code = "refused" if isinstance(error, Refused) else "failed"
        return failure({"code": code, "cause": error.cause, "remedy": error.remedy})
    except Exception:  # the server must outlive a mistake in a command, above all for the sake of `stop`
        _log.exception("a command failed")
        return failure({"code": "failed", "cause": "internal error", "remedy": "see the log"})


def failure(error: Mapping[str, str]) -> dict[str, object]:
    """A reply that says what was wrong."""
    return {"ok": False, "error": dict(error)}


class Commands:
    """The commands as calls on a cell; sees to it that nothing asked for before a stop moves metal after it.

    Args:
        controls: The cell.
    """

    def __init__(self, controls: Controls) -> None:
        self._controls = controls
        self._stops = 0
        self._lock = threading.Lock()

    def stop(self) -> None:
        """Stop at once; whatever else is under way."""
        with self._lock:
            self._stops += 1
        self._controls.stop()

    def call(self, request: Request) -> Callable[[], object]:
        """What a request other than `stop` means, to be called by a thread that may take its time.

        Raises:
            BadRequest: There is no such command, or it takes no such argument.
        """
        controls, command, given = self._controls, request.command, dict(request.given)
        calls: dict[str, Callable[[], object]] = {
            "status": lambda: controls.status().to_json(),
            "alarms": lambda: [alarm.to_json() for alarm in controls.alarms()],
            "reload": lambda: list(controls.reload()),
            "pause": lambda: self._changed(controls.pause),
            "reset": lambda: self._changed(controls.reset),
            "resume": self._unless_stopped("resume", controls.resume),
        }
        if command == "start":
            view_clear = given.pop("view_clear", False)
            if not isinstance(view_clear, bool):
                raise BadRequest("bad_request", "view_clear is neither true nor false")
            calls["start"] = self._unless_stopped("start", lambda: controls.start(view_clear=view_clear))
        if command == "acknowledge":
            number = given.pop("alarm", None)
            if isinstance(number, bool) or not isinstance(number, int | None):
                raise BadRequest("bad_request", "alarm is not the number of an alarm")
            calls["acknowledge"] = lambda: controls.acknowledge(number)
        if command == "emptied":
            name = given.pop("bin", None)
            if not isinstance(name, str | None):
                raise BadRequest("bad_request", "bin is not the name of a bin")
            calls["emptied"] = lambda: controls.emptied(name)
        if not isinstance(command, str) or command not in calls:
            known = ", ".join(sorted([*READING, *CHANGING, "stop"]))
            raise BadRequest("unknown_command", f"no command {command!r:.60}", f"commands: {known}")
        if given:
            raise BadRequest("bad_request", f"{command} takes no {next(iter(given))!r:.60}")
        return calls[command]

    def _changed(self, change: Callable[[], None]) -> dict[str, object]:
        change()
        return self._controls.status().to_json()

    def _unless_stopped(self, name: str, change: Callable[[], None]) -> Callable[[], object]:
        """A command that moves metal, void when a stop comes between its arrival and its end."""
        before = self._stops

        def overtaken() -> bool:
            with self._lock:
                return self._stops != before

        def call() -> object:
            if not overtaken():
                change()
                if not overtaken():
                    return self._controls.status().to_json()
                # The stop found nothing to stop yet: what has begun since then ends now.
                self._controls.stop()
            raise Refused(f"{name} was overtaken by a stop", "ask again when the cell has stopped")

        return call

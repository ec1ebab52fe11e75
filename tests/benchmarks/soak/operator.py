"""The operator at the control socket: starts, puts right, resets, resumes."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from controller.errors import SorterError
from controller.service.client import CommandFailed, ControlClient
from controller.service.session import Session


def ask(operator: ControlClient, command: str) -> None:
    """Give a command; ask again for as long as another command is being worked on."""
    while True:
        try:
            operator.ask(command)
        except CommandFailed as error:
            if error.code not in ("busy", "too_fast"):
                raise
            time.sleep(0.01)
        else:
            return


def operate(over: threading.Event, repair: Callable[[], None], session: Session) -> None:
    """The operator: starts, puts right, resets, resumes, until it is over; then stops the service.

    Args:
        over: Set when the soak is.
        repair: Mends what has latched.
        session: Is stopped in the end.
    """
    operator = ControlClient(Path(os.environ["STATE_DIRECTORY"]))
    try:
        while not over.wait(0.05):
            with suppress(SorterError):
                _operate_once(operator, repair)
    finally:
        session.stop()


def _operate_once(operator: ControlClient, repair: Callable[[], None]) -> None:
    status = operator.ask("status")
    active = [alarm["code"] for alarm in status["alarms"] if alarm["active"]]
    if status["state"] == "ABORTED":
        repair()
        operator.ask("reset")
    elif status["state"] == "STOPPED":
        operator.ask("start")
    elif status["state"] == "HELD" and "part_held" in active:
        operator.ask("resume")
    if status["alarms"]:
        operator.ask("acknowledge")

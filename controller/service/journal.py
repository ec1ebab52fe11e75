"""Logs: structured into the systemd journal when that is where stderr goes, readable lines otherwise; never a flood.

Every record is stamped with what the cell was doing, so that `journalctl CYCLE_ID=t12` or `FAULT_CODE=camera_lost`
finds it. Fields beyond the message come from logging's `extra`: `state`, `cycle_id`, `fault_code`, `message_id`.
"""

from __future__ import annotations

import logging
import os
import socket
import struct
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from controller.cycle.machine import State
from controller.cycle.rig import Observer
from controller.domain import Outcome, PickPlan, Result
from controller.errors import SorterError
from controller.service.faults import fault_code

JOURNAL = Path("/run/systemd/journal/socket")
IDENTIFIER = "sorting-controller"
# Identities for `journalctl MESSAGE_ID=...`, one a kind of event; made once at random (systemd-id128 new).
FAULT_ID = "5b0d6ac3f2a84e2f9d0a4c1b7e93d815"
OUTCOME_ID = "c1f4a7e09b3d4d5c8a62e7f05d1b9326"
STATE_ID = "8e2f6d41a0c7433bb5d9134f7a60ce58"

_OWN = ("controller", "drivers", "sim_backends")
_FIELDS = ("state", "cycle_id", "fault_code", "message_id")
_LONGEST = 48_000  # bytes of a value: a datagram must fit into the socket's send buffer, 208 KiB by default
_SEND_TIMEOUT = 0.2  # s; a journal that is stuck must not hold up the cell
_SILENT = logging.Logger("silent", logging.CRITICAL + 1)


class JournalHandler(logging.Handler):
    """Sends records to the journal with its own datagram protocol; what it does not take goes to `fallback`.

    Args:
        address: Of the journal's socket.
        fallback: Takes what the journal does not.

    Source: https://systemd.io/JOURNAL_NATIVE_PROTOCOL/, systemd.journal-fields(7).
    """

    def __init__(self, address: Path, fallback: logging.Handler) -> None:
        super().__init__()
        self._address = str(address)
        self._fallback = fallback

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        try:
            data = b"".join(_field(name, value) for name, value in self._fields(record).items())
        except Exception:  # as everywhere in logging: a message with a wrong argument must not stop the caller
            self.handleError(record)
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as line:
                line.settimeout(_SEND_TIMEOUT)
                line.sendto(data, self._address)
        except OSError:
            self._fallback.handle(record)

    def _fields(self, record: logging.LogRecord) -> dict[str, str]:
        fields = {
            "MESSAGE": self.format(record),
            "PRIORITY": str(_priority(record.levelno)),
            "SYSLOG_IDENTIFIER": IDENTIFIER,
            "LOGGER": record.name,
            "CODE_FILE": record.pathname,
            "CODE_LINE": str(record.lineno),
            "CODE_FUNC": record.funcName or "",
        }
        return fields | {name.upper(): str(value) for name in _FIELDS if (value := getattr(record, name, ""))}


class Lines(logging.Formatter):
    """Readable lines: time, level, where from, message, and what the cell was doing."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(name)s: %(message)s", "%H:%M:%S")

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The line, with the fields that are set behind it."""
        stamps = [(name, getattr(record, name, "")) for name in ("state", "cycle_id", "fault_code")]
        shown = " ".join(f"{name}={value}" for name, value in stamps if value)
        return super().formatMessage(record) + (f" [{shown}]" if shown else "")


class RateLimit(logging.Filter):
    """Lets through so many records of a kind in a while, and says how many it has held back.

    Args:
        burst: Records of one kind (same logger, level and text before its values are filled in).
        interval: s after which a kind may send as many again.
        now: Monotonic seconds.
    """

    _MOST_KINDS = 256

    def __init__(self, burst: int = 20, interval: float = 30.0, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._burst = burst
        self._interval = interval
        self._now = now
        self._kinds: OrderedDict[tuple[str, int, str], tuple[float, int]] = OrderedDict()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record may pass; one that follows others held back says so."""
        kind = (record.name, record.levelno, str(record.msg))
        now = self._now()
        began, seen = self._kinds.pop(kind, (now, 0))
        if now - began >= self._interval:
            held_back = max(seen - self._burst, 0)
            began, seen = now, 0
            if held_back:
                record.msg = f"{record.msg} ({held_back} more like this in the last {self._interval:g} s were left out)"
        self._kinds[kind] = (began, seen + 1)
        if len(self._kinds) > self._MOST_KINDS:
            self._kinds.popitem(last=False)
        return seen < self._burst


class CycleLog(Observer, logging.Filter):
    """Logs what the cell does, and stamps every other record with the state and the part it was at work on.

    As an observer it listens to the cycle; as a filter on a handler it stamps.

    Args:
        aloud: Logs what the cell does; without, it only stamps, because something else tells people.
    """

    def __init__(self, *, aloud: bool = True) -> None:
        logging.Filter.__init__(self)
        self._log = logging.getLogger("controller.cycle") if aloud else _SILENT
        self._state = ""
        self._cycle_id = ""

    def filter(self, record: logging.LogRecord) -> bool:
        """Stamp a record; all pass."""
        for name, value in (("state", self._state), ("cycle_id", self._cycle_id)):
            if not hasattr(record, name):
                setattr(record, name, value)
        return True

    def entered(self, state: State, at: float) -> None:
        """Note the state; changes that matter to people are logged above debug level."""
        before, self._state = self._state, state.value
        level = logging.INFO if state in (State.STOPPED, State.HELD, State.FAULT) else logging.DEBUG
        self._log.log(level, "%s after %s", state.value, before or "start", extra={"message_id": STATE_ID})

    def attempted(self, plan: PickPlan, attempt: int) -> None:
        """Note the part."""
        self._cycle_id = plan.target.target_id
        self._log.debug("attempt %d at a %s for %s", attempt, plan.target.detection.label, plan.bin.name)

    def concluded(self, outcome: Outcome) -> None:
        """Log what became of a part."""
        level = logging.INFO if outcome.result in (Result.PLACED, Result.REJECTED) else logging.WARNING
        self._log.log(
            level,
            "%s: %s: %s",
            outcome.target.detection.label,
            outcome.result,
            outcome.reason,
            extra={"message_id": OUTCOME_ID, "cycle_id": outcome.target.target_id},
        )
        self._cycle_id = ""

    def held(self, cause: SorterError, at: float) -> None:
        """Log what holds the cell."""
        self._log.warning("held: %s", cause, extra={"message_id": FAULT_ID, "fault_code": fault_code(cause)})

    def resumed(self, at: float) -> None:
        """Log that it is over."""
        self._log.info("what the cell held for is over")

    def warned(self, code: str, cause: str, at: float) -> None:
        """Log what is not in order although the cell goes on."""
        self._log.warning("%s", cause, extra={"message_id": FAULT_ID, "fault_code": code})

    def eased(self, code: str, at: float) -> None:
        """Log that it is over."""
        self._log.info("%s is over", code, extra={"fault_code": code})

    def faulted(self, error: SorterError, at: float) -> None:
        """Log the fault that has latched."""
        self._log.error("%s", error, extra={"message_id": FAULT_ID, "fault_code": fault_code(error)})


@contextmanager
def logging_to_its_place(
    *filters: logging.Filter,
    level: int = logging.INFO,
    stream: TextIO | None = None,
    environment: Mapping[str, str] | None = None,
    journal: Path = JOURNAL,
) -> Iterator[None]:
    """Send the program's log where it belongs, as long as the context lasts.

    Args:
        filters: Put on the handler before the rate limit, e.g. a `CycleLog`.
        level: Lowest level of the program's own records.
        stream: For readable lines, when it is not the journal; stderr by default.
        environment: In place of the process's.
        journal: The journal's socket.
    """
    stream = stream or sys.stderr
    lines = logging.StreamHandler(stream)
    lines.setFormatter(Lines())
    to_journal = goes_to_journal(stream, environment)
    handler: logging.Handler = JournalHandler(journal, lines) if to_journal else lines
    for filter_ in (*filters, RateLimit()):
        handler.addFilter(filter_)
    # Libraries are heard from warnings on: one logs every transition of the cycle.
    levels = {logging.getLogger(): logging.WARNING} | {logging.getLogger(name): level for name in _OWN}
    before = {logger: logger.level for logger in levels}
    logging.getLogger().addHandler(handler)
    try:
        for logger, least in levels.items():
            logger.setLevel(least)
        yield
    finally:
        logging.getLogger().removeHandler(handler)
        for logger, least in before.items():
            logger.setLevel(least)


def goes_to_journal(stream: TextIO | None = None, environment: Mapping[str, str] | None = None) -> bool:
    """Whether what is written to `stream` (stderr by default) ends in the journal anyway.

    Source: systemd.exec(5), $JOURNAL_STREAM.
    """
    try:
        found = os.fstat((stream or sys.stderr).fileno())
    except (OSError, ValueError, AttributeError):
        return False
    wanted = (os.environ if environment is None else environment).get("JOURNAL_STREAM")
    return wanted == f"{found.st_dev}:{found.st_ino}"


def _field(name: str, value: str) -> bytes:
    data = value.encode("utf-8", "replace")[:_LONGEST].decode("utf-8", "ignore").encode()
    if b"\n" not in data:
        return name.encode() + b"=" + data + b"\n"
    return name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n"


def _priority(level: int) -> int:
    """The level of syslog(3) for logging's."""
    for least, priority in ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6)):
        if level >= least:
            return priority
    return 7

"""Logs: fields for the journal, lines for people, never a flood."""

from __future__ import annotations

import io
import logging
import os
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from controller.cycle.machine import State
from controller.errors import CameraLost
from controller.service.journal import FAULT_ID, CycleLog, JournalHandler, Lines, RateLimit, logging_to_its_place


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[tuple[Path, Callable[[], dict[str, str]]]]:
    """A journal's socket, and a reader of its next entry."""
    path = tmp_path / "journal"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(path))
        line.settimeout(5.0)
        yield path, lambda: _entry(line.recv(1 << 20))


def _entry(data: bytes) -> dict[str, str]:
    """An entry of the native protocol, read as journald reads it."""
    fields: dict[str, str] = {}
    while data:
        head, _, rest = data.partition(b"\n")
        if b"=" in head:
            name, _, value = head.partition(b"=")
            data = rest
        else:
            name, (size,) = head, struct.unpack_from("<Q", rest)
            value, end, data = rest[8 : 8 + size], rest[8 + size : 9 + size], rest[9 + size :]
            assert end == b"\n"
        fields[name.decode()] = value.decode()
    return fields


@pytest.fixture
def logger() -> Iterator[logging.Logger]:
    made = logging.getLogger("controller.test_journal")
    made.propagate = False
    made.setLevel(logging.DEBUG)
    yield made
    made.handlers.clear()


def _fallback() -> tuple[logging.Handler, io.StringIO]:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(Lines())
    return handler, stream


def test_an_entry_has_the_fields_one_searches_by(
    journal: tuple[Path, Callable[[], dict[str, str]]], logger: logging.Logger
) -> None:
    path, read = journal
    logger.addHandler(JournalHandler(path, _fallback()[0]))
    extra = {"state": "PICK", "cycle_id": "t7", "fault_code": "camera_lost", "message_id": FAULT_ID}
    logger.error("camera %s is gone", "/dev/video0", extra=extra)
    entry = read()
    expected = {
        "MESSAGE": "camera /dev/video0 is gone",
        "PRIORITY": "3",
        "STATE": "PICK",
        "CYCLE_ID": "t7",
        "FAULT_CODE": "camera_lost",
        "MESSAGE_ID": FAULT_ID,
        "LOGGER": "controller.test_journal",
    }
    assert {name: entry[name] for name in expected} == expected
    logger.debug("quiet")
    entry = read()
    assert entry["PRIORITY"] == "7"
    assert "STATE" not in entry


def test_a_message_of_many_lines_cannot_forge_a_field(
    journal: tuple[Path, Callable[[], dict[str, str]]], logger: logging.Logger
) -> None:
    path, read = journal
    logger.addHandler(JournalHandler(path, _fallback()[0]))
    logger.info("two\nFAULT_CODE=forged")
    entry = read()
    assert entry["MESSAGE"] == "two\nFAULT_CODE=forged"
    assert "FAULT_CODE" not in entry


def test_a_huge_message_is_cut_and_still_text(
    journal: tuple[Path, Callable[[], dict[str, str]]], logger: logging.Logger
) -> None:
    path, read = journal
    logger.addHandler(JournalHandler(path, _fallback()[0]))
    logger.info("x%s", "ü" * 500_000)
    message = read()["MESSAGE"]
    assert 10_000 < len(message) < 500_000
    assert set(message[1:]) == {"ü"}


def test_without_a_journal_nothing_is_lost(tmp_path: Path, logger: logging.Logger) -> None:
    fallback, stream = _fallback()
    logger.addHandler(JournalHandler(tmp_path / "gone", fallback))
    logger.warning("still here", extra={"state": "HELD"})
    assert stream.getvalue().endswith("WARNING controller.test_journal: still here [state=HELD]\n")


def test_a_message_with_a_wrong_argument_does_not_stop_its_sender(
    journal: tuple[Path, Callable[[], dict[str, str]]], logger: logging.Logger, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, read = journal
    monkeypatch.setattr(logging, "raiseExceptions", False)
    logger.addHandler(JournalHandler(path, _fallback()[0]))
    logger.info("%d parts", "no number")
    logger.info("next")
    assert read()["MESSAGE"] == "next"


def test_a_flood_is_held_back_and_counted(logger: logging.Logger) -> None:
    now = 0.0
    handler, stream = _fallback()
    handler.addFilter(RateLimit(burst=3, interval=30.0, now=lambda: now))
    logger.addHandler(handler)
    for number in range(10):
        logger.warning("frame %d is late", number)
        logger.warning("another kind")
        now += 1.0
    lines = stream.getvalue().splitlines()
    assert sum("is late" in line for line in lines) == 3
    assert sum("another kind" in line for line in lines) == 3
    now = 31.0
    logger.warning("frame %d is late", 99)
    last = stream.getvalue().splitlines()[-1]
    assert last.endswith("frame 99 is late (7 more like this in the last 30 s were left out)")


def test_the_limit_itself_does_not_grow_without_bound() -> None:
    limit = RateLimit(now=lambda: 0.0)
    for number in range(5000):
        assert limit.filter(logging.LogRecord("n", logging.INFO, "", 0, f"unlike {number}", (), None))
    assert len(limit._kinds) <= 256


def test_the_cycle_stamps_every_record(logger: logging.Logger) -> None:
    cycle = CycleLog()
    handler, stream = _fallback()
    handler.addFilter(cycle)
    logger.addHandler(handler)
    cycle.entered(State.DETECT, 1.0)
    logger.info("from elsewhere")
    assert stream.getvalue().endswith("from elsewhere [state=DETECT]\n")


def test_a_fault_is_logged_with_its_code(
    journal: tuple[Path, Callable[[], dict[str, str]]], caplog: pytest.LogCaptureFixture
) -> None:
    path, read = journal
    handler = JournalHandler(path, _fallback()[0])
    cycle = CycleLog()
    handler.addFilter(cycle)
    log = logging.getLogger("controller.cycle")
    log.addHandler(handler)
    try:
        cycle.warned("supply_low", "10.6 V at the servos", 0.5)
        warning = read()
        cycle.faulted(CameraLost("/dev/video0", "read", "unplugged", "plug it in"), 1.0)
    finally:
        log.removeHandler(handler)
    entry = read()
    assert (warning["FAULT_CODE"], warning["PRIORITY"]) == ("supply_low", "4")
    assert (entry["FAULT_CODE"], entry["MESSAGE_ID"]) == ("camera_lost", FAULT_ID)
    assert entry["MESSAGE"] == "/dev/video0: read: unplugged: plug it in"


def test_a_log_that_only_stamps_says_nothing_itself(
    logger: logging.Logger, caplog: pytest.LogCaptureFixture
) -> None:
    cycle = CycleLog(aloud=False)
    handler, stream = _fallback()
    handler.addFilter(cycle)
    logger.addHandler(handler)
    with caplog.at_level(logging.DEBUG):
        cycle.entered(State.FAULT, 1.0)
        cycle.faulted(CameraLost("/dev/video0", "read", "unplugged"), 1.0)
        assert caplog.records == []
    logger.info("from elsewhere")
    assert stream.getvalue().endswith("from elsewhere [state=FAULT]\n")


def test_the_journal_is_used_only_when_stderr_goes_there(tmp_path: Path) -> None:
    root = logging.getLogger()
    before = (root.level, list(root.handlers))
    with (tmp_path / "stderr").open("w") as stream:
        found = os.fstat(stream.fileno())
        to_journal = {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}
        kinds = []
        for environment in (to_journal, {"JOURNAL_STREAM": "1:2"}, {}):
            with logging_to_its_place(stream=stream, environment=environment):
                kinds.append(type(root.handlers[-1]))
                assert logging.getLogger("controller.service").isEnabledFor(logging.INFO)
                assert not logging.getLogger("transitions.core").isEnabledFor(logging.INFO)
    assert kinds == [JournalHandler, logging.StreamHandler, logging.StreamHandler]
    assert (root.level, root.handlers) == before

"""The serial port as a byte stream, on a pseudo-terminal with nothing behind it."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.errors import BusError
from drivers.arm import serial_stream
from drivers.arm.serial_stream import SerialStream

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")


class _Terminal:
    """The far end of a line: what the adapter would be."""

    def __init__(self) -> None:
        import tty

        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)

    def unplug(self) -> None:
        if self.master >= 0:
            os.close(self._slave)
            os.close(self.master)
            self.master = -1


@pytest.fixture
def terminal() -> Iterator[_Terminal]:
    terminal = _Terminal()
    yield terminal
    terminal.unplug()


@pytest.fixture
def stream(terminal: _Terminal) -> Iterator[SerialStream]:
    stream = SerialStream(terminal.path)
    stream.open(1_000_000)
    yield stream
    stream.close()


def test_bytes_go_both_ways(terminal: _Terminal, stream: SerialStream) -> None:
    everything = bytes(range(256))  # no byte may mean anything to the terminal
    stream.write(everything)
    assert os.read(terminal.master, 1000) == everything
    os.write(terminal.master, everything)
    got = b""
    while len(got) < 256:
        chunk = stream.read(1000, 1.0)
        assert chunk
        got += chunk
    assert got == everything


def test_a_read_returns_what_is_there_and_does_not_wait_for_more(terminal: _Terminal, stream: SerialStream) -> None:
    os.write(terminal.master, b"abc")
    assert stream.read(100, 30.0) == b"abc"
    os.write(terminal.master, b"defgh")
    assert stream.read(2, 30.0) == b"de"
    assert stream.read(100, 0.0) == b"fgh"


def test_a_read_without_answer_is_empty_and_uses_no_processor(stream: SerialStream) -> None:
    used = time.thread_time()
    assert stream.read(10, 0.2) == b""
    # A polling read would use all of the 200 ms.
    assert time.thread_time() - used < 0.1


def test_input_is_discarded(terminal: _Terminal, stream: SerialStream) -> None:
    os.write(terminal.master, b"old")
    assert stream.read(1, 1.0) == b"o"
    stream.discard_input()
    os.write(terminal.master, b"new")
    assert stream.read(10, 1.0) == b"new"


def test_a_second_opener_is_told_it_is_busy(terminal: _Terminal, stream: SerialStream) -> None:
    other = SerialStream(terminal.path)
    with pytest.raises(BusError) as caught:
        other.open(1_000_000)
    assert caught.value.code == "busy"
    stream.close()
    other.open(1_000_000)
    other.close()


def test_no_such_port(tmp_path: Path) -> None:
    with pytest.raises(BusError) as caught:
        SerialStream(str(tmp_path / "ttyUSB7")).open(1_000_000)
    assert caught.value.code == "lost"


def test_a_file_is_no_port(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"")
    with pytest.raises(BusError) as caught:
        SerialStream(str(path)).open(1_000_000)
    assert caught.value.code == "refused"


@pytest.mark.parametrize("operation", ["read", "write", "discard"])
def test_unplugged_is_lost_at_once_and_the_same_object_reopens(
    terminal: _Terminal, operation: str, tmp_path: Path
) -> None:
    link = tmp_path / "arm"
    link.symlink_to(terminal.path)
    stream = SerialStream(str(link))
    stream.open(1_000_000)
    terminal.unplug()
    calls = {
        "read": lambda: stream.read(10, 30.0),
        "write": lambda: stream.write(b"x"),
        "discard": stream.discard_input,
    }
    with pytest.raises(BusError) as caught:
        calls[operation]()
    assert caught.value.code == "lost"
    assert caught.value.remedy
    with pytest.raises(BusError):  # and it stays lost until it is opened again
        calls[operation]()
    again = _Terminal()
    link.unlink()
    link.symlink_to(again.path)
    stream.open(57_600)
    os.write(again.master, b"back")
    assert stream.read(10, 1.0) == b"back"
    stream.close()
    again.unplug()


def test_a_slow_adapter_is_refused(terminal: _Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = SerialStream(terminal.path)
    for latency, refused in ((1.0, False), (2.0, False), (16.0, True), (None, False)):
        monkeypatch.setattr(serial_stream, "_latency_timer", lambda _path, latency=latency: latency)
        if refused:
            with pytest.raises(BusError, match="latency") as caught:
                stream.open(1_000_000)
            assert caught.value.code == "refused"
            assert "udev" in caught.value.remedy
        else:
            stream.open(1_000_000)
            assert stream.latency_ms == latency
        stream.close()

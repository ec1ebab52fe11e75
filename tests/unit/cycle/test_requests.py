"""Requests come from signal handlers too: in the thread, and at the line, where another request is being dealt with."""

from __future__ import annotations

import sys
import threading
from types import FrameType
from typing import Any

import pytest

from controller.config.arm import load_arm
from controller.cycle.requests import Requests
from sim_backends.recording_arm import RecordingArm
from sim_backends.virtual_clock import VirtualClock


@pytest.mark.parametrize("name", ["stop", "pause", "resume", "end_pause", "must_be_told", "took_pause"])
def test_a_stop_may_interrupt_any_line_of_another_request(name: str) -> None:
    requests = Requests(RecordingArm(load_arm("reactorx_150"), VirtualClock()))
    requests.pause()
    interrupted = []

    def signal(frame: FrameType, event: str, argument: object) -> Any:
        if event == "line":
            sys.settrace(None)
            interrupted.append(frame.f_lineno)
            requests.stop()
            sys.settrace(signal)
        return signal

    def ask() -> None:
        sys.settrace(signal)
        getattr(requests, name)()
        sys.settrace(None)

    # In a thread, so that one that waits for itself fails the test instead of ending in its timeout.
    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(10.0)
    assert not thread.is_alive()
    assert interrupted
    assert requests.stopped

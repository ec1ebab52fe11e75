"""What is counted on the lines to camera and servos is an alarm while it is too much."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from controller.backends.concerns import Concerns
from drivers.arm.replies import BusStatistics
from sim_backends.replay_camera import ReplayCamera
from sim_backends.virtual_clock import VirtualClock


def test_frames_that_cannot_be_decoded_are_told_by_their_share() -> None:
    frames: Any = SimpleNamespace(good_frames=0, bad_frames=0)
    concerns = Concerns(ReplayCamera([], VirtualClock()), BusStatistics(), frames)
    for good, bad, told in ((50, 40, False), (94, 6, True), (140, 6, True), (200, 6, False), (295, 11, False)):
        frames.good_frames, frames.bad_frames = good, bad
        assert ("pictures_damaged" in concerns()) is told, (good, bad)
    assert concerns() == {}


def test_answers_that_are_lost_are_told_by_their_share() -> None:
    bus = BusStatistics()
    concerns = Concerns(ReplayCamera([], VirtualClock()), bus)
    for replies, timeouts, told in ((400, 50, False), (494, 6, True), (1000, 6, False)):
        bus.replies, bus.timeouts = replies, timeouts
        assert ("bus_noisy" in concerns()) is told, (replies, timeouts)

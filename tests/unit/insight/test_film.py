"""A film and a timeline of devices that are not there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest

from controller.backends import Devices
from controller.config.arm import load_arm
from controller.cycle.machine import State
from controller.domain import Trajectory
from controller.errors import InputError, MotionTimeout
from controller.insight.film import Film
from controller.insight.timeline import Timeline
from controller.ports import Camera
from sim_backends.recording_arm import RecordingArm
from sim_backends.virtual_clock import VirtualClock


def devices(on_step: Callable[[Callable[[float], None]], None] | None) -> Devices:
    clock = VirtualClock()
    arm = RecordingArm(load_arm("reactorx_150"), clock)
    small = np.full((36, 64, 3), 90, np.uint8)
    return Devices(cast(Camera, object()), arm, clock, miniature=lambda: small, on_step=on_step)


def test_a_film_has_a_frame_for_every_tenth_of_a_second(tmp_path: Path) -> None:
    steps: list[Callable[[float], None]] = []
    path = tmp_path / "film.mp4"
    with Film(path) as film:
        assert film.watch(devices(steps.append)) == (film,)
        for _ in range(500):
            steps[0](0.002)
    video = cv2.VideoCapture(str(path))
    try:
        assert round(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 10
        assert round(video.get(cv2.CAP_PROP_FPS)) == 10
        assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (128, 64)
    finally:
        video.release()


def test_there_is_no_film_of_a_real_cell(tmp_path: Path) -> None:
    with Film(tmp_path / "film.mp4") as film, pytest.raises(InputError, match="no film"):
        film.watch(devices(None))


def test_a_file_that_cannot_be_written_is_said_before_anything_moves(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        Film(tmp_path)


def test_a_timeline_notes_what_camera_arm_and_clock_do_and_nothing_that_failed() -> None:
    set_, timeline = devices(None), Timeline()
    arm = set_.arm
    timeline.watch(set_)
    set_.arm.open()
    state = set_.arm.energise()
    timeline.entered(State.PICK, set_.clock.now())
    way = np.linspace(state.positions, state.positions, 51)
    set_.arm.follow(Trajectory("approach", 0.01, way, way))
    set_.clock.charge(0.05)
    set_.arm.grip(40.0)
    set_.arm.grip(60.0)
    timeline.entered(State.PLACE, set_.clock.now())
    cast(RecordingArm, arm).fail_on("follow", 1, MotionTimeout("arm", "follow", "stuck"))
    with pytest.raises(MotionTimeout):
        set_.arm.follow(Trajectory("carry", 0.01, way, way))
    assert [(span.lane, span.name) for span in timeline.spans] == [
        ("arm", "approach"),
        ("computing", "planning"),
        ("gripper", "close"),
        ("gripper", "open"),
        ("state", "PICK"),
    ]
    first = timeline.spans[0]
    assert first.end - first.begin == pytest.approx(0.5)
    assert all(span.begin <= span.end for span in timeline.spans)

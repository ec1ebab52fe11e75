"""The Camera suite over every camera there is."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.config.arm import load_arm
from controller.vision.watch import WatchedCamera
from drivers.camera.v4l2 import V4l2Camera
from drivers.clock import MonotonicClock
from sim_backends.faulty_camera import FaultyCamera
from sim_backends.replay_camera import ReplayCamera
from sim_backends.virtual_clock import VirtualClock
from tests.contract.camera_suite import CameraCell, CameraSuite, GlanceSuite
from tests.fake_capture import FakeCapture

SIZE = (64, 48)


@pytest.fixture
def replay(tmp_path: Path) -> CameraCell:
    """Eight pictures of noise."""
    chance = np.random.default_rng(1)
    for number in range(8):
        picture = chance.integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
        assert cv2.imwrite(str(tmp_path / f"{number}.png"), picture)
    clock = VirtualClock(5.0)
    return CameraCell(ReplayCamera(tmp_path, clock), clock, SIZE)


class TestReplayCamera(CameraSuite):
    @pytest.fixture
    def cell(self, replay: CameraCell) -> CameraCell:
        return replay


class TestWatchedCamera(CameraSuite):
    """Watching, and a script without faults, change nothing."""

    @pytest.fixture
    def cell(self, replay: CameraCell) -> CameraCell:
        clock = replay.clock
        return CameraCell(WatchedCamera(FaultyCamera(replay.camera, clock, []), clock), clock, SIZE)


class TestV4l2CameraOnAScriptedDevice(GlanceSuite):
    @pytest.fixture
    def cell(self) -> Iterator[CameraCell]:
        clock = VirtualClock(5.0)
        pause = threading.Event()
        camera = V4l2Camera(
            "/dev/video9",
            clock,
            size=SIZE,
            # A reader on a virtual clock would never wait; half a millisecond a frame keeps it from spinning.
            capture=lambda device: FakeCapture(clock, pace=lambda: pause.wait(0.0005)),
        )
        yield CameraCell(camera, clock, SIZE)
        camera.close()


class TestSimulatedCamera(GlanceSuite):
    @pytest.fixture
    def cell(self) -> Iterator[CameraCell]:
        pytest.importorskip("mujoco", reason="the extra `sim` is not installed")
        from sim_backends.cell import SimulatedCell
        from sim_backends.cell_spec import CellSpec

        simulated = SimulatedCell(CellSpec(load_arm("reactorx_150"), image_size=(160, 90), parts=2, seed=3))
        yield CameraCell(simulated.camera, simulated.clock, (160, 90))
        simulated.camera.close()


@pytest.mark.hardware
class TestV4l2Camera(GlanceSuite):
    """The camera named by SORTER_CAMERA, at 1280x720."""

    @pytest.fixture
    def cell(self) -> Iterator[CameraCell]:
        device = os.environ.get("SORTER_CAMERA")
        if not device:
            pytest.skip("SORTER_CAMERA names no camera")
        clock = MonotonicClock()
        camera = V4l2Camera(device, clock)
        yield CameraCell(camera, clock, (1280, 720))
        camera.close()

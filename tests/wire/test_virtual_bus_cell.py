"""A whole physics cell in a process of its own, reached by the real driver and the remote ports only."""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import pytest

if sys.platform == "win32":
    pytest.skip("pseudo-terminals are POSIX", allow_module_level=True)
pytest.importorskip("mujoco")

from controller.config.arm import load_arm
from drivers.arm.dynamixel import DynamixelArm
from drivers.arm.serial_stream import SerialStream
from drivers.clock import MonotonicClock
from sim_backends.cell_spec import CellSpec
from sim_backends.remote import RemoteCamera, RemotePresenter, RemoteTruth, ServerSpec, spawn_server

PARTS = 3


def test_driver_camera_hands_and_truth_meet_in_one_world() -> None:
    description = load_arm("reactorx_150")
    spec = CellSpec(description, parts=PARTS, seed=1, level="ideal")
    clock = MonotonicClock()
    with spawn_server(ServerSpec(cell=json.loads(spec.to_json()))) as server:
        camera = RemoteCamera(server.socket, clock)
        hands, truth = RemotePresenter(server.socket), RemoteTruth(server.socket, clock)
        arm = DynamixelArm(description, SerialStream(server.pty), clock)
        try:
            camera.open()
            arm.open()
            assert sorted(arm.inventory) == [1, 2, 3, 4, 5, 6]
            # The arm stands at rest in the world, and the driver reads the same angles from the servos.
            assert arm.energise().positions == pytest.approx(np.array(description.rest), abs=0.02)
            asked = time.monotonic()
            frame = camera.capture(asked)
            assert frame.size == spec.image_size
            assert frame.captured_at >= asked
            parts = truth.now()
            assert len(parts) == PARTS
            assert {part.place for part in parts} == {"table"}
            assert list(truth.at(frame.captured_at)) == list(parts)

            truth.set_aside()
            hands.lay(np.zeros((100, 100), np.uint8), 1.0)
            covered = camera.capture(time.monotonic()).image
            x, y = spec.image_size[0] // 2, spec.image_size[1] // 2
            assert covered[y, x].max() < 40 < frame.image[y, x].max()  # a black sheet on a light table
            hands.remove()
            truth.scatter()
            again = camera.capture(time.monotonic()).image
            # The same picture as before but for noise and what the arm has settled by.
            assert np.abs(again.astype(int) - frame.image).mean() < 3.0
        finally:
            arm.relax()
            arm.close()
            for remote in (camera, hands, truth):
                remote.close()

"""What the servos do when the process that moves them is killed."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest

from tests.unit.drivers.bench import ArmBench

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")

_MOVER = """
import sys, time
import numpy as np
from drivers.arm.dynamixel import DynamixelArm
from drivers.arm.serial_stream import SerialStream
from controller.config.arm import load_arm
from tests.contract.arm_suite import quintic

class Clock:
    now, sleep, charge = staticmethod(time.monotonic), staticmethod(time.sleep), staticmethod(lambda seconds: None)

arm = DynamixelArm(load_arm("reactorx_150"), SerialStream(sys.argv[1]), Clock())
arm.open()
start = arm.energise().positions
arm.follow(quintic(start, start + np.array([1.5, 0.6, -0.6, 0.3, 0.5]), 30.0))
"""


@pytest.mark.safety("SR-25")
def test_servos_stop_by_themselves_and_a_new_process_takes_over() -> None:
    from drivers.arm.dynamixel import DynamixelArm
    from drivers.arm.serial_stream import SerialStream
    from sim_backends.virtual_dynamixel.pty import PtyBus
    from tests.contract.test_arm import WallClock

    bench = ArmBench()
    bus = bench.bus
    waist = bus.servo(1)
    with PtyBus(bus) as pty:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        mover = subprocess.Popen([sys.executable, "-c", _MOVER, pty.path], env=environment)
        try:
            _until(lambda: pty.call(lambda: bench.plant.shaft(1).velocity > 0.02))
            assert pty.call(lambda: waist.table.get("Bus_Watchdog")) == 10
        finally:
            mover.kill()
            mover.wait()
        _until(lambda: pty.call(lambda: waist.table.get("Bus_Watchdog") == -1))
        assert pty.call(lambda: waist.table.get("Torque_Enable")) == 1  # it holds, it does not drop
        stopped = pty.call(lambda: bench.plant.shaft(1).angle)
        # The port is free again, and the new process goes on from where the arm stands.
        arm = DynamixelArm(bench.description, SerialStream(pty.path), WallClock())
        arm.open()
        assert arm.energise().positions[0] == pytest.approx(stopped, abs=0.01)
        assert abs(pty.call(lambda: bench.plant.shaft(1).angle) - stopped) < 0.01
        arm.relax()
        arm.close()


def _until(condition: Callable[[], bool]) -> None:
    """Ask every 10 ms, for at most 20 s."""
    pause = threading.Event()
    for _ in range(2000):
        if condition():
            return
        pause.wait(0.01)
    raise AssertionError("it did not happen within 20 s")

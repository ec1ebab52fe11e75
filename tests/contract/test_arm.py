"""The arm suite over the recording arm, the driver on the simulated bus in process, and on a pseudo-terminal."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator

import pytest

from controller.config.arm import load_arm
from drivers.arm.conversions import angle_from_opening
from drivers.arm.dynamixel import DynamixelArm
from drivers.arm.serial_stream import SerialStream
from sim_backends.recording_arm import RecordingArm
from sim_backends.virtual_clock import VirtualClock
from tests.contract.arm_suite import ArmCase, ArmSuite, in_a_thread
from tests.unit.drivers.bench import ArmBench


class TestRecordingArm(ArmSuite):
    @pytest.fixture
    def arm_case(self) -> Iterator[ArmCase]:
        clock = _AlarmClock()
        width: list[float | None] = [None]

        def grip_model(before: float, wanted: float) -> tuple[bool, float]:
            part = width[0]
            return (True, part) if part is not None and wanted < part <= before else (False, wanted)

        arm = RecordingArm(load_arm("reactorx_150"), clock, grip_model=grip_model)
        arm.open()
        yield ArmCase(arm, clock, lambda part: width.__setitem__(0, part), clock.during)
        arm.close()


class _AlarmClock(VirtualClock):
    """Does something when a certain time has come."""

    def __init__(self) -> None:
        super().__init__()
        self._alarm: tuple[float, Callable[[], None]] | None = None

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        if self._alarm is not None and self.now() >= self._alarm[0]:
            _, action = self._alarm
            self._alarm = None
            action()

    def during(self, call: Callable[[], object], seconds: float, action: Callable[[], None]) -> object:
        self._alarm = (self.now() + seconds, action)
        return call()


class TestDynamixelInProcess(ArmSuite):
    @pytest.fixture(params=["reactorx_150", "pincherx_100", "widowx_250", "open_manipulator_x"])
    def arm_case(self, request: pytest.FixtureRequest) -> Iterator[ArmCase]:
        bench = ArmBench(request.param)

        def during(call: Callable[[], object], seconds: float, action: Callable[[], None]) -> object:
            due = [bench.plant.now() + seconds]

            def on_step(_: float) -> None:
                if due and bench.plant.now() >= due[0]:
                    due.clear()
                    action()

            bench.plant.on_step(on_step)
            return call()

        bench.arm.open()
        yield ArmCase(bench.arm, bench.clock, lambda part: _obstruct(bench, part), during)
        bench.arm.close()


def _obstruct(bench: ArmBench, width: float | None) -> None:
    gripper = bench.description.gripper
    if width is None:
        bench.plant.block(gripper.servo_id)
        return
    angle = angle_from_opening(gripper, width)
    sign = -1.0 if gripper.reverse else 1.0
    opens = angle_from_opening(gripper, gripper.opening[1]) > angle_from_opening(gripper, gripper.opening[0])
    low, high = (angle, math.inf) if opens else (-math.inf, angle)
    bench.plant.block(gripper.servo_id, *sorted((sign * low, sign * high)))


class WallClock:
    """The machine's own time."""

    now = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)

    def charge(self, seconds: float) -> None:
        """Real computing takes real time."""


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
class TestDynamixelOnPty(ArmSuite):
    @pytest.fixture
    def arm_case(self) -> Iterator[ArmCase]:
        from sim_backends.virtual_dynamixel.pty import PtyBus

        bench = ArmBench("reactorx_150")
        clock = WallClock()

        def during(call: Callable[[], object], seconds: float, action: Callable[[], None]) -> object:
            in_a_thread(call, clock, seconds, action)
            return None

        with PtyBus(bench.bus) as pty:
            arm = DynamixelArm(bench.description, SerialStream(pty.path), clock)
            arm.open()
            yield ArmCase(arm, clock, lambda part: pty.call(lambda: _obstruct(bench, part)), during)
            arm.close()



"""Every fault of the bus at many moments of a session: a typed error or none at all, and a way back."""

from __future__ import annotations

import numpy as np
import pytest

from controller.errors import ArmError
from sim_backends.virtual_dynamixel.faults import Fault
from sim_backends.virtual_dynamixel.protocol import InstructionParser
from tests.contract.arm_suite import STANDS, quintic
from tests.unit.drivers.bench import ArmBench

PASSING = (Fault.DROP, Fault.CORRUPT, Fault.TRUNCATE, Fault.DELAY, Fault.NOISE, Fault.WRONG_ID, Fault.LOST)
LASTING = (
    Fault.SILENT, Fault.REBOOT, Fault.OVERLOAD, Fault.UNDERVOLTAGE, Fault.OVERHEAT, Fault.ENCODER, Fault.DISCONNECT,
)  # fmt: skip


def _session(bench: ArmBench) -> None:
    """Everything an arm does in a day, in two seconds."""
    arm = bench.arm
    arm.open()
    start = arm.energise().positions
    end = start + np.array([0.5, 0.4, -0.4, 0.2, 0.3])
    assert arm.follow(quintic(start, end, 0.5)).finished
    assert arm.grip(60.0).finished
    assert arm.grip(45.0, 0.7).finished
    assert arm.follow(quintic(arm.state().positions, start, 0.5)).finished
    arm.relax()
    arm.close()


def _instructions() -> int:
    bench = ArmBench()
    _session(bench)
    return bench.arm.bus.statistics.transactions


INSTRUCTIONS = _instructions()


class _StrikingBench(ArmBench):
    """Lets a fault happen at the n-th instruction, to a servo that depends on n."""

    def __init__(self, fault: Fault, at: int) -> None:
        super().__init__()
        self._count = 0
        write = self.stream.write

        def striking(data: bytes) -> None:
            self._count += len(InstructionParser().feed(data))
            if self._count >= at > 0:
                self._count = -(10**9)
                servo_id = 1 + at % 6
                if fault in PASSING:
                    self.bus.faults.once(fault, None if fault is Fault.LOST else servo_id)
                else:
                    self.bus.strike(fault, servo_id)
            write(data)

        self.stream.write = striking  # type: ignore[method-assign]  # the line is where the moment is known


@pytest.mark.parametrize("fault", PASSING)
def test_a_passing_fault_at_any_moment_is_survived(fault: Fault) -> None:
    for at in range(1, INSTRUCTIONS, INSTRUCTIONS // 9):
        bench = _StrikingBench(fault, at)
        _session(bench)
        # Once an honest session has ended, the arm is where the session leaves it.
        assert np.abs(bench.positions() - bench.description.rest).max() < STANDS, f"at instruction {at}"


@pytest.mark.parametrize("fault", LASTING)
def test_a_lasting_fault_at_any_moment_is_an_arm_error_and_leaves_a_way_back(fault: Fault) -> None:
    # The last sixty instructions belong to the end of the last move and to relaxing, which need not notice everything.
    for at in range(2, INSTRUCTIONS - 60, INSTRUCTIONS // 8):
        bench = _StrikingBench(fault, at)
        with pytest.raises(ArmError) as caught:
            _session(bench)
        assert caught.value.remedy
        bench.plant.advance(1.0)
        bench.bus.heal()
        for servo_id in bench.bus.servo_ids:
            if bench.bus.servo(servo_id).alert:
                bench.bus.strike(Fault.REBOOT, servo_id)
        bench.plant.advance(1.0)
        here = bench.positions()
        bench.arm.open()
        bench.arm.energise()
        bench.plant.advance(0.5)
        assert np.abs(bench.positions() - here).max() < STANDS, f"moved by itself after instruction {at}"
        bench.arm.relax()
        bench.arm.close()

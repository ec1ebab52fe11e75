"""Every way a run can end: stopped, faulted, failed, done; and where that leaves the arm."""

from __future__ import annotations

import pytest

from controller.cycle import looking
from controller.cycle.machine import State
from controller.domain import Result
from controller.errors import (
    ArmError,
    CalibrationError,
    CalibrationStale,
    CameraEnded,
    MotionTimeout,
)
from controller.localization.locate import Located
from tests.unit.cycle.bench import Bench, part

S = State


@pytest.mark.parametrize("during", ["home", "approach", "carry", "retreat"])
@pytest.mark.safety("SR-20", "SR-21")
def test_a_stop_parks_the_arm_wherever_it_comes(monkeypatch: pytest.MonkeyPatch, during: str) -> None:
    bench = Bench(monkeypatch, part(0, 0), part(0, 90))
    bench.arm.open()
    sorter = bench.sorter()
    bench.on_command = lambda c: sorter.request_stop() if c.get("name") == during else None
    sorter.run()
    assert bench.states[-1] is S.STOPPED
    assert bench.commands[-3:] == ["clear_stop", "park", "relax"]
    placed = [Result.PLACED] * 2
    assert bench.results == {"home": [], "retreat": placed}.get(during, [Result.ABORTED])
    begun = [what for kind, what in bench.ledger.lines if kind == "intend"]
    assert len(begun) == len(bench.results)


@pytest.mark.safety("SR-23")
def test_a_fault_of_the_arm_latches_and_it_moves_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    error = MotionTimeout("arm", "follow", "the elbow does not move")
    bench.arm.fail_on("follow", 3, error, fraction=0.5)
    sorter = bench.run()
    assert sorter.fault is error
    assert bench.states[-1] is S.FAULT
    assert bench.results == [Result.INDETERMINATE]
    assert bench.commands[-1] == "carry"
    assert "relax" not in bench.commands  # it would fall


@pytest.mark.safety("SR-21")
def test_a_fault_elsewhere_latches_when_the_arm_is_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.camera.failures = [CalibrationStale("other camera")]
    bench.run()
    assert bench.states[-1] is S.FAULT
    assert bench.commands[-3:] == ["clear_stop", "park", "relax"]


@pytest.mark.safety("SR-21")
@pytest.mark.parametrize("state", [S.CAPTURE, S.PLACE, S.IDLE])
def test_a_mistake_in_the_program_brings_the_arm_to_rest(monkeypatch: pytest.MonkeyPatch, state: S) -> None:
    bench = Bench(monkeypatch, part(0, 0))

    def entered(now: S, at: float) -> None:
        if now is state:
            raise RuntimeError("a mistake")

    monkeypatch.setattr(bench, "entered", entered)
    with pytest.raises(RuntimeError):
        bench.run()
    assert bench.commands[-3:] == ["clear_stop", "park", "relax"]
    assert bench.results == {S.CAPTURE: [], S.PLACE: [Result.INDETERMINATE], S.IDLE: [Result.PLACED]}[state]


@pytest.mark.safety("SR-23")
def test_a_mistake_after_a_fault_of_the_arm_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.arm.fail_on("follow", 3, MotionTimeout("arm", "follow", "the elbow does not move"), fraction=0.5)

    def entered(now: S, at: float) -> None:
        if now is S.FAULT:
            raise RuntimeError("a mistake")

    monkeypatch.setattr(bench, "entered", entered)
    with pytest.raises(RuntimeError):
        bench.run()
    assert bench.commands[-1] == "carry"


@pytest.mark.safety("SR-21")
def test_an_arm_that_cannot_be_parked_keeps_its_torque(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.camera.failures = [CalibrationStale("other camera")]
    bench.arm.fail_on("follow", 2, ArmError("arm", "follow", "lost"), fraction=0.5)
    assert isinstance(bench.run().fault, CalibrationStale)
    assert "relax" not in bench.commands
    assert ("note", "park_failed") in bench.ledger.lines


def test_a_stop_ends_a_pause_and_parks(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.arm.open()
    sorter = bench.sorter()

    def watch(now: float) -> None:
        if sorter.holds:
            sorter.request_stop()
            sorter.request_pause()  # too late

    bench.on_command = lambda c: sorter.request_pause() if c.get("name") == "carry" else None
    bench.on_sleep = watch
    sorter.run()
    assert sorter.machine.state is S.STOPPED
    assert bench.commands[-2:] == ["park", "relax"]
    assert bench.results == [Result.ABORTED]


@pytest.mark.safety("SR-23")
@pytest.mark.parametrize("paused", [True, False])
def test_a_fault_parks_the_arm_unless_it_is_paused(monkeypatch: pytest.MonkeyPatch, paused: bool) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.arm.open()
    sorter = bench.sorter()

    def locate(*_: object) -> Located:
        if paused:
            sorter.request_pause()
        raise CalibrationError("the marks on the arm's base have moved", "calibrate again")

    monkeypatch.setattr(looking, "locate", locate)
    sorter.run()
    assert sorter.machine.state is S.FAULT
    assert isinstance(sorter.fault, CalibrationError)
    assert ("park" in bench.commands, "relax" in bench.commands) == (not paused, not paused)


def test_the_end_of_a_replay_is_an_ordinary_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    bench.camera.failures = [CameraEnded("replay", "read", "the pictures have ended")]
    assert bench.run().fault is None
    assert bench.states[-1] is S.STOPPED


def test_a_run_ends_after_the_wanted_number_of_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, -90), part(0, 0), part(0, 90))
    bench.most_parts = 2
    assert bench.run().left == 1
    assert bench.results == [Result.PLACED] * 2


@pytest.mark.safety("SR-20")
def test_a_stop_before_the_torque_is_on_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.arm.open()
    sorter = bench.sorter()
    sorter.request_stop()
    sorter.run()
    assert sorter.fault is None
    assert bench.commands == []
    assert bench.states == [S.HOMING, S.STOPPED]

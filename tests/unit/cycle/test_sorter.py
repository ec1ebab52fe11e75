"""The whole cycle on a bench: one part through every state, a pause on its way, and the same run twice."""

from __future__ import annotations

import pytest

from controller.cycle.machine import State
from controller.domain import Result
from tests.unit.cycle.bench import Bench, part

S = State


def test_one_part_walks_through_every_state(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    sorter = bench.run()
    look = [S.CAPTURE, S.DETECT, S.LOCALIZE]
    assert bench.states == [S.HOMING, *look, S.PICK, S.PLACE, *look, S.IDLE, S.STOPPED]
    assert bench.results == [Result.PLACED]
    assert bench.commands == [
        "energise", "home", "approach", "grip", "carry", "grip", "retreat", "clear_stop", "park", "relax",
    ]  # fmt: skip
    assert sorter.fault is None
    assert sorter.left == 0


@pytest.mark.parametrize("name", ["home", "approach", "grip", "carry"])
def test_a_pause_holds_where_the_arm_is_and_goes_on_from_there(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.arm.open()
    sorter = bench.sorter()
    paused: list[float] = []
    stood: list[tuple[float, ...]] = []

    def pause(command: dict[str, object]) -> None:
        if command.get("name", command["command"]) == name and not paused:
            paused.append(bench.clock.now())

    def watch(now: float) -> None:
        if paused and not stood and now > paused[0] + 0.2:
            sorter.request_pause()
            stood.append(tuple(bench.arm.state().positions))
        elif stood and sorter.holds and now < paused[0] + 30.0:
            stood.append(tuple(bench.arm.state().positions))
        elif stood and now > paused[0] + 30.0:
            sorter.resume()

    bench.on_command = pause
    bench.on_sleep = watch
    sorter.run()
    assert len(stood) > 500
    assert len(set(stood[1:])) == 1
    assert bench.results == [Result.PLACED]
    assert bench.clock.now() > 30.0


def test_the_same_run_commands_the_same_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    benches = []
    for _ in range(2):
        bench = Bench(monkeypatch, part(0, -90), part(0, 60))
        bench.run()
        benches.append(bench)
    benches[1].arm.assert_commands(benches[0].arm.commands)

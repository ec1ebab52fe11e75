"""What holds the cell until it has passed: the record, a stuck part, the camera, a hand."""

from __future__ import annotations

import pytest

from controller.cycle.machine import State
from controller.domain import Frame, Result
from controller.errors import (
    CameraLost,
    Intruder,
    LedgerError,
    PartHeld,
    PictureUnusable,
    SorterError,
)
from tests.unit.cycle.bench import IMAGE, Bench, BenchCamera, part

S = State


@pytest.mark.safety("SR-40")
def test_nothing_moves_for_a_part_that_cannot_be_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))

    def fill(command: dict[str, object]) -> None:
        if command.get("name") == "home":
            bench.ledger.full = LedgerError("disk full")

    bench.on_command = fill
    sorter = bench.run()
    assert isinstance(sorter.fault, LedgerError)
    assert "approach" not in bench.commands
    assert [str(cause) for cause in bench.held_for] == ["disk full"]


def test_a_record_that_can_be_written_again_is_caught_up_before_anything_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch, part(0, 0), part(0, 90))

    moved_at: list[float] = []

    def fill(command: dict[str, object]) -> None:
        moved_at.append(bench.clock.now())
        if command.get("name") == "carry" and not bench.outcomes:
            bench.ledger.full = LedgerError("disk full")

    bench.on_command = fill
    bench.on_sleep = lambda now: setattr(bench.ledger, "full", None) if now > 30.0 else None
    bench.run()
    assert bench.results == [Result.PLACED] * 2
    assert [what for kind, what in bench.ledger.lines if kind != "note"] == ["t1/1", "t1:placed", "t2/1", "t2:placed"]
    assert bench.states.count(S.HELD) == 1
    assert not [at for at in moved_at if 10.0 < at < 30.0]


def test_an_intent_that_could_not_be_recorded_is_no_attempt(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.on_command = lambda c: setattr(bench.ledger, "full", LedgerError("full")) if c.get("name") == "home" else None
    bench.on_sleep = lambda now: setattr(bench.ledger, "full", None) if now > 20.0 else None
    bench.run()
    assert [(o.result, o.attempts) for o in bench.outcomes] == [(Result.PLACED, 1)]
    assert bench.overcome == 1


def stuck(bench: Bench, times: int) -> None:
    """Jaws that stop on the part when they are opened over the bin."""
    bench.arm.grip_result(contact=True, opening=40.0)
    for _ in range(times):
        bench.arm.grip_result(contact=True, opening=40.5)


def test_jaws_that_keep_a_part_are_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    stuck(bench, 2)
    bench.run()
    assert bench.results == [Result.PLACED]
    assert bench.held_for == []


@pytest.mark.safety("SR-16", "SR-24")
def test_a_part_that_sticks_holds_the_cell_until_somebody_says_it_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.until_empty = False
    stuck(bench, 3)
    bench.arm.open()
    sorter = bench.sorter()
    moves: list[int] = []

    def help_(now: float) -> None:
        if sorter.machine.state is S.HELD:
            moves.append(len(bench.arm.commands))
            if len(moves) > 2000:  # 100 s: longer than a run that nobody operates would hold
                bench.table.clear()
                sorter.resume()
        if sorter.machine.state is S.IDLE:
            sorter.request_stop()

    bench.on_sleep = help_
    sorter.run()
    assert isinstance(bench.held_for[0], PartHeld)
    assert len(set(moves)) == 1
    assert bench.results == [Result.INDETERMINATE]
    assert sorter.fault is None


def test_a_part_that_sticks_is_a_fault_where_nobody_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    stuck(bench, 3)
    sorter = bench.run()
    assert isinstance(sorter.fault, PartHeld)
    assert bench.commands[-1] == "grip"
    assert bench.results == [Result.INDETERMINATE]
    assert 60.0 < bench.clock.now() < 90.0


@pytest.mark.safety("SR-24")
def test_a_camera_that_comes_back_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.camera.failures = [CameraLost("camera", "read", "unplugged")] * 2
    bench.run()
    assert bench.results == [Result.PLACED]
    assert bench.states.count(S.HELD) == 2
    assert bench.camera.opened == 2


@pytest.mark.safety("SR-31", "SR-24")
def test_an_unusable_picture_moves_nothing_and_each_is_told_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    codes = ["black", "black", "moved"]
    bench.camera.failures = [PictureUnusable("camera", "look", code, code) for code in codes]
    moved: list[object] = []
    bench.on_command = lambda command: moved.append(command) if bench.camera.failures and bench.held_for else None
    bench.run()
    assert moved == []
    assert [getattr(cause, "code", "") for cause in bench.held_for] == ["black", "moved"]
    assert bench.overcome == 1


def test_a_camera_that_stays_away_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.camera.failures = [CameraLost("camera", "read", "unplugged")] * 20
    sorter = bench.run()
    assert isinstance(sorter.fault, CameraLost)
    assert bench.clock.now() < 70.0
    assert bench.commands[-1] == "relax"


def test_an_operated_cell_waits_for_its_camera_as_long_as_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.until_empty = False
    bench.most_parts = 1
    bench.camera.failures = [CameraLost("camera", "read", "unplugged")] * 100
    assert bench.run().fault is None
    assert bench.results == [Result.PLACED]
    assert len(bench.held_for) == bench.overcome == 1
    # 0.5, 1, 2, 4, 8 s, then every 10 s
    assert bench.clock.now() == pytest.approx(15.5 + 95 * 10.0, rel=0.05)


@pytest.mark.safety("SR-20", "SR-24")
def test_a_stop_is_obeyed_while_the_cell_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.camera.failures = [CameraLost("camera", "read", "unplugged")] * 20
    bench.arm.open()
    sorter = bench.sorter()
    bench.on_sleep = lambda now: sorter.request_stop() if now > 20.0 and not sorter._requests.stopped else None
    sorter.run()
    assert sorter.fault is None
    assert bench.clock.now() < 25.0
    assert bench.commands[-3:] == ["clear_stop", "park", "relax"]


def test_a_hand_over_the_table_holds_the_cell_until_it_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, -90), part(0, 90))
    bench.intrude(looks=range(2, 6))
    bench.run()
    assert isinstance(bench.held_for[0], Intruder)
    assert bench.results == [Result.PLACED] * 2
    held = bench.states.index(S.HELD)
    assert bench.states[held - 1] is S.DETECT
    assert bench.overcome == 1


def test_only_an_operator_goes_on_after_a_hand_when_the_configuration_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.change("cycle", resume_when_clear_s=0.0)
    bench.intrude(looks=range(1, 3))
    bench.arm.open()
    sorter = bench.sorter()
    moved_while_held: list[str] = []
    bench.on_command = lambda c: moved_while_held.append("!") if sorter.machine.state is S.HELD else None
    bench.on_sleep = lambda now: sorter.resume() if now > 30.0 else None
    sorter.run()
    assert bench.results == [Result.PLACED]
    assert bench.outcomes[0].started_at > 30.0
    assert moved_while_held == []


def test_an_operator_cannot_resume_under_a_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.change("cycle", resume_when_clear_s=0.0)
    bench.intrude(looks=range(1, 10_000))
    bench.arm.open()
    sorter = bench.sorter()
    bench.on_sleep = lambda now: sorter.resume()
    sorter.run()
    assert isinstance(sorter.fault, Intruder)
    assert "approach" not in bench.commands


def test_something_larger_than_any_part_holds_the_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0, size=150.0))
    assert isinstance(bench.run().fault, Intruder)


@pytest.mark.safety("SR-35")
def test_a_hand_on_the_way_down_stops_the_arm_and_holds_the_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.reach_over_on_the_way({1})
    bench.run()
    assert isinstance(bench.held_for[0], Intruder)
    assert bench.commands[2:8] == ["approach", "stop", "clear_stop", "home", "approach", "grip"]
    assert [(o.result, o.attempts) for o in bench.outcomes] == [(Result.PLACED, 2)]
    held = bench.states.index(S.HELD)
    assert bench.states[held - 1 : held + 2] == [S.PICK, S.HELD, S.CAPTURE]
    assert bench.overcome == 1


@pytest.mark.safety("SR-35")
def test_a_hand_over_the_way_to_the_bin_stops_the_arm_which_goes_on_from_there(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.reach_over_on_the_way(())
    watched: list[float] = []

    def reach_over(now: float) -> None:
        if "carry" in bench.commands and bench.camera.listener is not None:
            watched.append(now)
            if len(watched) == 40:
                bench.camera.listener(Frame(1, now, IMAGE))

    bench.on_sleep = reach_over
    bench.run()
    assert isinstance(bench.held_for[0], Intruder)
    assert bench.commands[2:9] == ["approach", "grip", "carry", "stop", "clear_stop", "carry", "grip"]
    assert [(o.result, o.attempts) for o in bench.outcomes] == [(Result.PLACED, 1)]
    held = bench.states.index(S.HELD)
    assert bench.states[held - 1 : held + 2] == [S.PLACE, S.HELD, S.PLACE]
    assert bench.overcome == 1
    whole, rest = [command for command in bench.arm.commands if command.get("name") == "carry"]
    assert rest["to_deg"] == pytest.approx(whole["to_deg"], abs=1e-3)
    assert rest["from_deg"] != pytest.approx(whole["from_deg"], abs=1.0)


@pytest.mark.safety("SR-35")
def test_what_was_over_the_table_may_still_be_there_when_the_camera_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.reach_over_on_the_way({1})
    bench.intrude(looks=range(2, 30))
    moves: list[str] = []

    def held(cause: SorterError, at: float) -> None:
        bench.held_for.append(cause)
        moves.append(bench.commands[-1])
        if len(bench.held_for) == 1:
            bench.camera.failures = [CameraLost("camera", "read", "unplugged")] * 3

    monkeypatch.setattr(bench, "held", held)
    bench.run()
    assert [type(cause) for cause in bench.held_for] == [Intruder, CameraLost, Intruder]
    assert moves == ["clear_stop"] * 3
    assert bench.overcome == 1
    assert bench.results == [Result.PLACED]


@pytest.mark.safety("SR-35", "SR-20")
def test_a_stop_asked_for_when_a_hand_has_stopped_the_arm_still_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.reach_over_on_the_way({1})
    bench.arm.open()
    sorter = bench.sorter()
    monkeypatch.setattr(bench, "held", lambda cause, at: sorter.request_stop())
    sorter.run()
    assert sorter.fault is None
    assert "grip" not in bench.commands
    assert bench.commands[-3:] == ["clear_stop", "park", "relax"]
    assert bench.results == [Result.GRASP_MISSED]


def test_a_glance_that_comes_after_the_move_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    listeners = []
    monkeypatch.setattr(BenchCamera, "glance", lambda camera, listener: listeners.append(listener))
    bench.reach_over_on_the_way(())
    bench.on_command = lambda c: listeners[0](Frame(1, 0.0, IMAGE)) if c["command"] == "grip" else None
    bench.run()
    assert bench.results == [Result.PLACED]
    assert bench.held_for == []

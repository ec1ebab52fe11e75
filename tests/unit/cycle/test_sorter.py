"""The cycle at work on a bench: every way a target can end, and every way a run can."""

from __future__ import annotations

import pytest

from controller.config.cell import CellConfig
from controller.cycle import looking
from controller.cycle.machine import State
from controller.domain import LocatedObject, PickPlan, Result, Shape
from controller.errors import (
    ArmError,
    CalibrationError,
    CalibrationStale,
    CameraEnded,
    CameraLost,
    Intruder,
    LedgerError,
    MotionTimeout,
    PartHeld,
    PictureUnusable,
)
from controller.localization.locate import Located
from controller.motion.planner import Planner
from tests.unit.cycle.bench import Bench, moved, part

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


@pytest.mark.safety("SR-40")
def test_intent_is_on_record_before_motion_and_the_outcome_after(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.on_command = lambda command: bench.ledger.lines.append(("arm", str(command.get("name", command["command"]))))
    bench.run()
    order = [what for _, what in bench.ledger.lines]
    assert order.index("home") < order.index("t1/1") < order.index("approach")
    assert order.index("carry") < order.index("t1:placed") < order.index("park")


def test_every_shape_goes_to_its_bin_and_the_rest_to_the_rejects(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, -100, Shape.SQUARE), part(0, 100, Shape.CIRCLE), part(20, 0, Shape.OTHER))
    bench.run()
    assert {(o.target.shape, o.plan.bin.name, o.result) for o in bench.outcomes if o.plan} == {
        (Shape.SQUARE, "squares", Result.PLACED),
        (Shape.CIRCLE, "circles", Result.PLACED),
        (Shape.OTHER, "rejects", Result.REJECTED),
    }


def test_what_no_rule_names_may_be_left(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0, Shape.OTHER))
    bench.change("sorting", otherwise="leave")
    assert bench.run().left == 1
    assert bench.outcomes == []


@pytest.mark.parametrize(
    "thing", [part(-150, 0), part(0, 0, score=0.3), part(0, 0, size=90.0)], ids=["outside", "unsure", "too wide"]
)
@pytest.mark.safety("SR-10")
def test_what_cannot_be_picked_is_left_and_nothing_approaches_it(
    monkeypatch: pytest.MonkeyPatch, thing: LocatedObject
) -> None:
    bench = Bench(monkeypatch, thing)
    assert bench.run().left == 1
    assert "approach" not in bench.commands


def test_a_missed_grasp_is_tried_again_with_a_new_look_and_then_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    for _ in range(3):
        bench.arm.grip_result(contact=False, opening=50.0)
        bench.arm.grip_result(contact=False, opening=32.0)
        bench.arm.grip_result(contact=False, opening=50.0)
    assert bench.run().left == 1
    assert bench.results == [Result.GRASP_MISSED]
    assert bench.outcomes[0].attempts == 3
    assert bench.states.count(S.DETECT) == 4
    assert [what for kind, what in bench.ledger.lines if kind == "intend"] == ["t1/1", "t1/2", "t1/3"]


@pytest.mark.safety("SR-41")
def test_a_part_gone_after_a_missed_grasp_is_indeterminate(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.arm.grip_result(contact=False, opening=50.0)
    bench.arm.grip_result(contact=False, opening=32.0)
    bench.on_command = lambda c: bench.table.clear() if c.get("name") == "approach" else None
    bench.run()
    assert bench.results == [Result.INDETERMINATE]


@pytest.mark.safety("SR-41")
def test_a_dropped_part_is_found_again_and_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))

    def drop(command: dict[str, object]) -> None:
        if command.get("name") == "carry" and len(bench.states) < 8:
            bench.arm._opening = 32.0  # the part slips out and the jaws close
            bench.table[0] = moved(bench.table[0], 10, 90)

    bench.on_command = drop
    sorter = bench.run()
    assert bench.results == [Result.PLACED]
    assert bench.outcomes[0].attempts == 2
    assert bench.outcomes[0].target.center == (10.0, 90.0)
    assert sorter.left == 0


def test_a_dropped_part_that_is_nowhere_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))

    def drop(command: dict[str, object]) -> None:
        if command.get("name") == "carry":
            bench.arm._opening = 32.0
            bench.table.clear()

    bench.on_command = drop
    bench.run()
    assert bench.results == [Result.DROPPED]


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


def test_a_part_taken_is_not_taken_again_for_one_of_the_same_look_that_cannot_be(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch, part(0, 0), part(400, 0))
    bench.change("cycle", picks_per_look=10)
    monkeypatch.setattr(CellConfig, "in_work_area", lambda *_: True)
    bench.run()
    assert bench.results == [Result.PLACED]
    assert bench.commands.count("carry") == 1


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


@pytest.mark.safety("SR-24")
def test_a_camera_that_comes_back_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.camera.failures = [CameraLost("camera", "read", "unplugged")] * 2
    bench.run()
    assert bench.results == [Result.PLACED]
    assert bench.states.count(S.HELD) == 2
    assert bench.camera.opened == 2


def test_another_failure_of_the_camera_is_told_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    codes = ["black", "black", "moved"]
    bench.camera.failures = [PictureUnusable("camera", "look", code, code) for code in codes]
    bench.run()
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


def test_the_end_of_a_replay_is_an_ordinary_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    bench.camera.failures = [CameraEnded("replay", "read", "the pictures have ended")]
    assert bench.run().fault is None
    assert bench.states[-1] is S.STOPPED


def test_the_operator_may_refuse_a_pick(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))

    def refuse(plan: object) -> bool:
        bench.table.clear()
        return False

    bench.confirm = refuse
    bench.run()
    assert bench.results == [Result.SKIPPED]
    assert "approach" not in bench.commands


def test_the_arm_goes_from_bin_to_part_without_a_detour(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, -90), part(0, 90))
    bench.run()
    assert bench.commands.count("retreat") == 1
    assert bench.commands.index("retreat") > max(i for i, name in enumerate(bench.commands) if name == "carry")


def test_an_arm_in_the_view_steps_back_before_the_look(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, -90), part(0, 90))
    monkeypatch.setattr(Planner, "leaves_view_clear", lambda *args: False)
    bench.run()
    assert bench.commands.count("retreat") == 2


def test_a_full_bin_suspends_its_parts_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, -80), part(0, 0), part(0, 80, Shape.CIRCLE))
    squares = bench.config.bins[0].model_copy(update={"capacity": 1})
    bench.config = bench.config.model_copy(update={"bins": (squares, *bench.config.bins[1:])})
    assert bench.run().left == 1
    assert sorted(o.target.shape for o in bench.outcomes) == [Shape.CIRCLE, Shape.SQUARE]


def test_several_parts_may_be_picked_from_one_look(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, -90), part(0, 0), part(0, 90))
    bench.change("cycle", picks_per_look=2)
    bench.run()
    assert bench.results == [Result.PLACED] * 3
    assert bench.states.count(S.DETECT) == 3


def test_a_run_ends_after_the_wanted_number_of_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, -90), part(0, 0), part(0, 90))
    bench.most_parts = 2
    assert bench.run().left == 1
    assert bench.results == [Result.PLACED] * 2


def test_the_same_run_commands_the_same_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    benches = []
    for _ in range(2):
        bench = Bench(monkeypatch, part(0, -90), part(0, 60))
        bench.run()
        benches.append(bench)
    benches[1].arm.assert_commands(benches[0].arm.commands)


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


def test_what_lies_in_a_bin_counts_in_the_next_run(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.filled["squares"] = bench.config.bins[0].capacity
    assert bench.run().left == 1


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


def test_a_part_moved_by_other_hands_before_the_grasp_is_the_same_part(monkeypatch: pytest.MonkeyPatch) -> None:
    before = part(0, 0)
    bench = Bench(monkeypatch, before)
    bench.arm.grip_result(contact=False, opening=50.0)
    bench.arm.grip_result(contact=False, opening=32.0)

    def move(command: dict[str, object]) -> None:
        if command.get("name") == "approach" and bench.table == [before]:
            bench.table[0] = moved(bench.table[0], 0, -90)

    bench.on_command = move
    bench.run()
    assert [(o.result, o.attempts) for o in bench.outcomes] == [(Result.PLACED, 2)]


def test_a_part_that_was_missed_rests_until_others_are_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    stubborn = part(0, 0)
    others = [part(-30, -110, size=36.0), part(0, 110, size=36.0), part(20, -60, size=36.0), part(20, 60, size=36.0)]
    bench = Bench(monkeypatch, stubborn, *others)
    bench.change("cycle", attempts=1)
    tried: list[float] = []

    def refuse(plan: PickPlan) -> bool:
        if plan.target.size[0] == 40.0:
            tried.append(bench.clock.now())
            if len(tried) == 1:
                bench.arm.grip_result(contact=False, opening=50.0)
                bench.arm.grip_result(contact=False, opening=32.0)
        return True

    bench.confirm = refuse
    bench.run()
    assert bench.results.count(Result.PLACED) == 5
    assert len(tried) == 2
    last_two = [outcome.target.size[0] for outcome in bench.outcomes][-2:]
    assert 40.0 in last_two

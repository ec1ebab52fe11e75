"""The handlers on a bench: every way a target can end, and what is picked when."""

from __future__ import annotations

import pytest

from controller.config.cell import CellConfig
from controller.cycle.looking import Looker
from controller.cycle.machine import State
from controller.domain import Detection, LocatedObject, PickPlan, Result, Shape
from controller.errors import NoClearGrasp
from controller.motion.planner import Planner
from tests.unit.cycle.bench import Bench, moved, part

S = State


@pytest.mark.safety("SR-40")
def test_intent_is_on_record_before_motion_and_the_outcome_after(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.on_command = lambda command: bench.ledger.lines.append(("arm", str(command.get("name", command["command"]))))
    bench.run()
    order = [what for _, what in bench.ledger.lines]
    assert order.index("home") < order.index("t1/1") < order.index("approach")
    assert order.index("carry") < order.index("t1:placed") < order.index("park")


@pytest.mark.safety("SR-41")
def test_what_a_run_that_was_cut_off_left_in_the_jaws_is_let_go_before_anything_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.arm.open()
    bench.arm.energise()
    bench.arm.grip_result(contact=True, opening=40.0)
    bench.arm.grip(30.0)
    bench.arm.commands.clear()
    bench.sorter().run()
    assert bench.commands[:4] == ["energise", "grip", "home", "approach"]
    assert bench.arm.commands[1]["opening_mm"] == 46.0
    assert bench.results == [Result.PLACED]


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


@pytest.mark.safety("SR-41")
def test_a_part_lost_while_the_arm_stands_over_its_bin_is_not_counted_as_placed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    lost: list[Detection] = []

    def lose(looker: Looker, taken: Detection) -> bool:
        if not lost:
            bench.arm._opening = 32.0
            lost.append(taken)
        return False

    monkeypatch.setattr(Looker, "shows_still", lose)
    bench.run()
    assert [(o.result, o.attempts) for o in bench.outcomes] == [(Result.PLACED, 2)]


def test_a_dropped_part_that_is_nowhere_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))

    def drop(command: dict[str, object]) -> None:
        if command.get("name") == "carry":
            bench.arm._opening = 32.0
            bench.table.clear()

    bench.on_command = drop
    bench.run()
    assert bench.results == [Result.DROPPED]


def test_a_part_taken_is_not_taken_again_for_one_of_the_same_look_that_cannot_be(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch, part(0, 0), part(400, 0))
    bench.change("cycle", picks_per_look=10)
    monkeypatch.setattr(CellConfig, "in_work_area", lambda *_: True)
    bench.run()
    assert bench.results == [Result.PLACED]
    assert bench.commands.count("carry") == 1


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


def test_what_lies_in_a_bin_counts_in_the_next_run(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    bench.filled["squares"] = bench.config.bins[0].capacity
    assert bench.run().left == 1


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


def test_looking_for_a_push_in_vain_takes_its_time_too(monkeypatch: pytest.MonkeyPatch) -> None:
    around = [part(x, y, score=0.0) for x, y in ((43.0, 90.0), (-43.0, 90.0), (0.0, 133.0), (0.0, 47.0))]
    bench = Bench(monkeypatch, part(0.0, 90.0), *around)
    bench.change("cycle", pushing_budget_s=4.0)
    began: list[float] = []

    def in_vain(*_: object, **__: object) -> None:
        began.append(bench.clock.now())
        raise NoClearGrasp("no push", "move the parts apart")

    monkeypatch.setattr(Planner, "plan_nudge", in_vain)
    bench.run()
    assert len(began) == 2  # what would free it for sure, then what may
    assert began[1] - began[0] == pytest.approx(4.0)

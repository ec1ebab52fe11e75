"""What lies in the way: neighbours that could not be located, and jaws that come down on something."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from controller.cycle.choice import NUDGES
from controller.cycle.doubt import doubted
from controller.domain import MoveReport, Result, Shape, Trajectory
from controller.errors import MotionTimeout
from controller.localization.locate import Located
from sim_backends.recording_arm import RecordingArm
from tests.unit.cycle.bench import Bench, part


@pytest.mark.safety("SR-34")
def test_what_could_not_be_located_is_still_in_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four neighbours 3 mm away leave no room for a jaw of 8 mm, whether they could be located or not."""
    bench = Bench(monkeypatch, part(0, 0))
    around = tuple(part(x, y) for x, y in ((43, 0), (-43, 0), (0, 43), (0, -43)))

    def located(*_: object) -> Located:
        refused = tuple((thing.detection, "no prism fits") for thing in around)
        return Located(tuple(bench.table), refused, around)

    monkeypatch.setattr("controller.cycle.looking.locate", located)
    assert bench.run().left == 5
    assert "carry" not in bench.commands
    assert [kind for kind, _ in bench.ledger.lines if kind == "intend"] == []
    assert bench.commands.count("push") <= NUDGES


@pytest.mark.parametrize(("stray", "results"), [(0.03, [Result.PLACED]), (0.08, [Result.GRASP_MISSED])])
@pytest.mark.safety("SR-16")
def test_jaws_that_meet_something_on_the_way_down_do_not_close(
    monkeypatch: pytest.MonkeyPatch, stray: float, results: list[Result]
) -> None:
    bench = Bench(monkeypatch, part(0, 0))
    follow = RecordingArm.follow

    def strays(arm: RecordingArm, trajectory: Trajectory, *how: float | None) -> MoveReport:
        report = follow(arm, trajectory, *how)  # type: ignore[arg-type]  # whatever the cycle asks for
        if trajectory.name != "approach":
            return report
        elsewhere = report.state.positions - np.array([0.0, 0.0, stray, 0.0, 0.0])
        return dataclasses.replace(report, state=dataclasses.replace(report.state, positions=elsewhere))

    monkeypatch.setattr(RecordingArm, "follow", strays)
    bench.run()
    assert bench.results == results
    if results == [Result.GRASP_MISSED]:
        assert "in the way" in bench.outcomes[0].reason
        narrowest = min(float(str(c["opening_mm"])) for c in bench.arm.commands if c["command"] == "grip")
        width = bench.outcomes[0].plan.grasp.width if bench.outcomes[0].plan else 0.0
        assert narrowest > width


def test_what_has_no_name_waits_until_the_others_are_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part that looks like no known shape may only be touched by a neighbour."""
    bench = Bench(monkeypatch, part(0, 0, Shape.OTHER, score=1.0), part(0, 90, Shape.SQUARE, score=0.6))
    bench.run()
    assert [outcome.target.shape for outcome in bench.outcomes] == [Shape.SQUARE, Shape.OTHER]


@pytest.mark.parametrize("blocked", [False, True])
def test_a_push_that_jams_ends_in_another_look(monkeypatch: pytest.MonkeyPatch, blocked: bool) -> None:
    """What is pushed may be held by its neighbours: the arm goes home from where it stands, not along the retreat."""
    places = ((43.0, 90.0), (-43.0, 90.0), (0.0, 133.0), (0.0, 47.0))
    bench = Bench(monkeypatch, part(0.0, 90.0), *(part(x, y, score=0.0) for x, y in places))
    follow = RecordingArm.follow

    def jams(arm: RecordingArm, trajectory: Trajectory, *how: float | None) -> MoveReport:
        report = follow(arm, trajectory, *how)  # type: ignore[arg-type]  # whatever the cycle asks for
        if trajectory.name != "push":
            return report
        if blocked:
            raise MotionTimeout("shoulder", "push", "is 18 deg off its path", "clear the way, then reset")
        elsewhere = report.state.positions - np.array([0.08, 0.0, 0.0, 0.0, 0.0])
        return dataclasses.replace(report, state=dataclasses.replace(report.state, positions=elsewhere))

    monkeypatch.setattr(RecordingArm, "follow", jams)
    sorter = bench.run()
    assert sorter.fault is None
    after = [bench.commands[i + 1] for i, name in enumerate(bench.commands) if name == "push"]
    assert after
    assert set(after) == {"home"}


@pytest.mark.parametrize(("size", "shape"), [((49.7, 49.5), Shape.OTHER), ((50.0, 36.0), Shape.RECTANGLE)])
def test_a_rectangle_whose_sides_are_alike_is_not_believed(size: tuple[float, float], shape: Shape) -> None:
    thing = dataclasses.replace(part(0, 0, Shape.RECTANGLE), size=size, sigma=0.24)
    assert doubted(thing, 30.0).shape is shape

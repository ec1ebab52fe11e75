"""Which frames a look asks for: none from before the arm was last out of the camera's way."""

from __future__ import annotations

import pytest

from controller.domain import Frame, GripReport, MoveReport, Result, Trajectory
from controller.motion.planner import Planner
from sim_backends.recording_arm import RecordingArm
from tests.unit.cycle.bench import IMAGE, Bench, BenchCamera, part


@pytest.mark.parametrize("clear", [True, False])
@pytest.mark.safety("SR-30")
def test_no_frame_is_asked_for_from_before_the_last_motion_in_its_view(
    monkeypatch: pytest.MonkeyPatch, clear: bool
) -> None:
    """Where the arm over a bin hides nothing, the table stays as it is once the part is lifted; else until the end."""
    bench = Bench(monkeypatch, part(0, -90), part(0, 90))
    monkeypatch.setattr(Planner, "leaves_view_clear", lambda *_: clear)
    follow, grip = RecordingArm.follow, RecordingArm.grip
    in_view = 0.0
    asked: list[tuple[float, float]] = []

    def follows(arm: RecordingArm, move: Trajectory, opening: float | None = None, after: float = 0.0) -> MoveReport:
        nonlocal in_view
        report = follow(arm, move, opening, after)
        if not clear or move.name not in ("carry", "retreat"):
            in_view = bench.clock.now()
        return report

    def grips(arm: RecordingArm, opening: float, effort: float = 1.0) -> GripReport:
        nonlocal in_view
        report = grip(arm, opening, effort)
        if not clear or report.contact:
            in_view = bench.clock.now()
        return report

    def capture(camera: BenchCamera, after: float, timeout: float = 2.0) -> Frame:
        asked.append((after, in_view))
        return Frame(len(asked), bench.clock.now(), IMAGE)

    monkeypatch.setattr(RecordingArm, "follow", follows)
    monkeypatch.setattr(RecordingArm, "grip", grips)
    monkeypatch.setattr(BenchCamera, "capture", capture)
    bench.run()
    assert bench.results == [Result.PLACED] * 2
    assert len(asked) >= 3
    assert all(after >= moved for after, moved in asked)

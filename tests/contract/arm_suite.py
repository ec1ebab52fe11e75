"""What every arm must do, real or simulated: one suite for all of them.

A module that runs it defines a fixture `arm_case` that gives an `ArmCase` whose arm is open, torque off, at rest.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from controller.domain import Array, MoveReport, Trajectory
from controller.errors import ArmError, LimitViolation
from controller.ports import Arm, Clock

# rad: one encoder step is 0.0015; unmodelled friction at the wrist leaves 0.006 on the bench.
STANDS = 0.012
# mm: the same at the gripper.
JAWS = 1.0


@dataclass
class ArmCase:
    """An arm to be tested.

    Attributes:
        obstruct: Puts something stiff of a width (mm) between the jaws, or takes it away (None).
        during: (arm, call, seconds, action) runs `call` and `action` so many seconds of the arm's clock into it.
    """

    arm: Arm
    clock: Clock
    obstruct: Callable[[float | None], None]
    during: Callable[[Callable[[], object], float, Callable[[], None]], object] = field(default=lambda *_: None)


def quintic(start: Array, end: Array, duration: float, period: float = 0.01) -> Trajectory:
    """A move from rest to rest along a straight line in joint space; goals equal positions."""
    share = np.linspace(0.0, 1.0, round(duration / period) + 1)[:, None]
    smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    positions = start + (end - start) * smooth
    return Trajectory("suite", period, positions, positions.copy())


class ArmSuite:
    """The contract, as tests."""

    @staticmethod
    def _lifted(arm: Arm) -> tuple[Array, Array]:
        """(rest as measured, a pose a little above it)."""
        rest = arm.state().positions
        return rest, rest + np.array([0.3, 0.3, -0.3, 0.2, 0.2])[: len(rest)]

    def test_it_is_an_arm(self, arm_case: ArmCase) -> None:
        assert isinstance(arm_case.arm, Arm)

    def test_state_is_complete_and_at_rest(self, arm_case: ArmCase) -> None:
        state = arm_case.arm.state()
        description = arm_case.arm.description
        assert state.positions.shape == state.velocities.shape == (len(description.joints),)
        assert np.abs(state.positions - description.rest).max() < STANDS
        assert state.at <= arm_case.clock.now()

    @pytest.mark.safety("SR-01")
    def test_nothing_moves_without_torque(self, arm_case: ArmCase) -> None:
        arm = arm_case.arm
        start, end = self._lifted(arm)
        with pytest.raises(ArmError):
            arm.follow(quintic(start, end, 0.5))
        with pytest.raises(ArmError):
            arm.grip(50.0)
        assert np.abs(arm.state().positions - start).max() < STANDS

    @pytest.mark.safety("SR-02")
    def test_torque_on_moves_nothing(self, arm_case: ArmCase) -> None:
        before = arm_case.arm.state().positions
        assert np.abs(arm_case.arm.energise().positions - before).max() < STANDS

    def test_follow_ends_where_the_trajectory_does(self, arm_case: ArmCase) -> None:
        arm = arm_case.arm
        arm.energise()
        start, end = self._lifted(arm)
        began = arm_case.clock.now()
        there = arm.follow(quintic(start, end, 0.6))
        assert there.finished
        assert np.abs(there.state.positions - end).max() < STANDS
        assert arm_case.clock.now() - began >= 0.6
        assert arm.follow(quintic(there.state.positions, start, 0.6)).finished
        assert np.abs(arm.state().positions - start).max() < STANDS

    @pytest.mark.safety("SR-13")
    def test_a_trajectory_from_elsewhere_is_refused_and_nothing_moves(self, arm_case: ArmCase) -> None:
        arm = arm_case.arm
        arm.energise()
        start, end = self._lifted(arm)
        with pytest.raises(LimitViolation):
            arm.follow(quintic(end, start, 0.5))
        assert np.abs(arm.state().positions - start).max() < STANDS

    def test_a_trajectory_for_other_joints_is_refused(self, arm_case: ArmCase) -> None:
        arm = arm_case.arm
        arm.energise()
        with pytest.raises(LimitViolation):
            arm.follow(quintic(np.zeros(2), np.ones(2), 0.5))

    @pytest.mark.safety("SR-20")
    def test_a_stop_before_the_move_holds_until_cleared(self, arm_case: ArmCase) -> None:
        arm = arm_case.arm
        arm.energise()
        start, end = self._lifted(arm)
        arm.request_stop()
        assert not arm.follow(quintic(start, end, 0.5)).finished
        assert not arm.grip(60.0).finished
        assert np.abs(arm.state().positions - start).max() < STANDS
        arm.clear_stop()
        assert arm.follow(quintic(start, end, 0.5)).finished

    @pytest.mark.safety("SR-20")
    def test_a_stop_ends_the_move_on_its_path(self, arm_case: ArmCase) -> None:
        arm = arm_case.arm
        arm.energise()
        start, end = self._lifted(arm)
        reports: list[MoveReport] = []
        arm_case.during(lambda: reports.append(arm.follow(quintic(start, end, 2.0))), 0.8, arm.request_stop)
        (report,) = reports
        stopped = arm.state().positions
        assert not report.finished
        done = (stopped - start) @ (end - start) / ((end - start) @ (end - start))
        assert 0.05 < done < 0.95
        # All joints have come equally far: off the line by less than what their lags differ by.
        assert np.abs(stopped - (start + done * (end - start))).max() < 2 * STANDS
        arm.clear_stop()
        assert arm.follow(quintic(arm.state().positions, start, 1.0)).finished

    @pytest.mark.parametrize("opening", [40.0, 70.0])
    def test_the_jaws_take_their_opening_on_the_way(self, arm_case: ArmCase, opening: float) -> None:
        arm = arm_case.arm
        arm.energise()
        start, end = self._lifted(arm)
        there = arm.follow(quintic(start, end, 0.8), opening)
        assert there.finished
        assert np.abs(there.state.positions - end).max() < STANDS
        assert abs(there.state.opening - opening) < JAWS

    @pytest.mark.parametrize("opening", [40.0, 70.0])
    def test_grip_moves_the_jaws(self, arm_case: ArmCase, opening: float) -> None:
        arm = arm_case.arm
        arm.energise()
        report = arm.grip(opening)
        assert report.finished
        assert not report.contact
        assert abs(report.opening - opening) < JAWS
        assert abs(arm.state().opening - opening) < JAWS

    @pytest.mark.safety("SR-16")
    def test_grip_stops_on_a_part(self, arm_case: ArmCase) -> None:
        arm = arm_case.arm
        arm.energise()
        arm.grip(60.0)
        arm_case.obstruct(45.0)
        report = arm.grip(35.0)
        assert report.finished
        assert report.contact
        assert abs(report.opening - 45.0) < 2 * JAWS
        assert report.load > 0.0
        assert arm.grip(60.0).finished
        arm_case.obstruct(None)

    @pytest.mark.safety("SR-16")
    def test_openings_are_clipped_to_the_grippers_range(self, arm_case: ArmCase) -> None:
        arm = arm_case.arm
        arm.energise()
        low, high = arm.description.gripper.opening
        assert abs(arm.grip(high + 500.0).opening - high) < JAWS
        assert abs(arm.grip(low - 500.0).opening - low) < JAWS

    @pytest.mark.parametrize("effort", [0.0, 1.5, -1.0])
    def test_efforts_out_of_range_are_refused(self, arm_case: ArmCase, effort: float) -> None:
        arm_case.arm.energise()
        with pytest.raises(ValueError, match="effort"):
            arm_case.arm.grip(50.0, effort)

    def test_relax_takes_the_torque_off(self, arm_case: ArmCase) -> None:
        arm = arm_case.arm
        arm.energise()
        start, end = self._lifted(arm)
        arm.relax()
        with pytest.raises(ArmError):
            arm.follow(quintic(start, end, 0.5))
        arm.energise()
        assert arm.follow(quintic(arm.state().positions, end, 0.5)).finished

    def test_closing_is_harmless_and_it_opens_again(self, arm_case: ArmCase) -> None:
        arm = arm_case.arm
        arm.close()
        arm.close()
        with pytest.raises(ArmError):
            arm.state()
        arm.open()
        arm.energise()
        start, end = self._lifted(arm)
        assert arm.follow(quintic(start, end, 0.5)).finished


def in_a_thread(call: Callable[[], object], clock: Clock, seconds: float, action: Callable[[], None]) -> None:
    """For arms on real time: run `call`, and `action` in a thread `seconds` after its beginning."""

    def later() -> None:
        clock.sleep(seconds)
        action()

    thread = threading.Thread(target=later)
    thread.start()
    call()
    thread.join()

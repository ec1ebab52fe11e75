"""What the jaws' settled opening proves."""

from __future__ import annotations

import numpy as np
import pytest

from controller.config.arm import load_arm
from controller.cycle import proof
from controller.domain import ArmState, Grasp, GripReport

GRIPPER = load_arm("reactorx_150").gripper


def grasp(width: float, flush: float | None = None) -> Grasp:
    return Grasp((0.0, 0.0), 15.0, 0.0, width, width + 8.0, 5.0, width if flush is None else flush)


@pytest.mark.parametrize("width", [34.0, 45.0, 60.0])
def test_jaws_that_reach_their_target_are_told_from_jaws_on_a_part(width: float) -> None:
    target = proof.closing_target(grasp(width), GRIPPER)
    assert target >= GRIPPER.opening[0]
    assert proof.refusal(GripReport(True, False, target, 0.1), grasp(width), 0.15) is not None
    assert proof.refusal(GripReport(True, True, width, 0.3), grasp(width), 0.15) is None


@pytest.mark.parametrize("opening", [39.0, 42.4, 46.3, 51.0])
def test_a_part_of_another_width_is_refused(opening: float) -> None:
    assert "45.0 mm wide" in str(proof.refusal(GripReport(True, True, opening, 0.3), grasp(45.0), 0.15))


@pytest.mark.parametrize("opening", [43.0, 44.2, 45.5])
def test_what_grips_of_the_right_part_settle_at_is_taken(opening: float) -> None:
    assert proof.refusal(GripReport(True, True, opening, 0.3), grasp(45.0), 0.15) is None


def test_a_part_that_lay_askew_may_be_turned_flush_or_held_as_it_lies() -> None:
    askew = grasp(48.7, flush=38.0)
    assert proof.closing_target(askew, GRIPPER) == 30.0
    for opening in (38.0, 43.0, 48.7):
        assert proof.refusal(GripReport(True, True, opening, 0.3), askew, 0.15) is None
    assert "38.0 to 48.7 mm wide" in str(proof.refusal(GripReport(True, True, 33.0, 0.3), askew, 0.15))


def test_jaws_that_closed_on_the_way_have_lost_the_part() -> None:
    def state(opening: float) -> ArmState:
        return ArmState(0.0, np.zeros(5), np.zeros(5), opening, 0.3)

    assert proof.lost(state(44.0), grasp(45.0)) is None
    assert proof.lost(state(33.0), grasp(45.0)) is not None


@pytest.mark.parametrize("named", [True, False])
def test_jaws_that_stay_where_they_were_hold_nothing_whatever_lies_there(named: bool) -> None:
    stuck = GripReport(True, True, 45.3, 0.3)
    assert "stayed at 45.3 mm" in str(proof.refusal(stuck, grasp(45.0), 1.3, named=named, before=45.5))
    assert proof.refusal(stuck, grasp(45.0), 1.3, named=named, before=50.0) is None


def test_what_has_no_name_is_seen_less_well() -> None:
    assert proof.refusal(GripReport(True, True, 35.2, 0.3), grasp(38.9), 0.15) is not None
    assert proof.refusal(GripReport(True, True, 35.2, 0.3), grasp(38.9), 1.3) is None


def test_what_has_no_name_may_have_any_width_but_must_be_there() -> None:
    assert proof.refusal(GripReport(True, True, 38.0, 0.3), grasp(45.0), 0.15, named=False) is None
    assert proof.refusal(GripReport(True, False, 37.0, 0.1), grasp(45.0), 0.15, named=False) is not None

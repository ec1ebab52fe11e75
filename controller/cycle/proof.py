"""Pick proof: whether the jaws hold what they were sent for.

The settled opening must agree with the width that the camera measured. An opening much smaller means an
empty or tilted grasp; much larger, that something else is between the jaws.
"""

from __future__ import annotations

import math

from controller.domain import ArmState, Grasp, Gripper, GripReport, MoveReport

WIDTH_TOLERANCE_MM = 4.0
"""Source: measured grips of 150 random parts settle within 4 mm of the seen width, else they are tilted."""

SQUEEZE_MM = 8.0
"""Closing aims this far below the part's width: twice the tolerance, so that an empty grasp shows."""

STRAY_RAD = 0.05
"""An approach that strays further from its path has met something.

Source: 200 free approaches of the simulated arm with its sag and friction stray by 1.7 deg (0.03 rad) at most, jaws
that come down on a part by 4.5 deg and more.
"""


def obstruction(report: MoveReport) -> str | None:
    """Why an approach has not gone as planned, or None when its way was free."""
    if report.worst_following_error > STRAY_RAD:
        stray = math.degrees(report.worst_following_error)
        return f"the arm strayed by {stray:.1f} deg on its way down: something is in its way"
    return None


RELEASE_MM = 2.0
"""Jaws this much wider than the seen width have let go: sizes are seen to 0.3 mm, and jaws arrive within 1 mm."""


def closing_target(grasp: Grasp, gripper: Gripper) -> float:
    """Opening (mm) to send the jaws to, so that they stop on the part and not at the target."""
    return max(grasp.width - SQUEEZE_MM, gripper.opening[0])


def refusal(report: GripReport, grasp: Grasp) -> str | None:
    """Why a closed gripper does not hold the part, or None when it does."""
    if not report.contact:
        return f"the jaws closed to {report.opening:.1f} mm without touching a part"
    if abs(report.opening - grasp.width) > WIDTH_TOLERANCE_MM:
        return f"the jaws stopped at {report.opening:.1f} mm where the part is {grasp.width:.1f} mm wide"
    return None


def lost(state: ArmState, grasp: Grasp) -> str | None:
    """Why a part gripped before is no longer between the jaws, or None while it is."""
    if state.opening < grasp.width - WIDTH_TOLERANCE_MM:
        return f"the jaws closed to {state.opening:.1f} mm on the way: the {grasp.width:.1f} mm part is gone"
    return None


def kept(report: GripReport, grasp: Grasp) -> str | None:
    """Why jaws that were opened may still hold the part, or None when they are wider than it is."""
    if report.opening > grasp.width + RELEASE_MM:
        return None
    return f"the jaws opened to {report.opening:.1f} mm only: the {grasp.width:.1f} mm part is still between them"

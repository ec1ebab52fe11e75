"""Pick proof: whether the jaws hold what they were sent for.

The settled opening must agree with the width that the camera measured. An opening much smaller means an
empty or tilted grasp; much larger, that something else is between the jaws.
"""

from __future__ import annotations

import math

import numpy as np

from controller.domain import ArmState, Grasp, Gripper, GripReport, MoveReport, Trajectory

CLOSED_MM = 4.0
"""Jaws that close further while they carry have lost the part.

Source: measured grips of 150 random parts settle within 4 mm of the seen width, else they are tilted.
"""

WIDER_MM, NARROWER_MM = 0.8, 2.2
"""Jaws that stop further off hold something else, twice the part's own deviation (0.1 to 0.2 mm, 1.3 mm for what has no
name) apart: of two parts swapped by other hands whose widths differ by more than 2 mm, neither passes for the other.

Source: 42 grips of the simulated arm at level `dynamic` settled 0.4 to 2.1 mm below the seen width, 0.8 mm in the
middle.
"""

SQUEEZE_MM = 8.0
"""Closing aims this far below the part's width, well below what is taken for a part: an empty grasp shows."""

MOVED_MM = 1.0
"""Jaws that have not come nearer by as much hold nothing: they are opened 5 mm or more wider than a part is seen, and a
servo arrives within 1 mm.
"""

RELEASE_MM = 2.0
"""Jaws this much wider than the seen width have let go: sizes are seen to 0.3 mm, and jaws arrive within 1 mm."""

ASTRAY_RAD = 0.05
"""A joint that ends an approach further from its goal stands on something; a driver would refuse to carry from there.

Source: 31 free approaches of the simulated arm, its sag and friction included, ended within 1.6 deg (0.03 rad), those
whose jaws came down on a part 3.5 deg and more from their goal.
"""


def obstruction(report: MoveReport, approach: Trajectory) -> str | None:
    """Why an approach has not come to its end, or None when it has."""
    astray = float(np.abs(report.state.positions - approach.positions[-1]).max())
    if astray > ASTRAY_RAD:
        return f"a joint ended its way down {math.degrees(astray):.1f} deg from its goal: something is in the way"
    return None


def closing_target(grasp: Grasp, gripper: Gripper) -> float:
    """Opening (mm) to send the jaws to, so that they stop on the part and not at the target."""
    return max(grasp.flush - SQUEEZE_MM, gripper.opening[0])


def refusal(
    report: GripReport, grasp: Grasp, sigma: float, *, named: bool = True, before: float = math.inf
) -> str | None:
    """Why a closed gripper does not hold the part, or None when it does.

    Args:
        report: Where the jaws have settled.
        grasp: What was meant.
        sigma: Standard deviation of where the part was seen, mm.
        named: Its shape is known. What has none goes where anything may go, and its width is a guess.
        before: How wide the jaws stood before they closed, mm.
    """
    if not report.contact:
        return f"the jaws closed to {report.opening:.1f} mm without touching a part"
    if report.opening > before - MOVED_MM:
        return f"the jaws stayed at {report.opening:.1f} mm: they are stuck, or stand on something"
    if not named:
        return None
    # Jaws turn a part that lies askew flush, or hold it as it lies: both are a grasp.
    slack = 2.0 * sigma
    if not grasp.flush - NARROWER_MM - slack <= report.opening <= grasp.width + WIDER_MM + slack:
        return f"the jaws stopped at {report.opening:.1f} mm where the part is {_wide(grasp)} mm wide"
    return None


def lost(state: ArmState, grasp: Grasp) -> str | None:
    """Why a part gripped before is no longer between the jaws, or None while it is."""
    if state.opening < grasp.flush - CLOSED_MM:
        return f"the jaws closed to {state.opening:.1f} mm on the way: the {_wide(grasp)} mm part is gone"
    return None


def kept(report: GripReport, grasp: Grasp) -> str | None:
    """Why jaws that were opened may still hold the part, or None when they are wider than it is."""
    if report.opening > grasp.width + RELEASE_MM:
        return None
    return f"the jaws opened to {report.opening:.1f} mm only: the {grasp.width:.1f} mm part is still between them"


def _wide(grasp: Grasp) -> str:
    """The part's extent between the jaws: as it lies, and flush where that differs."""
    return f"{grasp.width:.1f}" if grasp.width - grasp.flush < 0.1 else f"{grasp.flush:.1f} to {grasp.width:.1f}"

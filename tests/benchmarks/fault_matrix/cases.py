"""The faults as the matrix lets them happen, and how a run with each of them may end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

STATES = ("HOMING", "CAPTURE", "DETECT", "LOCALIZE", "PICK", "PLACE", "IDLE", "HELD")
"""Of the cycle."""

GOES_ON = frozenset({""})
"""Ends without a latched fault, every part dealt with."""


@dataclass(frozen=True, slots=True)
class Case:
    """One fault as the matrix lets it happen in the cycle.

    Attributes:
        fault: Its code.
        ends: How a run may end: the latched fault's code, or "" for none.
        lasts: s.
        delay: s after the state is entered.
        unsorted: Parts that need not be in their bins at the end although nothing has latched.
        compares: It is noticed beside the first picture of a new cell, so that it strikes a state's second time;
            before that picture there is nothing to notice.
        only: The only states in which it can strike; empty for all.
        looks_like: Another fault of the same action that it may be taken for.
        by: Who lets it happen: `script` (the simulated devices), `arm` (its next command fails so), or `clock`.
    """

    fault: str
    ends: frozenset[str] = GOES_ON
    lasts: float = 6.0
    delay: float = 0.0
    unsorted: int = 0
    compares: bool = False
    only: tuple[str, ...] = ()
    looks_like: str = ""
    by: str = "script"

    @property
    def states(self) -> tuple[str, ...]:
        """States of the cycle in which it can strike."""
        return tuple(
            state
            for state in self.only or STATES
            if not (self.compares and state == "HOMING")
        )

    @property
    def standing(self) -> tuple[str, ...]:
        """States at rest in which it can strike: it is noticed, if at all, when the cell moves on."""
        if self.only or self.by != "script":
            return ()
        return ("FAULT",) if self.compares else ("STOPPED", "FAULT")


def _stops(*codes: str) -> frozenset[str]:
    return frozenset(codes)


# Where a fault of a servo is first noticed depends on what it is doing: it may also be found silent or off its path.
CASES: Mapping[str, Case] = {
    case.fault: case
    for case in (
        Case("camera_lost"),
        Case("camera_stalled"),
        Case("camera_failed"),
        Case("picture_frozen"),
        Case("picture_black"),
        Case("picture_overexposed"),
        Case("picture_torn", lasts=9.0),
        Case("picture_light", compares=True),
        Case("picture_soft", compares=True),
        Case("picture_moved", compares=True),
        Case("picture_covered", compares=True, looks_like="picture_moved"),
        Case("intruder", compares=True),
        Case("light_drifting", lasts=600.0, compares=True),
        Case("pictures_damaged", lasts=600.0),
        Case("supply_low", lasts=600.0),
        Case("bus_noisy", lasts=600.0),
        Case("part_unknown", lasts=600.0),
        Case("bin_full", unsorted=1, only=("PLACE",)),  # it is placing that fills it
        Case("ledger_unwritable"),
        Case("clock_jumped", by="clock"),
        Case("bus_corrupt", lasts=3.0),
        Case("grasp_missed", delay=0.2, unsorted=2),
        Case("part_lost", delay=0.6),
        Case("part_held", _stops("", "part_held", "motion_timeout", "servo_overload"), 600.0, 0.4, unsorted=2),
        Case("bus_timeout", _stops("bus_timeout"), 600.0),
        Case("bus_lost", _stops("bus_lost"), 600.0),
        Case("servo_overload", _stops("servo_overload")),
        Case("servo_shock", _stops("servo_shock")),
        Case("servo_overheat", _stops("servo_overheat")),
        Case("servo_undervoltage", _stops("servo_undervoltage"), 600.0),
        Case("servo_encoder", _stops("servo_encoder")),
        Case("servo_rebooted", _stops("servo_rebooted", "bus_timeout")),
        Case("motion_timeout", _stops("motion_timeout", "servo_overload", "plan_refused"), 600.0),
        Case("arm_failed", _stops("arm_failed"), by="arm"),
        Case("plan_refused", _stops("plan_refused"), by="arm"),
        Case("internal_error", _stops("internal_error"), by="arm"),
    )
}


@dataclass(slots=True)
class Found:
    """What became of one field.

    Attributes:
        end: Code of the latched fault, or "".
        figures: Of the report.
        noticed: Codes of what was held for, warned of or stopped for.
        complaints: Everything that was not as it has to be.
    """

    end: str = ""
    figures: dict[str, Any] = field(default_factory=dict)
    noticed: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)
